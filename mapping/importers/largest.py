"""Chooses the largest of several unconnected models, and notes the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ModelSize:
    """The size of one of several models.

    Attributes:
        name: what the note calls it.
        points: 3D points.
    """

    name: str
    photos: int
    points: int

    def __str__(self) -> str:
        return f"{self.name} with {self.photos} photos and {self.points} points"


def largest_model(holder: str, sizes: Sequence[ModelSize]) -> tuple[int, list[str]]:
    """Return the row of the model with most photos, and a note on the others if there are any.

    A model without points comes after all that have some.

    Args:
        holder: what the models are in, such as ``the file``.
        sizes: of the models, at least one.
    """
    rows = range(len(sizes))
    largest = max(rows, key=lambda r: (sizes[r].points > 0, sizes[r].photos, sizes[r].points))
    others = [str(sizes[row]) for row in rows if row != largest]
    if not others:
        return largest, []
    return largest, [
        f"{holder} holds {len(sizes)} models, each in a world of its own; the largest was taken, "
        f"{sizes[largest]}, not: {', '.join(others)}"
    ]
