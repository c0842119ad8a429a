"""Poses, cameras and their conventions (docs/conventions.md).

``a_from_b`` maps coordinates of frame b to frame a, so that
``cam_from_world = cam_from_rig @ rig_from_world`` reads right by eye.
Pixels as in COLMAP: the centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visloc.errors import refuse

# COLMAP's camera models that kapture knows, with their parameters in COLMAP's order.
CAMERA_MODELS: Mapping[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": (
        *("fx", "fy", "cx", "cy"),
        *("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    ),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": (
        *("fx", "fy", "cx", "cy"),
        *("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    ),
}

MAX_IMAGE_SIDE = 1_000_000
# Parameters that scale with the width (first set) and with the height (second) of the image.
_SCALES_WITH_WIDTH = {"f", "fx", "cx"}
_SCALES_WITH_HEIGHT = {"fy", "cy"}
# Rounding the sides of a thumbnail to whole pixels moves its aspect by up to half a pixel on each
# side; 0.5 % covers that from 100 px on. Below, the tolerance grows, but never beyond 2 %.
_ASPECT_TOLERANCE = 0.005
_MAX_ASPECT_TOLERANCE = 0.02


class PixelOrigin(StrEnum):
    """Where a dataset's principal points and ready-made keypoints count from."""

    CORNER = "corner"  # the centre of the top-left pixel is (0.5, 0.5), as here and in COLMAP
    CENTER = "center"  # ... is (0, 0), as array indices are

    @property
    def shift(self) -> float:
        """The offset to add to its pixel coordinates to get ours."""
        return 0.5 if self is PixelOrigin.CENTER else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid transform, named at the variable: ``a_from_b`` gives ``x_a = R @ x_b + t``.

    Attributes:
        rotation: (3, 3) float64, orthonormal, determinant +1.
        translation: (3,) float64, in frame a, in the unit of the world (metres when metric).
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @staticmethod
    def identity() -> Pose:
        """Return the transform that changes nothing."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_quaternion(rotation_wxyz: ArrayLike, translation: ArrayLike) -> Pose:
        """Make a pose from a quaternion (w, x, y, z), normalized here, and a translation (3,).

        Raises:
            InvalidInput: ``pose.rotation`` or ``pose.translation`` for a wrong shape, numbers
                that are not finite, or a quaternion shorter than 1e-6.
        """
        q = np.asarray(rotation_wxyz, dtype=np.float64)
        t = np.asarray(translation, dtype=np.float64)
        norm = math.hypot(*q) if q.shape == (4,) else math.nan  # no overflow on the way
        if not (math.isfinite(norm) and norm >= 1e-6):
            raise refuse("pose.rotation", field="rotation", got=rotation_wxyz)
        if t.shape != (3,) or not np.isfinite(t).all():
            raise refuse(
                "pose.translation",
                field="translation",
                expected="three finite numbers",
                got=translation,
            )
        return Pose(_matrix_from_quaternion(q / norm), t)

    @property
    def rotation_wxyz(self) -> NDArray[np.float64]:
        """The rotation as a unit quaternion (w, x, y, z) with w >= 0, shape (4,)."""
        return _quaternion_from_matrix(self.rotation)

    @property
    def center(self) -> NDArray[np.float64]:
        """The origin of frame a in frame b, (3,): of ``cam_from_world``, the camera's position."""
        return -self.rotation.T @ self.translation

    def __matmul__(self, other: Pose) -> Pose:
        """Chain: ``a_from_b @ b_from_c = a_from_c``."""
        return Pose(self.rotation @ other.rotation, self.apply(other.translation))

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move points (..., 3) in frame b to frame a."""
        return points @ self.rotation.T + self.translation

    def inverse(self) -> Pose:
        """Turn a_from_b into b_from_a."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """A change of frame and unit: ``a_from_b`` gives ``x_a = scale R @ x_b + t``.

    Attributes:
        scale: units of frame a in one unit of frame b; positive.
        rotation: (3, 3) float64, orthonormal, determinant +1.
        translation: (3,) float64, in frame a and its unit.
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @staticmethod
    def identity() -> Similarity:
        """Return the similarity that changes nothing."""
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def __matmul__(self, other: Similarity) -> Similarity:
        """Chain: ``a_from_b @ b_from_c = a_from_c``."""
        return Similarity(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.apply(other.translation),
        )

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move points (..., 3) in frame b to frame a."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def inverse(self) -> Similarity:
        """Turn a_from_b into b_from_a."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def move(self, cam_from_b: Pose) -> Pose:
        """Return cam_from_a of a camera whose cam_from_b is given, in the unit of frame a.

        Its centre is moved like any point: ``x_cam`` of the result is ``scale`` times that before.
        """
        center = self.apply(cam_from_b.center)
        rotation = cam_from_b.rotation @ self.rotation.T
        return Pose(rotation, -rotation @ center)


def cross_matrix(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix (3, 3) with which v x u = matrix @ u."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rotation_angle(rotation: NDArray[np.float64]) -> float:
    """Return the angle of a rotation matrix (3, 3) in radians, 0 to pi.

    atan2 instead of the usual arc cosine of the trace, because acos loses half of the digits
    near zero, which is where a good localizer lives.
    """
    r = rotation
    two_sin = np.linalg.norm([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return float(np.arctan2(two_sin, np.trace(r) - 1.0))


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of one camera, checked when made.

    Attributes:
        model: a key of ``CAMERA_MODELS``.
        width: image width in pixels.
        height: image height in pixels.
        params: parameters in COLMAP's order, pixels where they are lengths.

    Raises:
        InvalidInput: ``camera.model``, ``camera.size``, ``camera.param_count`` or
            ``camera.param_value``, with the field that is wrong.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        names = CAMERA_MODELS.get(self.model)
        if names is None:
            raise refuse(
                "camera.model", field="camera.model", expected=CAMERA_MODELS, got=self.model
            )
        if not (0 < self.width <= MAX_IMAGE_SIDE and 0 < self.height <= MAX_IMAGE_SIDE):
            raise refuse(
                "camera.size",
                field="camera.width" if not 0 < self.width <= MAX_IMAGE_SIDE else "camera.height",
                expected=f"1 to {MAX_IMAGE_SIDE} pixels",
                got=f"{self.width} x {self.height}",
            )
        if len(self.params) != len(names):
            raise refuse(
                "camera.param_count",
                field="camera.params",
                expected=f"{len(names)}: {', '.join(names)}",
                got=len(self.params),
                model=self.model,
            )
        for name, value in zip(names, self.params, strict=True):
            positive = name in ("f", "fx", "fy")
            if not math.isfinite(value) or (positive and value <= 0):
                raise refuse(
                    "camera.param_value",
                    field="camera.params",
                    expected=f"{name} to be a {'positive ' if positive else ''}finite number",
                    got=value,
                    name=name,
                )

    @staticmethod
    def from_text(text: str) -> Camera:
        """Parse ``MODEL,width,height,params...``, separated by commas or blanks.

        Raises:
            InvalidInput: as the constructor, and ``camera.syntax``.
        """
        model, *rest = text.replace(",", " ").split() or [""]
        try:
            width, height = (_whole(field) for field in rest[:2])
            params = tuple(float(field) for field in rest[2:])
        except ValueError:
            raise refuse("camera.syntax", field="camera", got=text) from None
        return Camera(model, width, height, params)

    @property
    def focal_length(self) -> float:
        """Focal length in pixels; the mean of both where the model has two."""
        names = CAMERA_MODELS[self.model]
        focal = [v for n, v in zip(names, self.params, strict=True) if n in ("f", "fx", "fy")]
        return sum(focal) / len(focal)

    def has_aspect_of(self, width: int, height: int) -> bool:
        """Tell whether width x height could be this camera's image, resized."""
        ratio = (width * self.height) / (height * self.width)
        rounding = 0.5 / min(width, height, self.width, self.height)
        tolerance = min(max(_ASPECT_TOLERANCE, rounding), _MAX_ASPECT_TOLERANCE)
        return abs(ratio - 1.0) <= tolerance

    def scaled(self, width: int, height: int) -> Camera:
        """Return this camera for its image resized to width x height.

        (u, v) goes to (u * width / self.width, v * height / self.height), which is exact
        because pixel coordinates start at the corner of the image, not at a pixel centre.
        """
        return self._times(width / self.width, height / self.height, width, height)

    def reduced(self, by: float) -> Camera:
        """Return this camera for its image with sides divided by a number.

        (u, v) goes to (u / by, v / by). Columns and rows that fill no pixel are left out, except
        the first ones.
        """
        width, height = (max(1, int(side / by)) for side in (self.width, self.height))
        return self._times(1 / by, 1 / by, width, height)

    def _times(self, sx: float, sy: float, width: int, height: int) -> Camera:
        factors = dict.fromkeys(_SCALES_WITH_WIDTH, sx) | dict.fromkeys(_SCALES_WITH_HEIGHT, sy)
        params = tuple(
            value * factors.get(name, 1.0)
            for name, value in zip(CAMERA_MODELS[self.model], self.params, strict=True)
        )
        return Camera(self.model, width, height, params)

    def with_pixels_from(self, origin: PixelOrigin) -> Camera:
        """Return this camera in our convention, when its principal point counts from ``origin``."""
        params = tuple(
            value + origin.shift if name in ("cx", "cy") else value
            for name, value in zip(CAMERA_MODELS[self.model], self.params, strict=True)
        )
        return Camera(self.model, self.width, self.height, params)


