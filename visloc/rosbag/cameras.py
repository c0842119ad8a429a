"""``sensor_msgs/CameraInfo`` as a camera."""

from __future__ import annotations

from typing import Any

import numpy as np

from visloc.errors import refuse
from visloc.geometry import Camera

_CORNER = 0.5  # ROS, as OpenCV, counts from the centre of the top-left pixel


def camera_from_info(info: Any, topic: str, *, rectified: bool = False) -> Camera | None:
    """Return the camera of raw pictures; None where it was not calibrated (K is zero).

    That of rectified pictures is P, without distortion.

    ``plumb_bob`` and ``rational_polynomial`` are OpenCV's models of 5 and 8 numbers,
    ``equidistant`` its fisheye model (REP 104 and sensor_msgs/distortion_models).

    Raises:
        DatasetError: ``bag.camera``: a distortion model that we lack; ``camera.*``.
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
    pinhole = (k[0, 0], k[1, 1], k[0, 2] + _CORNER, k[1, 2] + _CORNER)
    size = int(info.width), int(info.height)
    model = info.distortion_model
    if not d.any():
        return Camera("PINHOLE", *size, pinhole)
    if model == "plumb_bob" and len(d) == 5:
        if d[4] == 0:
            return Camera("OPENCV", *size, (*pinhole, *d[:4]))
        return Camera("FULL_OPENCV", *size, (*pinhole, *d, 0.0, 0.0, 0.0))
    if model == "plumb_bob" and len(d) == 4:
        return Camera("OPENCV", *size, (*pinhole, *d))
    if model == "rational_polynomial" and len(d) == 8:
        return Camera("FULL_OPENCV", *size, (*pinhole, *d))
    if model in ("equidistant", "fisheye") and len(d) == 4:
        return Camera("OPENCV_FISHEYE", *size, (*pinhole, *d))
    raise refuse(
        "bag.camera",
        field=topic,
        expected="plumb_bob (4 or 5 numbers), rational_polynomial (8) or equidistant (4)",
        got=f"{model!r} with {len(d)} numbers",
    )
