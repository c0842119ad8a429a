"""Ready-made keypoints and descriptors, checked against each other and the image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.geometry import MAX_IMAGE_SIDE, PixelOrigin
from visloc.kapture.feature_reader import FeatureSet


def read_local(
    keypoints: FeatureSet,
    descriptors: FeatureSet,
    image_path: str,
    image_size: tuple[int, int] | None,
    origin: PixelOrigin,
) -> tuple[NDArray[np.float32], NDArray[Any]]:
    """Read the keypoints and descriptors of one image.

    Files have no header, and published ones contradict their config file. Numbers that cannot be
    pixels of the image are therefore refused.

    Args:
        keypoints: the files of the keypoints.
        descriptors: the files of their descriptors.
        image_path: as in ``records_camera.txt``.
        image_size: width and height; None checks only against the largest possible image.
        origin: the pixel origin of the keypoints.

    Returns:
        (N, 2) float32 x, y in pixels, top-left centre at (0.5, 0.5), and the descriptors (N, D)
        in their own type. N may be 0.

    Raises:
        DatasetError: with the file: ``kapture.feature_count``, ``kapture.feature_values``,
            ``kapture.feature_pixels``, and what ``FeatureSet.read`` raises.
    """
    rows, described = keypoints.read(image_path), descriptors.read(image_path)
    if len(rows) != len(described):
        raise refuse(
            "kapture.feature_count",
            field=keypoints.label(image_path),
            got=f"{len(rows)} keypoints of {keypoints.dsize} {keypoints.dtype.name}, "
            f"{len(described)} descriptors of {descriptors.dsize} {descriptors.dtype.name}",
            keypoints=len(rows),
            descriptors=len(described),
            file=descriptors.label(image_path),
        )
    for features, array in ((keypoints, rows), (descriptors, described)):
        finite = np.isfinite(array).all(axis=1)
        if not finite.all():
            raise refuse(
                "kapture.feature_values",
                field=features.label(image_path),
                expected=f"finite {features.dtype.name}",
                row=int(np.argmin(finite)),
                what=features.kind,
            )
    pixels = rows[:, :2].astype(np.float64)
    if len(pixels):
        _check_pixels(pixels, keypoints, image_path, image_size)
    return (pixels + origin.shift).astype(np.float32), described


def _check_pixels(
    pixels: NDArray[np.float64],
    keypoints: FeatureSet,
    image_path: str,
    image_size: tuple[int, int] | None,
) -> None:
    size = np.array(image_size or (MAX_IMAGE_SIDE, MAX_IMAGE_SIDE))
    inside = ((pixels >= -1) & (pixels <= size)).all(axis=1)
    magnitude = np.abs(pixels)
    # Half of a float64, or an integer, read as float32 is often far smaller than any coordinate of
    # a detector. Single values such as 1e-8 do come from rounding.
    tiny = ((magnitude > 0) & (magnitude < 1e-6)).any(axis=1)
    example = int(np.argmin(inside))
    if not inside.all():
        what = (
            f"keypoint {example} lies outside the image; the dtype is not what keypoints.txt "
            "says, or the photo has another size, or these are not pixels"
        )
    elif 4 * np.count_nonzero(tiny) > len(pixels):
        example = int(np.argmax(tiny))
        what = (
            f"keypoint {example}, like many, is next to 0; the dtype is not what keypoints.txt says"
        )
    elif (magnitude < 1).all():
        what = "all keypoints are below 1: these are normalized units, not pixels"
    else:
        return
    width, height = (f"{side}" for side in size)
    raise refuse(
        "kapture.feature_pixels",
        what,
        field=keypoints.label(image_path),
        expected=f"pixels of a photo of {width} x {height}, as {keypoints.dtype.name}",
        got=f"x {pixels[example, 0]:.6g}, y {pixels[example, 1]:.6g}",
    )
