"""At which size the features of a photo are found, so that a map knows what it sees.

Local features recognise a detail that has about as many pixels as it had in the mapping photos, and
few of them when it has a quarter more or less. Pixels per radian decide that, not the size of the
photo (docs/decisions/0035-one-resolution.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.features import LocalFeatureExtractor
from visloc.features.framing import AS_IT_IS, Framing, turned_picture, unturned_points
from visloc.geometry import Camera
from visloc.options import Extraction, ReadAs
from visloc.photos.reading import Photo, stored_from_upright, turn_of, upright
from visloc.types import LocalFeatures

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


# What turning by less than 90 degrees puts beside a picture makes keypoints along its edge.
_EDGE_PX = 4


def extract_features(
    photo: Photo,
    extractor: LocalFeatureExtractor,
    *,
    max_keypoints: int,
    read_as: ReadAs = ReadAs.UPRIGHT,
    extraction: Extraction = Extraction.ACCURATE,
    framing: Framing = AS_IT_IS,
) -> tuple[LocalFeatures, NDArray[np.uint8]]:
    """Find the local features of a photo.

    Learned features tolerate little rotation. So the photo is turned first as its EXIF
    orientation asks for, and the keypoints are moved back. It is never mirrored (``turn_of``).

    Args:
        photo: pixels as stored.
        max_keypoints: strongest ones kept, before the mask drops some of them.
        framing: how it is resized before, and turned after that.

    Returns:
        Features with keypoints in the stored pixels, where the photo's mask lets them count, and
        the picture (H, W, 3) that they were found in, which global descriptors are to describe.
    """
    turn = turn_of(photo.exif_orientation) if read_as is ReadAs.UPRIGHT else 1
    width, height = framing.size or (photo.width, photo.height)
    rgb = upright(resized(photo.rgb, width, height), turn)
    if framing.turned == 0:
        local = extractor.extract(rgb, max_keypoints=max_keypoints, extraction=extraction)
    else:
        upright_size = rgb.shape[1], rgb.shape[0]
        rgb = turned_picture(rgb, framing.turned)
        found = extractor.extract(rgb, max_keypoints=max_keypoints, extraction=extraction)
        local = _unturned(found, framing.turned, *upright_size)
    keypoints = stored_from_upright(local.keypoints, turn, width, height)
    if framing.size is not None:
        ratio = np.array([photo.width / width, photo.height / height], np.float32)
        keypoints = keypoints * ratio
        local = replace(local, scales=local.scales * ratio.max())
    return where_counting(photo, replace(local, keypoints=keypoints)), rgb


def where_counting(photo: Photo, local: LocalFeatures) -> LocalFeatures:
    """Drop the features, with keypoints in the stored pixels, that the photo's mask hides."""
    return local if photo.mask is None else local.of(photo.counts(local.keypoints))


def _unturned(found: LocalFeatures, degrees: int, width: int, height: int) -> LocalFeatures:
    """Move features of a turned picture back; those of the edges that turning made are left out."""
    keypoints = unturned_points(found.keypoints, degrees, width, height).astype(np.float32)
    edge = 0 if degrees % 90 == 0 else _EDGE_PX
    inside = (keypoints >= edge) & (keypoints <= [width - edge, height - edge])
    return replace(found, keypoints=keypoints).of(np.asarray(inside.all(axis=1)))
