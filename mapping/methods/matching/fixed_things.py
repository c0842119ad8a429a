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
from scipy.ndimage import binary_closing, binary_dilation

from mapping.methods.matching.two_views import fits_two_views
from mapping.stages.camera_mask import CameraMask, cells_of, shape_of
from visloc.geometry import Camera

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
        return cls(*(np.zeros(shape_of(camera), np.int64) for _ in range(3)))

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
            np.add.at(self.moved, cells_of(camera, pixels[moved]), 1)
            np.add.at(self.against, cells_of(camera, pixels[against]), 1)
        self.pairs[cells_of(camera, pixels_a[against])] += 1

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.against + other.against, self.pairs + other.pairs, self.moved + other.moved
        )

    def mask(self) -> CameraMask | None:
        """Return the cells that show something fixed to the picture, if any, and those beside."""
        fixed = (self.pairs >= _LEAST_PAIRS) & (self.against > _TIMES * self.moved)
        free = self.moved > _TIMES_FREE * self.against
        told = self.moved + self.against > 0
        if not fixed.any() or free.sum() < _LEAST_FREE * told.sum():
            return None
        # Few matches tell of cells between others that are masked: they show the same thing.
        around = np.ones((3, 3), dtype=bool)
        closed = binary_closing(np.pad(fixed, 1), around)[1:-1, 1:-1]
        # Its edge crosses cells beside it, and keypoints there are described by part of it.
        return np.asarray(binary_dilation(closed, around))


def some_keep_their_pixel(
    camera: Camera, pixels_a: NDArray[np.floating], pixels_b: NDArray[np.floating]
) -> bool:
    """Tell whether more matched pixels (n, 2) of a pair keep their pixel than by chance."""
    return bool(_keep_their_pixel(camera, pixels_a, pixels_b).sum() >= _LEAST_STILL)


def _keep_their_pixel(
    camera: Camera, pixels_a: NDArray[np.floating], pixels_b: NDArray[np.floating]
) -> NDArray[np.bool_]:
    limit = max(_STILL_PX, _STILL_SHARE * max(camera.width, camera.height))
    return np.asarray(np.linalg.norm(pixels_a - pixels_b, axis=1) <= limit)