def _whole(field: str) -> int:
    value = float(field)
    if not value.is_integer():  # also false for NaN and infinity
        raise ValueError(field)
    return int(value)


def _matrix_from_quaternion(q: NDArray[np.float64]) -> NDArray[np.float64]:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion_from_matrix(r: NDArray[np.float64]) -> NDArray[np.float64]:
    # Shepperd's method: divide by the largest component, so that no rotation is badly scaled.
    trace = np.trace(r)
    squares = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    largest = int(np.argmax(squares))
    if largest == 0:
        q = np.array([1 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = r[k, j] - r[j, k]
        q[1 + i] = 1 + r[i, i] - r[j, j] - r[k, k]
        q[1 + j] = r[j, i] + r[i, j]
        q[1 + k] = r[k, i] + r[i, k]
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


def center_covariance(
    device_from_world: Pose, covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of (w, dc) from that of (w, dt).

    dc is the shift of the centre c = -R^T t in the world: R <- Exp(w) R and t <- t + dt move it by
    -R^T (dt + [t] w), with [t] the matrix of the cross product.
    """
    inverse = -device_from_world.rotation.T
    jacobian = np.eye(6)
    jacobian[3:, :3] = inverse @ cross_matrix(device_from_world.translation)
    jacobian[3:, 3:] = inverse
    return propagated(jacobian, covariance)


def covariance_from_center(
    device_from_world: Pose, covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of (w, dt) from that of (w, dc).

    The inverse of ``center_covariance``.
    """
    jacobian = np.eye(6)
    jacobian[3:, :3] = -cross_matrix(device_from_world.translation)
    jacobian[3:, 3:] = -device_from_world.rotation
    return propagated(jacobian, covariance)


def propagated(
    jacobian: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance (m, m) of J x from that (n, n) of x, with J (m, n), symmetric."""
    product = jacobian @ covariance @ jacobian.T
    return np.asarray((product + product.T) / 2)
