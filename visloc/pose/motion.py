"""Relative motion between instants: how it is chained, and whether two poses agree with it.

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

from visloc.geometry import Pose, cross_matrix, rotation_angle

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
