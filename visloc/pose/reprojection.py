"""Where points of the map fall in the images, and how that changes with the rig's pose.

What a camera makes of points and pixels is asked of pycolmap, so that all of its models are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import PIL.Image  # noqa: F401  Pillow saves PNGs only when it was imported before pycolmap
import pycolmap
from numpy.typing import NDArray

from visloc.geometry import CAMERA_MODELS, Camera, Pose

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


@dataclass(frozen=True, slots=True, eq=False)
class MatchedView:
    """One camera of a rig and its 2D-3D correspondences; there may be none.

    Attributes:
        cam_from_rig: where it sits; the identity for a camera on its own.
        pixels: (n, 2) float64 in the camera's image; those matched best come first, where that is
            known.
        points: (n, 3) float64 in a world frame whose numbers are not large.
        focal_unknown: the camera's focal length is a guess to be found together with the pose, or
            was found so.
    """

    camera: Camera
    cam_from_rig: Pose
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    focal_unknown: bool = False

    def __len__(self) -> int:
        return len(self.pixels)

    def selected(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> MatchedView:
        """Keep some of the correspondences, by mask or by rows."""
        return replace(self, pixels=self.pixels[which], points=self.points[which])

    @property
    def principal_point(self) -> NDArray[np.float64]:
        """Where the camera looks, (2,) in pixels."""
        params = dict(zip(CAMERA_MODELS[self.camera.model], self.camera.params, strict=True))
        return np.array([params["cx"], params["cy"]])

    def zoomed(self, factor: float) -> MatchedView:
        """Take the correspondences for those of a camera with so many times the focal length."""
        camera = self.camera
        params = tuple(
            value * factor if name in ("f", "fx", "fy") else value
            for name, value in zip(CAMERA_MODELS[camera.model], camera.params, strict=True)
        )
        return replace(self, camera=replace(camera, params=params))


_COMES_BACK_PX = 1.0  # far above what undistortion leaves, far below what is seen beyond 90 degrees


def colmap_camera(camera: Camera) -> pycolmap.Camera:
    """Return the same camera for pycolmap. Pixel conventions are the same."""
    return pycolmap.Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
    )


@lru_cache(maxsize=64)
def _kept_camera(camera: Camera) -> pycolmap.Camera:
    """Return the same as ``colmap_camera``, to be read only; a query asks dozens of times."""
    return colmap_camera(camera)


def pose_from_colmap(rigid: pycolmap.Rigid3d) -> Pose:
    """Return pycolmap's transform as ours, with a rotation that is a copy, not a view."""
    matrix = np.array(rigid.matrix(), dtype=np.float64)
    return Pose(matrix[:, :3], matrix[:, 3])


def normalized_rays(camera: Camera, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the points (N, 3) at depth 1 that pixels (N, 2) see, in the camera's frame.

    A pixel whose undistortion does not converge, or that sees what is beside or behind the camera,
    gives NaN.
    """
    if len(pixels) == 0:
        return np.empty((0, 3))
    plane = np.asarray(_kept_camera(camera).cam_from_img(np.asarray(pixels, dtype=np.float64)))
    rays = np.column_stack([plane, np.ones(len(plane))])
    # pycolmap has points in front of wide cameras for what lies beside them, too.
    rays[~(np.abs(project(camera, rays) - pixels).max(axis=1) < _COMES_BACK_PX)] = np.nan
    return rays


def project(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points (N, 3) in the camera's frame to pixels (N, 2); NaN behind the camera."""
    if len(points) == 0:
        return np.empty((0, 2))
    return np.asarray(_kept_camera(camera).img_from_cam(points))
