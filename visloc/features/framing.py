"""How a photo is resized and turned before its features are found, and how keypoints come back."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Framing:
    """What is done to a photo beside its EXIF orientation.

    Attributes:
        size: width and height to which the stored pixels are resized; None to leave them.
        turned: degrees, 0 to 359, by which the upright picture is then turned clockwise.
    """

    size: tuple[int, int] | None = None
    turned: int = 0


AS_IT_IS = Framing()


def turned_picture(rgb: NDArray[np.uint8], degrees: int) -> NDArray[np.uint8]:
    """Turn pixels (H, W, 3) clockwise; corners that nothing fills get the mean colour."""
    if degrees % 90 == 0:
        return np.ascontiguousarray(np.rot90(rgb, -degrees // 90))
    height, width = rgb.shape[:2]
    # OpenCV counts pixels from the centre of the first one, we from its corner.
    corner = turned_points(np.array([[0.5, 0.5]]), degrees, width, height)[0] - 0.5
    affine = np.column_stack([_rotation(degrees), corner])
    mean = tuple(rgb.reshape(-1, 3).mean(axis=0).tolist())
    size = turned_size(width, height, degrees)
    turned = cv2.warpAffine(rgb, affine, size, flags=cv2.INTER_LINEAR, borderValue=mean)
    return np.asarray(turned, np.uint8)


def turned_points(
    points: NDArray[np.floating], degrees: int, width: int, height: int
) -> NDArray[np.float64]:
    """Move points (N, 2) of a picture of this size along with ``turned_picture``."""
    turned = np.array(turned_size(width, height, degrees)) / 2
    return np.asarray((points - [width / 2, height / 2]) @ _rotation(degrees).T + turned)


def unturned_points(
    points: NDArray[np.floating], degrees: int, width: int, height: int
) -> NDArray[np.float64]:
    """Move points (N, 2) of the turned picture back to the picture of this size."""
    turned = np.array(turned_size(width, height, degrees)) / 2
    return np.asarray((points - turned) @ _rotation(degrees) + [width / 2, height / 2])


def _rotation(degrees: int) -> NDArray[np.float64]:
    # Exact for quarter turns. Clockwise, as y points down.
    quarter = degrees % 360 // 90 if degrees % 90 == 0 else None
    angle = np.radians(degrees)
    cosine = np.cos(angle) if quarter is None else (1.0, 0.0, -1.0, 0.0)[quarter]
    sine = np.sin(angle) if quarter is None else (0.0, 1.0, 0.0, -1.0)[quarter]
    return np.array([[cosine, -sine], [sine, cosine]])


def turned_size(width: int, height: int, degrees: int) -> tuple[int, int]:
    """Return the width and height of a picture of this size after ``turned_picture``."""
    turned = np.abs(_rotation(degrees)) @ [width, height]
    # Rounding hides that sums of products of sines are whole numbers.
    wide, high = np.ceil(np.round(turned, 6)).astype(int)
    return int(wide), int(high)
