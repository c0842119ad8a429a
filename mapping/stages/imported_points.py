"""The points of a reconstruction that a map was imported from, kept beside its landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.archive.npz import read_npz
from visloc.errors import VislocError, refuse

FILE_NAME = "imported_points.npz"
# name -> dtype and columns; None for a vector
_ARRAYS: dict[str, tuple[str, int | None]] = {
    "points": ("<f8", 3),
    "colors": ("|u1", 3),
    "keypoint_offsets": ("<i8", None),
    "keypoints": ("<f4", 2),
    "observations": ("<i8", 3),
}


@dataclass(frozen=True, slots=True, eq=False)
class ImportedPoints:
    """Points and their observations in the photos of a map.

    Attributes:
        points: (P, 3) float64 in the world.
        colors: (P, 3) uint8, or None.
        keypoint_offsets: (n + 1,) int64 rows of ``keypoints``, by photo of the map.
        keypoints: (K, 2) float32 pixels.
        observations: (M, 3) int64 rows: point, photo, keypoint of that photo.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.uint8] | None
    keypoint_offsets: NDArray[np.int64]
    keypoints: NDArray[np.float32]
    observations: NDArray[np.int64]

    def write(self, folder: Path) -> None:
        """Write them into the folder of a map."""
        colors = np.empty((0, 3), np.uint8) if self.colors is None else self.colors
        arrays = {name: getattr(self, name) for name in _ARRAYS} | {"colors": colors}
        with (folder / FILE_NAME).open("wb") as file:
            np.savez(file, **arrays)


def read_imported_points(opened: Map) -> ImportedPoints | None:
    """Read and check the imported points of a map; None if it has none."""
    if FILE_NAME not in opened.manifest.files:
        return None
    path = opened.path / FILE_NAME
    try:
        found = read_npz(path)
    except (OSError, ValueError) as error:
        raise _corrupt(path, str(error)) from error
    if found.keys() != _ARRAYS.keys():
        raise _corrupt(path, ", ".join(sorted(found)))
    for name, (dtype, columns) in _ARRAYS.items():
        array = found[name]
        row = () if columns is None else (columns,)
        if array.dtype != np.dtype(dtype) or array.ndim != 1 + len(row) or array.shape[1:] != row:
            raise _corrupt(path, f"{name} {array.dtype} {array.shape}")
    points, colors, offsets, observations = (
        found[name] for name in ("points", "colors", "keypoint_offsets", "observations")
    )
    counts = np.diff(offsets)
    good = (
        len(offsets) == len(opened.images) + 1
        and offsets[0] == 0
        and offsets[-1] == len(found["keypoints"])
        and bool((offsets[1:] >= offsets[:-1]).all())  # differences may wrap round
        and bool(np.isfinite(points).all())
        and len(colors) in (0, len(points))
        and bool((observations >= 0).all())
        and bool((observations[:, 0] < len(points)).all())
        and bool((observations[:, 1] < len(counts)).all())
        and bool((observations[:, 2] < counts[observations[:, 1]]).all())
    )
    if not good:
        raise _corrupt(path, "rows that do not fit each other or the map")
    return ImportedPoints(
        points, colors if len(colors) else None, offsets, found["keypoints"], observations
    )


def _corrupt(path: Path, got: Any) -> VislocError:
    return refuse("map.imported_points", field=str(path), expected=", ".join(_ARRAYS), got=got)
