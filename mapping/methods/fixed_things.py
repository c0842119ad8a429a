"""Things that are fixed to the picture: a bonnet, a selfie stick, a logo, dirt on the lens.

They keep their pixels while everything else moves, and agree with each other in all photos. So
verification may take them for the place, and the camera then seems to stand still.

In a pair of photos of one camera, matches that keep their pixel are compared with the geometry of
the others. Where the camera moved straight ahead, things far away keep their pixels as well, and so
does what lies in the direction of the motion: both fit the geometry of the others. What does not
fit it speaks against its cell of the picture, and others that fit speak for theirs. A cell that
more matches of several pairs speak against than for is masked.

Before a camera that stands still while people walk by, the people are the others. But then hardly a
cell is left that matches speak for alone, as they walk on, and nothing is masked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing

from mapping.methods.two_views import fits_two_views
from visloc.geometry import Camera

Mask = NDArray[np.bool_]
"""Cells (rows, columns) of a camera's picture."""
# Cells along the longer side of a picture.
_CELLS = 24
# Matches keep their pixel when they move by less than this part of the longer side, or this many
# pixels.
_STILL_SHARE, _STILL_PX = 0.0025, 1.5
# Fewer matches that keep their pixel, or move by one geometry, tell nothing about a pair.
_LEAST_STILL, _LEAST_MOVED = 8, 15
# A cell is masked when so many pairs speak against it, by so many times more matches than for it.
_LEAST_PAIRS, _TIMES = 4, 2.0
# Nothing is masked unless matches speak for so large a part of the cells that they tell of, by so
# many times more than against.
_LEAST_FREE, _TIMES_FREE = 0.25, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """What matches say about the cells of one camera's picture.

    Attributes:
        against: (rows, columns) matches that keep their pixel and contradict those that move.
        pairs: (rows, columns) pairs of photos with such matches.
        moved: (rows, columns) matches that move by one geometry.
    """

    against: NDArray[np.int64]
    pairs: NDArray[np.int64]
    moved: NDArray[np.int64]

    @classmethod
    def of(cls, camera: Camera) -> Tally:
        """Return an empty one."""
        return cls(*(np.zeros(_shape(camera), np.int64) for _ in range(3)))

    def add(
        self,
        camera: Camera,
        pixels_a: NDArray[np.floating],
        pixels_b: NDArray[np.floating],
        max_error_px: float,
        *,
        calibrated: bool,
    ) -> None:
        """Count the matched pixels (n, 2) of a pair of photos that the camera took.

        The arguments are those of ``fits_two_views``.
        """
        still = _keep_their_pixel(camera, pixels_a, pixels_b)
        if (~still).sum() < _LEAST_MOVED:
            return
        fits = fits_two_views(
            (camera, camera),
            pixels_a,
            pixels_b,
            max_error_px,
            calibrated=calibrated,
            among=~still,
        )
        moved, against = fits & ~still, still & ~fits
        if moved.sum() < _LEAST_MOVED:
            return
        for pixels in (pixels_a, pixels_b):
            np.add.at(self.moved, _cells(camera, pixels[moved]), 1)
            np.add.at(self.against, _cells(camera, pixels[against]), 1)
        self.pairs[_cells(camera, pixels_a[against])] += 1

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.against + other.against, self.pairs + other.pairs, self.moved + other.moved
        )

    def mask(self) -> Mask | None:
        """Return the cells that show something fixed to the picture, if any do."""
        fixed = (self.pairs >= _LEAST_PAIRS) & (self.against > _TIMES * self.moved)
        free = self.moved > _TIMES_FREE * self.against
        told = self.moved + self.against > 0
        if not fixed.any() or free.sum() < _LEAST_FREE * told.sum():
            return None
        # Few matches tell of cells between others that are masked: they show the same thing.
        return np.asarray(binary_closing(np.pad(fixed, 1), np.ones((3, 3), dtype=bool))[1:-1, 1:-1])


def some_keep_their_pixel(
    camera: Camera, pixels_a: NDArray[np.floating], pixels_b: NDArray[np.floating]
) -> bool:
    """Tell whether more matched pixels (n, 2) of a pair keep their pixel than by chance."""
    return bool(_keep_their_pixel(camera, pixels_a, pixels_b).sum() >= _LEAST_STILL)


def are_masked(camera: Camera, mask: Mask, pixels: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Tell which pixels (n, 2) of a camera's photos lie in masked cells."""
    return np.asarray(mask[_cells(camera, pixels)])


def _keep_their_pixel(
    camera: Camera, pixels_a: NDArray[np.floating], pixels_b: NDArray[np.floating]
) -> NDArray[np.bool_]:
    limit = max(_STILL_PX, _STILL_SHARE * max(camera.width, camera.height))
    return np.asarray(np.linalg.norm(pixels_a - pixels_b, axis=1) <= limit)


def _shape(camera: Camera) -> tuple[int, int]:
    size = max(camera.width, camera.height) / _CELLS
    return max(1, round(camera.height / size)), max(1, round(camera.width / size))


def _cells(
    camera: Camera, pixels: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows and columns (n,) of the cells in which pixels (n, 2) lie."""
    rows, columns = _shape(camera)
    x, y = np.asarray(pixels, np.float64).T
    row = np.clip(y / camera.height * rows, 0, rows - 1)
    column = np.clip(x / camera.width * columns, 0, columns - 1)
    return row.astype(np.int64), column.astype(np.int64)
