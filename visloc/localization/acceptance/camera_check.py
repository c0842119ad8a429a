"""Whether a photo contradicts the camera that it was localized with.

A wrong camera gives a pose that is decimetres or metres off with millimetres of covariance. The
matches of one photo often tell: docs/decisions/0027-a-camera-that-is-checked.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.pose.intrinsics import (
    ASPECT,
    FOCAL,
    SHIFT_X,
    SHIFT_Y,
    FoundIntrinsics,
    find_intrinsics,
)
from visloc.pose.reprojection import MatchedView
from visloc.types import CameraSource

# Relative error (standard deviation) of a correct camera: of its focal length, and of fx / fy. A
# calibration is good to one per cent, EXIF hardly better.
_CAMERA_STD = 0.01
# The same of the principal point, in longer sides. A turn of the camera looks like a shift of the
# principal point. So a slightly bent map moves it by a tenth; a crop off the centre moves it more.
_PRINCIPAL_POINT_STD = 0.04
_ESTIMATED_FOCAL_STD = 1.0  # the matches have decided it already
# Sensors are read row by row, within 1/30 s. A camera that tilts by one radian per second meanwhile
# stretches the picture by 3 % across its rows, and fy with it.
_SHUTTER_STD = 0.03
# A contradiction needs two things: the intrinsics found are so many standard deviations away, and
# they fit better by so much (chi-square). The limits for the focal length alone are lower: with the
# principal point and fx / fy there is more freedom to fit wrong matches.
_MAX_DEVIATIONS, _MIN_FOCAL_GAIN = 4.0, 4.0
_MAX_DEVIATIONS_OF_ALL, _MIN_GAIN = 4.5, 12.0
# Fewer inliers beyond those by chance do not tell.
_MIN_INLIERS = 30
_SUBJECTS: Mapping[CameraSource, str] = {
    CameraSource.GIVEN: "the given camera",
    CameraSource.GIVEN_SCALED: "the given camera, scaled to the photo,",
    CameraSource.MAP: "the camera of the map's photos",
    CameraSource.EXIF: "the camera from EXIF",
    CameraSource.ESTIMATED: "the camera found with the pose",
}
_SEND_THE_RIGHT_ONE = "send the camera of these pixels"
_ADVICE: Mapping[CameraSource, str] = {
    CameraSource.GIVEN: "correct the camera, or send none",
    CameraSource.GIVEN_SCALED: "correct the camera, or send none",
    CameraSource.MAP: _SEND_THE_RIGHT_ONE,
    CameraSource.EXIF: _SEND_THE_RIGHT_ONE,
    CameraSource.ESTIMATED: _SEND_THE_RIGHT_ONE,
}
# Standard deviations beyond which the message names a part of the intrinsics as wrong.
_NAMED_DEVIATIONS = 3.0
# From this factor on the message asks for the cause of a wrong focal length.
_NOTABLE_FACTOR = 1.15


def camera_contradiction(
    view: MatchedView,
    source: CameraSource,
    rig_from_world: Pose,
    max_error_px: float,
    *,
    reduced: float = 1.0,
) -> str | None:
    """Say how the matches of a view contradict its camera, and what may be the cause.

    Args:
        view: with all its matches, and the camera that was used.
        reduced: how many pixels of the photo, as it was sent, a side of the view's pixel spans.

    Returns:
        None if they do not contradict it, or are too few to tell.
    """
    found = _contradicting(view, source, rig_from_world, max_error_px)
    return None if found is None else _described(view.camera.reduced(1 / reduced), source, found)


def only_focal_length_contradicts(
    view: MatchedView, source: CameraSource, rig_from_world: Pose, max_error_px: float
) -> bool:
    """Tell whether another focal length alone would do; arguments as ``camera_contradiction``."""
    found = _contradicting(view, source, rig_from_world, max_error_px)
    return found is not None and not _wrong_parts(found, source)[[SHIFT_X, SHIFT_Y, ASPECT]].any()


def _contradicting(
    view: MatchedView, source: CameraSource, rig_from_world: Pose, max_error_px: float
) -> FoundIntrinsics | None:
    """The intrinsics that contradict the camera, if any do."""
    found = find_intrinsics(view, rig_from_world, max_error_px=max_error_px)
    if found is None:
        return None
    with_focal, with_all = found
    if _is_wrong(with_all, _all_deviations(with_all, source), _MAX_DEVIATIONS_OF_ALL, _MIN_GAIN):
        return with_all
    deviations = _focal_deviations(with_focal, source)
    return (
        with_focal if _is_wrong(with_focal, deviations, _MAX_DEVIATIONS, _MIN_FOCAL_GAIN) else None
    )


def _wrong_parts(found: FoundIntrinsics, source: CameraSource) -> NDArray[np.bool_]:
    """Which (4,) of the parts of a change contradict on their own."""
    stds = np.sqrt(np.diag(found.covariance + _tolerance(source)))
    return np.asarray(np.abs(found.change) > _NAMED_DEVIATIONS * stds)


def _is_wrong(
    found: FoundIntrinsics, deviations: float, max_deviations: float, min_gain: float
) -> bool:
    enough = found.num_inliers - found.num_by_chance >= _MIN_INLIERS
    return enough and found.gain > min_gain and deviations > max_deviations


def _focal_deviations(found: FoundIntrinsics, source: CameraSource) -> float:
    std = math.hypot(math.sqrt(found.covariance[FOCAL, FOCAL]), _focal_std(source))
    return float(abs(found.change[FOCAL]) / std)


def _all_deviations(found: FoundIntrinsics, source: CameraSource) -> float:
    total = found.covariance + _tolerance(source)
    return math.sqrt(found.change @ np.linalg.solve(total, found.change))


def _focal_std(source: CameraSource) -> float:
    return _ESTIMATED_FOCAL_STD if source is CameraSource.ESTIMATED else _CAMERA_STD


def _tolerance(source: CameraSource) -> NDArray[np.float64]:
    """Return the covariance (4, 4) of the errors of a correct camera."""
    stds = np.full(4, _CAMERA_STD)
    stds[FOCAL] = _focal_std(source)
    stds[[SHIFT_X, SHIFT_Y]] = _PRINCIPAL_POINT_STD
    shutter = np.zeros(4)
    shutter[[FOCAL, ASPECT]] = 0.5 * _SHUTTER_STD, -_SHUTTER_STD
    return np.asarray(np.diag(stds**2) + np.outer(shutter, shutter))


def _described(camera: Camera, source: CameraSource, found: FoundIntrinsics) -> str:
    """Return a message: the camera's value, the photo's value, and what to do."""
    is_wrong = _wrong_parts(found, source)
    shifted = bool(is_wrong[SHIFT_X] or is_wrong[SHIFT_Y])
    stretched = bool(is_wrong[ASPECT])
    given, said = [], []
    if is_wrong[FOCAL] or not (shifted or stretched):
        std = math.sqrt(found.covariance[FOCAL, FOCAL])
        focal = camera.focal_length * math.exp(found.change[FOCAL])
        given.append(f"a focal length of {camera.focal_length:.0f} px")
        said.append(f"{focal:.0f} +- {std * focal:.0f} px")
    longer_side = max(camera.width, camera.height)
    if shifted:
        x, y = _principal_point(camera)
        shift = longer_side * found.change[[SHIFT_X, SHIFT_Y]]
        std_x, std_y = longer_side * np.sqrt(np.diag(found.covariance)[[SHIFT_X, SHIFT_Y]])
        given.append(f"a principal point at ({x:.0f}, {y:.0f}) px")
        said.append(f"({x + shift[0]:.0f} +- {std_x:.0f}, {y + shift[1]:.0f} +- {std_y:.0f}) px")
    if stretched:
        aspect, std = _aspect(camera), math.sqrt(found.covariance[ASPECT, ASPECT])
        seen = aspect * math.exp(found.change[ASPECT])
        given.append(f"fx / fy of {aspect:.2f}")
        said.append(f"{seen:.2f} +- {std * seen:.2f}")
    cause = _cause(camera, math.exp(found.change[FOCAL]), shifted=shifted, stretched=stretched)
    return (
        f"{_SUBJECTS[source]} has {' and '.join(given)}, but the photo says {' and '.join(said)}: "
        f"{cause}{_ADVICE[source]}"
    )


def _cause(camera: Camera, factor: float, *, shifted: bool, stretched: bool) -> str:
    """Return a question about the likely cause, such as a crop; empty without a guess."""
    x, y = _principal_point(camera)
    turned = abs(x - camera.height / 2) + abs(y - camera.width / 2) < abs(
        x - camera.width / 2
    ) + abs(y - camera.height / 2)
    if shifted and turned:
        return "is it the camera of the photo before it was turned? "
    if stretched:
        return "was the photo stretched? "
    if shifted:
        return "was the photo cropped? "
    if factor > _NOTABLE_FACTOR:
        return "was the photo cropped around its middle, or zoomed? "
    return ""


def _principal_point(camera: Camera) -> tuple[float, float]:
    params = dict(zip(CAMERA_MODELS[camera.model], camera.params, strict=True))
    return params["cx"], params["cy"]


def _aspect(camera: Camera) -> float:
    params = dict(zip(CAMERA_MODELS[camera.model], camera.params, strict=True))
    return params["fx"] / params["fy"] if "fx" in params else 1.0
