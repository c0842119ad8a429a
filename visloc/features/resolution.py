"""At which size the features of a photo are found, so that a map knows what it sees.

Local features recognise a detail that has about as many pixels as it had in the mapping photos, and
few of them when it has a quarter more or less. Pixels per radian decide that, not the size of the
photo (docs/decisions/0035-one-resolution.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Camera

# Resolutions that differ by less count as the same: matches are not lost yet, and a photo that was
# not resized has the sharper pixels.
_ALIKE = 1.1
# A reduction that is so near to a whole number is taken for it.
_NEARLY = 1.05
# No photo is reduced to less. A long lens shows little of what a mapping photo shows.
_LEAST_LONG_SIDE_PX = 320


@dataclass(frozen=True, slots=True)
class Resolution:
    """How finely a photo sees.

    Attributes:
        long_side: pixels.
        focal_length: pixels, which are pixels per radian in the middle of the photo; None when
            nobody knows the camera.
    """

    long_side: float
    focal_length: float | None

    @staticmethod
    def of(camera: Camera, *, known: bool = True) -> Resolution:
        """Return that of a camera, whose focal length may be a guess instead of ``known``."""
        return Resolution(max(camera.width, camera.height), camera.focal_length if known else None)

    def shrunk_to(self, most_px: float | None) -> Resolution:
        """Return that of the photo shrunk until its longer side has at most ``most_px``."""
        scale = 1.0 if most_px is None else min(1.0, most_px / self.long_side)
        focal_length = None if self.focal_length is None else self.focal_length * scale
        return Resolution(self.long_side * scale, focal_length)

    def over(self, other: Resolution) -> float:
        """Say how many times as finely this photo sees, by width where a camera is not known."""
        if self.focal_length is None or other.focal_length is None:
            return self.long_side / other.long_side
        return self.focal_length / other.focal_length


@dataclass(frozen=True, slots=True)
class WorkingResolution:
    """How finely the photos of a map see: as finely as a quarter of them or more.

    Attributes:
        stored: in the pixels of their files.
        seen: in the pixels that the local features looked at.
        most_px: the longer side to which the local features shrink photos; None when they do not.
    """

    stored: Resolution
    seen: Resolution
    most_px: float | None

    @staticmethod
    def of(
        photos: Sequence[Resolution], parameters: Mapping[str, int | float | str]
    ) -> WorkingResolution:
        """Return that of the photos of a map, one or more.

        Args:
            photos: how finely each of them sees.
            parameters: of the local features.
        """
        most = parameters.get("max_long_side_px")
        most_px = float(most) if isinstance(most, int | float) and most > 0 else None
        seen = [photo.shrunk_to(most_px) for photo in photos]
        return WorkingResolution(_finer(photos), _finer(seen), most_px)

    def feature_size(
        self, photo: Resolution, width: int, height: int, turned: int = 0
    ) -> tuple[int, int] | None:
        """Return the width and height at which the features of a photo are to be found.

        Args:
            photo: how finely it sees.
            width: of the photo as stored, pixels.
            height: of the photo as stored, pixels.
            turned: degrees by which it is turned then.

        Returns:
            None for its own size.
        """
        seen, long_side = photo.shrunk_to(self.most_px), max(width, height)
        finer = seen.over(self.seen)
        if 1 / _ALIKE <= finer <= _ALIKE:
            # Local features would see as much in the photo itself, but not as fast.
            scale = 1 / self.finer(photo)
        else:
            least = min(_LEAST_LONG_SIDE_PX, seen.long_side, self.seen.long_side)
            # Never enlarged: more keypoints of the same pixels have errors alike, so that stated
            # uncertainties are too small, and wrong poses have more inliers.
            scale = min(max(seen.long_side / finer, least), seen.long_side) / long_side
        if turned != 0 and self.most_px is not None:
            # Askew, a long narrow photo fills a picture of many times its pixels.
            scale = min(scale, self.most_px / long_side)
        scale = 1 / _whole(1 / scale)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        return None if size == (width, height) else size

    def finer(self, photo: Resolution) -> float:
        """Return by how much a photo is to be reduced to have pixels like those of mapping photos.

        Thresholds in pixels mean the same in the reduced photo as in them. 1 for photos that are
        not finer; their own pixels are the larger ones. In a photo of a few pixels, all matches
        would agree with any pose.
        """
        least = min(_LEAST_LONG_SIDE_PX, photo.long_side, self.stored.long_side)
        finer = min(photo.over(self.stored), photo.long_side / least)
        return _whole(finer) if finer > _ALIKE else 1.0


def resized(rgb: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Reduce pixels (H, W, 3), averaging them."""
    if (width, height) == (rgb.shape[1], rgb.shape[0]):
        return rgb
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _finer(photos: Sequence[Resolution]) -> Resolution:
    long_side = _upper_quartile(photo.long_side for photo in photos)
    focal = [photo.focal_length for photo in photos if photo.focal_length is not None]
    return Resolution(long_side, _upper_quartile(focal) if focal else None)


def _whole(reduction: float) -> float:
    """Return the whole number beside a reduction, if there is one: it blurs no pixels."""
    whole = max(1.0, float(round(min(reduction, 1e6))))
    return whole if 1 / _NEARLY < reduction / whole < _NEARLY else reduction


def _upper_quartile(values: Iterable[float]) -> float:
    # Of two sizes, the larger one if a quarter of the photos have it: photos that are reduced are
    # placed less exactly.
    ordered = sorted(values)
    return ordered[3 * len(ordered) // 4]
