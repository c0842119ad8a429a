"""One global descriptor of all photos of a map, as stored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.retrieval.inverted import InvertedFile, dot_products


@dataclass(frozen=True, slots=True, eq=False)
class GlobalRows:
    """Unit rows (n, D), one per photo; ``rows[i]`` reads some as float32.

    Attributes:
        values: (n, D) int8 or float32.
        scales: (n,) float32 factors of the rows of ``values``; None for 1.
        inverted: None in maps whose rows are all compared with every query.
    """

    values: NDArray[np.int8] | NDArray[np.float32]
    scales: NDArray[np.float32] | None = None
    inverted: InvertedFile | None = None

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, rows: int | slice | NDArray[np.integer]) -> NDArray[np.float32]:
        values = self.values[rows].astype(np.float32)
        if self.scales is not None:
            values *= np.asarray(self.scales[rows])[..., None]
        return values

    def cosines(
        self, query: NDArray[np.float32], photos: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Return the cosines (m,) of a unit vector (D,) with some rows (m,), or all."""
        found = dot_products(self.values, query, photos)
        if self.scales is not None:
            found *= self.scales if photos is None else self.scales[photos]
        # Unit vectors in float32 can give 1 + 1e-7.
        return np.clip(found.astype(np.float64), -1.0, 1.0)


def in_8_bits(rows: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Round unit rows (n, D) to int8; return them with scales (n,) that restore unit length.

    The zero rows of blank photos stay zero.
    """
    largest = np.abs(rows).max(axis=1, initial=0.0)
    steps = np.where(largest > 0, largest, 1) / np.float32(127)
    values = np.rint(rows / steps[:, None]).astype(np.int8)
    lengths = np.linalg.norm(values.astype(np.float32), axis=1)
    return values, np.where(lengths > 0, 1 / np.maximum(lengths, 1), 0).astype(np.float32)
