"""``sensor_msgs/CameraInfo`` as a camera."""

from __future__ import annotations

from typing import Any

import numpy as np

from visloc.errors import refuse
from visloc.geometry import Camera

_CORNER = 0.5  # ROS, as OpenCV, counts from the centre of the top-left pixel


def camera_from_info(info: Any, topic: str, *, rectified: bool = False) -> Camera | None:
    """Return the camera of raw pictures; None where it was not calibrated (K is zero).

    That of rectified pictures is P, without distortion. K and P are of the whole sensor: the
    pictures show its region of interest (``is_cropped``), binned.

    ``plumb_bob`` and ``rational_polynomial`` are OpenCV's model of up to 8 numbers, ``equidistant``
    its fisheye model of 4 (sensor_msgs/distortion_models). Zeros at the end mean nothing.
    """
    k, d, p = (  # ROS 1 wrote them in capitals
        np.asarray(getattr(info, name.upper() if hasattr(info, name.upper()) else name), np.float64)
        for name in ("k", "d", "p")
    )
    k, p = k.reshape(3, 3), p.reshape(3, 4)
    if rectified and p[0, 0] != 0:
        k, d = p[:, :3], d[:0]
    if k[0, 0] == 0:
        return None
    left, top, wide, high = _region(info)
    if left + wide > info.width or top + high > info.height:
        raise refuse(
            "bag.camera",
            "the region of interest of a camera reaches beyond its sensor",
            field=topic,
            expected=f"within {info.width} x {info.height}",
            got=f"{wide} x {high} at {left}, {top}",
        )
    by_x, by_y = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    pinhole = (
        *(k[0, 0] / by_x, k[1, 1] / by_y),
        *((k[0, 2] + _CORNER - left) / by_x, (k[1, 2] + _CORNER - top) / by_y),
    )
    model, numbers = info.distortion_model, np.trim_zeros(d, "b")
    fits = {"PINHOLE": 0}
    if model in ("plumb_bob", "rational_polynomial"):
        fits |= {"OPENCV": 4, "FULL_OPENCV": 8}
    elif model in ("equidistant", "fisheye") and len(d) > 0:  # without distortion, too
        fits = {"OPENCV_FISHEYE": 4}
    ours = next((each for each, most in fits.items() if len(numbers) <= most), None)
    if ours is None:
        raise refuse(
            "bag.camera",
            field=topic,
            expected="plumb_bob or rational_polynomial (up to 8 numbers) or equidistant (up to 4)",
            got=f"{model!r} with {len(numbers)} numbers",
        )
    distortion = np.pad(numbers, (0, fits[ours] - len(numbers))).tolist()
    return Camera(ours, wide // by_x, high // by_y, (*pinhole, *distortion))


def is_cropped(info: Any) -> bool:
    """Tell whether pictures show only a part of the sensor, so that another size is no scaling."""
    return _region(info) != (0, 0, int(info.width), int(info.height))


def _region(info: Any) -> tuple[int, int, int, int]:
    """Return left, top, width and height of what is read of the sensor, before binning."""
    roi = info.roi
    left, top = int(roi.x_offset), int(roi.y_offset)
    return left, top, int(roi.width) or info.width - left, int(roi.height) or info.height - top
