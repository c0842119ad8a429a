"""Uncertain poses at another centre or in a map with errors, and motion between instants.

Inside the window of a sequence, an uncertain pose is perturbed from the left as a whole,
pose <- (Exp(w), dt) @ pose, w (rad) before dt: both are then read in the rig's own frame, and no
covariance depends on how far away the world's origin is. Elsewhere, and in ``RelativeMotion``,
the convention is R <- Exp(w) R, t <- t + dt; ``UncertainPose.from_additive`` and ``additive``
change between the two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose, Similarity, cross_matrix, rotation_angle
from visloc.types import Uncertainty

# What is assumed of a motion that came without a covariance: a wheel's or a phone's odometry.
DEFAULT_ROTATION_STD = math.radians(0.2)
DEFAULT_TRANSLATION_STD = 0.01
DEFAULT_STD_SHARE = 0.02  # in addition, of the angle and of the distance

# Nothing is known better than this (0.002 degrees, 0.1 mm): sums stay well conditioned.
_BEST_STD = np.array([3.5e-5] * 3 + [1e-4] * 3)
# A link that is known no better than this (20 degrees, 20 m) says nothing, and is beyond what
# a linear propagation can carry.
_WORST_STD = np.array([0.35] * 3 + [20.0] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class RelativeMotion:
    """How the rig moved from one instant to the next, as odometry tells it.

    Attributes:
        current_from_previous: the rig's frame at the earlier instant to that at the later one.
        covariance: (6, 6) of rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt;
            positive definite.
    """

    current_from_previous: Pose
    covariance: NDArray[np.float64]


def default_motion_covariance(motion: Pose) -> NDArray[np.float64]:
    """What to assume of a motion without a stated covariance, (6, 6) as in ``RelativeMotion``.

    Standard deviations per axis: 0.2 degrees plus 2 % of the angle, 1 cm plus 2 % of the
    distance (the map being metric).
    """
    angle = DEFAULT_ROTATION_STD + DEFAULT_STD_SHARE * rotation_angle(motion.rotation)
    distance = DEFAULT_TRANSLATION_STD + DEFAULT_STD_SHARE * float(
        np.linalg.norm(motion.translation)
    )
    return np.diag([angle**2] * 3 + [distance**2] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class UncertainPose:
    """A pose, or a motion, with the covariance (6, 6) of (w, dt) in (Exp(w), dt) @ pose."""

    pose: Pose
    covariance: NDArray[np.float64]

    @staticmethod
    def from_additive(pose: Pose, covariance: NDArray[np.float64]) -> UncertainPose:
        """Read a covariance that is for R <- Exp(w) R, t <- t + dt."""
        change = np.eye(6)
        change[3:, :3] = cross_matrix(pose.translation)
        return UncertainPose(pose, change @ covariance @ change.T + np.diag(_BEST_STD**2))

    def additive(self) -> NDArray[np.float64]:
        """The covariance (6, 6) for R <- Exp(w) R, t <- t + dt."""
        change = np.eye(6)
        change[3:, :3] = -cross_matrix(self.pose.translation)
        return np.asarray(change @ self.covariance @ change.T)

    def __matmul__(self, other: UncertainPose) -> UncertainPose:
        """Chain two whose errors are independent."""
        carry = adjoint(self.pose)
        return UncertainPose(
            self.pose @ other.pose, self.covariance + carry @ other.covariance @ carry.T
        )

    def inverse(self) -> UncertainPose:
        """The way back."""
        back = self.pose.inverse()
        carry = adjoint(back)
        return UncertainPose(back, carry @ self.covariance @ carry.T)

    def scaled(self, factor: float) -> UncertainPose:
        """The same pose with ``factor`` times the covariance."""
        return UncertainPose(self.pose, factor * self.covariance)


def link_from_motion(motion: RelativeMotion | None) -> UncertainPose | None:
    """A motion as a link of the chain; None when it is unknown or as good as unknown."""
    if motion is None:
        return None
    link = UncertainPose.from_additive(motion.current_from_previous, motion.covariance)
    return link if (np.diag(link.covariance) < _WORST_STD**2).all() else None


def chain(links: Sequence[UncertainPose], start: int, end: int) -> UncertainPose:
    """The motion from instant ``start`` to ``end``, either way, over links[i] from i to i + 1."""
    if end < start:
        return chain(links, end, start).inverse()
    total = UncertainPose(Pose.identity(), np.zeros((6, 6)))
    for link in links[start:end]:
        total = link @ total
    return total


def difference(pose: Pose, other: Pose) -> NDArray[np.float64]:
    """The (w, dt) (6,) that makes ``pose`` of ``other``: pose = (Exp(w), dt) @ other."""
    change = pose @ other.inverse()
    cosine, *sines = change.rotation_wxyz  # of half the angle
    sine = math.hypot(*sines)
    # The angle per sine is 2 where both vanish.
    w = np.array(sines) * (2.0 * math.atan2(sine, cosine) / sine if sine > 0 else 2.0)
    return np.concatenate([w, change.translation])


def moved(pose: Pose, change: NDArray[np.float64]) -> Pose:
    """(Exp(w), dt) @ pose, for change = (w, dt)."""
    half = 0.5 * math.hypot(*change[:3])
    quaternion = [math.cos(half), *(0.5 * np.sinc(half / math.pi) * change[:3])]
    return Pose.from_quaternion(quaternion, change[3:]) @ pose


def adjoint(pose: Pose) -> NDArray[np.float64]:
    """The matrix (6, 6) that takes (w, dt) through a pose.

    pose @ (Exp(w), dt) = (Exp(w'), dt') @ pose, to first order, with (w', dt') = matrix @ (w, dt).
    """
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = pose.rotation
    matrix[3:, :3] = cross_matrix(pose.translation) @ pose.rotation
    return matrix


def position_covariance(
    cam_from_world: Pose, covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance (3, 3) of the camera centre in the world, from that of the pose (6, 6).

    The centre is -R^T t. If R moves by Exp(w) and t by dt, it moves by -R^T (dt + [t] w), where [t]
    is the matrix of the cross product.
    """
    jacobian = -cam_from_world.rotation.T @ np.hstack(
        [cross_matrix(cam_from_world.translation), np.eye(3)]
    )
    return np.asarray(jacobian @ covariance @ jacobian.T)


def with_origin(
    cam_from_local: Pose, covariance: NDArray[np.float64], origin: NDArray[np.float64]
) -> tuple[Pose, NDArray[np.float64]]:
    """Move a pose found in coordinates relative to ``origin`` (3,) to the world.

    x_local = x_world - origin, so t_world = t_local - R origin. The covariance of t_world grows by
    the rotation's error times the distance of the origin.
    """
    jacobian = np.eye(6)
    jacobian[3:, :3] = cross_matrix(cam_from_local.rotation @ origin)
    return moved_origin(cam_from_local, origin), jacobian @ covariance @ jacobian.T


def moved_origin(cam_from_local: Pose, origin: NDArray[np.float64]) -> Pose:
    """Move a pose found in coordinates relative to ``origin`` (3,) to the world."""
    rotation = cam_from_local.rotation
    return Pose(rotation, cam_from_local.translation - rotation @ origin)


def moved_pose(
    device_from_b: Pose, covariance: NDArray[np.float64], a_from_b: Similarity
) -> tuple[Pose, NDArray[np.float64]]:
    """Move a pose and its covariance (6, 6) to another frame and unit.

    The translation is t_a = scale t_b - R_a t, with R_a and t_a of the result and t of
    ``a_from_b``. So its error has two parts: that of t_b, and the rotation's times the distance
    between the origins.
    """
    pose = a_from_b.move(device_from_b)
    jacobian = np.eye(6)
    jacobian[3:, 3:] *= a_from_b.scale
    jacobian[3:, :3] = cross_matrix(pose.rotation @ a_from_b.translation)
    moved = jacobian @ covariance @ jacobian.T
    return pose, (moved + moved.T) / 2


def largest_std(pose: Pose, covariance: NDArray[np.float64]) -> float:
    """Return the standard deviation of a device's position along its worst axis."""
    return math.sqrt(max(float(np.linalg.eigvalsh(position_covariance(pose, covariance))[-1]), 0.0))


@dataclass(frozen=True, slots=True)
class MapErrors:
    """How much further poses in a map are off than the scatter of their photos tells.

    Attributes:
        position_factor: of the standard deviations of the camera's centre; at least 1.
        orientation_factor: of the standard deviations of the rotation about that centre.
        position_std: by how much the map as a whole is bent, along each axis of the world: standard
            deviation, in its unit.
    """

    position_factor: float
    orientation_factor: float
    uncertainty: Uncertainty = Uncertainty.WHOLE
    position_std: float = 0.0

    def whole(
        self,
        rig_from_world: Pose,
        covariance: NDArray[np.float64],
        of_camera: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Widen the covariance (6, 6) of a pose by the errors of the map.

        The part of it that comes from the doubt in the camera, ``of_camera``, stays: no landmark
        has a say in it. Rotation w and centre e, both in the rig's axes, are scaled apart, which
        keeps how they hang together: e = -(dt + [t] w), with [t] the matrix of the cross product.
        That matrix is its own inverse.
        """
        if self.uncertainty is Uncertainty.PHOTO_ONLY:
            return covariance  # to the last bit
        factors = self.orientation_factor, self.position_factor
        if of_camera is None:
            return self._bent(_widened(rig_from_world, covariance, *factors))
        widened = _widened(rig_from_world, covariance - of_camera, *factors)
        return self._bent(widened + of_camera)

    def part(self, rig_from_world: Pose, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the part (6, 6) of the whole covariance that is the map's own.

        Poses next to each other share these errors, which no number of photos averages out. Added
        to the photo's ``covariance``, it gives the variances that ``whole`` has, of the rotation
        and of the camera's centre. It is a covariance itself, as their difference not always is.
        """
        factors = self.orientation_factor, self.position_factor
        beyond = (math.sqrt(f**2 - 1.0) for f in factors)
        return self._bent(_widened(rig_from_world, covariance, *beyond))

    def _bent(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Add what the whole map is off by, the same in all directions."""
        if self.position_std == 0.0:
            return covariance  # to the last bit
        # dt = -R e, and R takes nothing away from what is the same in all directions.
        moved = np.repeat([0.0, self.position_std**2], 3)
        return np.asarray(covariance + np.diag(moved))


def _widened(
    rig_from_world: Pose,
    covariance: NDArray[np.float64],
    orientation_factor: float,
    position_factor: float,
) -> NDArray[np.float64]:
    centred = np.eye(6)
    centred[3:, 3:] *= -1.0
    centred[3:, :3] = -cross_matrix(rig_from_world.translation)
    factors = np.repeat([orientation_factor, position_factor], 3)
    widening = centred @ (factors[:, None] * centred)
    widened = widening @ covariance @ widening.T
    return np.asarray((widened + widened.T) / 2)


# Of maps that were never tested: what is stated is the photo's part alone.
PHOTO_ONLY = MapErrors(1.0, 1.0, Uncertainty.PHOTO_ONLY)
