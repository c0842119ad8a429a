"""Where points of the map fall in the images, and how that changes with the rig's pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose
from visloc.pose.colmap import project
from visloc.pose.views import MatchedView

# No derivative of a point that a camera sees well is nearly as large, and its square is a number.
_MAX_DERIVATIVE = 1e100
# Six projections of shifted points take most of the time of a refinement, so the models that most
# cameras have do without.
_PINHOLES = frozenset({"SIMPLE_PINHOLE", "PINHOLE"})


def reprojection_errors(view: MatchedView, rig_from_world: Pose) -> NDArray[np.float64]:
    """Return the distances (n,) in pixels; NaN for points behind the camera."""
    seen = (view.cam_from_rig @ rig_from_world).apply(view.points)
    x, y = (project(view.camera, seen) - view.pixels).T
    return np.asarray(np.hypot(x, y))


def linearized(
    views: Sequence[MatchedView], rig_from_world: Pose, about: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the reprojection errors of all views and their derivatives by the rig's pose.

    Args:
        views: at least one.
        rig_from_world: where to linearize.
        about: (3,) the point in the rig's frame that rotations leave in place. The pose changes by
            x <- about + Exp(w) (x - about) + dt: with zero from the left as a whole, as in
            ``visloc.pose.motion``; with the pose's translation by R <- Exp(w) R, t <- t + dt.

    Returns:
        (n, 2) errors in pixels, projected less seen, NaN behind the camera; (n, 2, 6) their
        derivatives by w (rad), then dt, NaN also at the very edge of what the camera sees. Where a
        focal length is unknown (n, 2, 7), with those by its logarithm. Its transpose lies in one
        piece of memory.
    """
    errors, derivatives = [], []
    num_parameters = 7 if any(view.focal_unknown for view in views) else 6
    for view in views:
        in_rig = rig_from_world.apply(view.points)
        pixels, by_point = _projected(view.camera, view.cam_from_rig.apply(in_rig))
        errors.append(pixels - view.pixels)
        # One row per derivative: whatever is summed or multiplied later runs along rows.
        rows = np.empty((num_parameters, 2, len(view)))
        np.einsum("ij,ian->jan", view.cam_from_rig.rotation, by_point, out=rows[3:6])
        # a . (w x arm) = w . (arm x a)
        a, b, c = rows[3:6]
        x, y, z = np.ascontiguousarray((in_rig - about).T)
        rows[0] = y * c - z * b
        rows[1] = z * a - x * c
        rows[2] = x * b - y * a
        if view.focal_unknown:  # every model multiplies by it at last, then adds the centre
            rows[6] = (pixels - view.principal_point).T
        derivatives.append(rows)
    whole = derivatives[0] if len(derivatives) == 1 else np.concatenate(derivatives, axis=2)
    return np.concatenate(errors), whole.T


def has_derivative(errors: NDArray[np.float64], jacobian: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which (n,) of the rows of ``linearized`` are numbers.

    Those that are not say nothing about how errors change with the pose. A camera of 180 degrees
    sees points so close to its edge that a step of the difference leaves the view.
    """
    known = np.abs(jacobian.T).max(axis=(0, 1), initial=0.0) < _MAX_DERIVATIVE  # False for NaN
    x, y = errors.T
    return np.asarray(known & np.isfinite(x) & np.isfinite(y))


def _projected(
    camera: Camera, in_cam: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (n, 2) of points, NaN behind the camera, and their derivatives (3, 2, n)."""
    if camera.model in _PINHOLES:
        return project(camera, in_cam), _pinhole_derivatives(camera, in_cam)
    x, y, z = in_cam.T  # column by column: a sum over rows of three takes four times as long
    # Central differences work for every camera model; their error is about 1e-9 relative.
    step = 1e-5 * np.sqrt(x * x + y * y + z * z)
    shifted = np.empty((7, *in_cam.shape))
    shifted[:] = in_cam
    for axis in range(3):
        shifted[1 + axis, :, axis] += step
        shifted[4 + axis, :, axis] -= step
    # All at once: with few points, the calls take longer than the work.
    pixels = project(camera, shifted.reshape(-1, 3)).reshape(7, -1, 2)
    by_point = np.empty((3, 2, len(in_cam)))
    np.divide((pixels[1:4] - pixels[4:]).transpose(0, 2, 1), 2 * step, out=by_point)
    return pixels[0], by_point


def _pinhole_derivatives(camera: Camera, in_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives (3, 2, n) of (fx x / z, fy y / z); not numbers where z is 0."""
    x, y, z = in_cam.T
    focal_x, focal_y = camera.params[0], camera.params[-3]  # one and the same, or two
    by_point = np.zeros((3, 2, len(in_cam)))
    with np.errstate(divide="ignore", invalid="ignore"):
        np.divide(focal_x, z, out=by_point[0, 0])
        np.divide(focal_y, z, out=by_point[1, 1])
        by_point[2, 0] = -by_point[0, 0] * (x / z)
        by_point[2, 1] = -by_point[1, 1] * (y / z)
    return by_point
