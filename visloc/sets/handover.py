"""Checks whether a device can have moved from its last pose in a set to one in another tile."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.archive import SetOutline
from visloc.geometry import Pose, rotation_angle
from visloc.localization.acceptance.judge import STDS, TIE_ANGLE, TIE_REACH_SHARE
from visloc.pose.motion import default_motion_covariance, largest_std
from visloc.priors import PositionPrior
from visloc.sequences.filling import Odometry

# Maximum speed of a device without odometry: a car on a country road.
_FASTEST = 30.0  # m/s


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The last measured pose of a device in a set, and its motion since then.

    Attributes:
        timestamp: time of the measurement.
        pose: rig_from_set.
        covariance: (6, 6), of the pose.
        metre: length of a metre in the set's unit; None when unknown.
        odometry: the newest odometry; None after an instant without any.
        motion: rig_from_rig since the measurement, metres.
        drift: (6, 6) covariance of the motion.
    """

    timestamp: int
    pose: Pose
    covariance: NDArray[np.float64]
    metre: float | None
    odometry: Odometry | None
    motion: Pose
    drift: NDArray[np.float64]

    @staticmethod
    def begun(
        timestamp: int,
        pose: Pose,
        covariance: NDArray[np.float64],
        metre: float | None,
        odometry: Odometry | None,
    ) -> Track:
        """Begin with a measured pose."""
        nothing = np.zeros((6, 6))
        return Track(timestamp, pose, covariance, metre, odometry, Pose.identity(), nothing)

    def moved(self, odometry: Odometry | None) -> Track:
        """Add the motion up to the next instant; after None, the motion is unknown."""
        if odometry is None or self.odometry is None:
            return replace(self, odometry=None)
        step = odometry.rig_from_odometry @ self.odometry.rig_from_odometry.inverse()
        more = default_motion_covariance(step)
        if odometry.covariance is not None:
            more = odometry.covariance
        return replace(self, odometry=odometry, motion=step @ self.motion, drift=self.drift + more)

    @property
    def knows_motion(self) -> bool:
        """Whether odometry predicts the current pose."""
        return self.odometry is not None and self.metre is not None

    def area(self, outline: SetOutline) -> PositionPrior:
        """Return where the device may be now according to odometry, in the set's frame."""
        tie = TIE_REACH_SHARE * float(outline.reaches.max())
        return PositionPrior(self._predicted().center, tie + STDS * self._std())

    def allows(
        self, pose: Pose, covariance: NDArray[np.float64], seconds: float, reach: float
    ) -> bool:
        """Tell whether the device can have moved to the pose that another tile measured.

        Args:
            pose: rig_from_set.
            covariance: (6, 6), of the pose.
            seconds: time since the last measurement.
            reach: viewing distance of the two tiles, which bounds the error of their alignment.
        """
        tie = TIE_REACH_SHARE * reach
        spread = math.hypot(self._std(), largest_std(pose, covariance))
        if not self.knows_motion:
            if self.metre is not None:
                tie += _FASTEST * self.metre * seconds
            away = float(np.linalg.norm(pose.center - self.pose.center))
            return away <= tie + STDS * spread
        expected = self._predicted()
        away = float(np.linalg.norm(pose.center - expected.center))
        turned = rotation_angle(pose.rotation @ expected.rotation.T)
        parts = (self.covariance, covariance, self.drift)
        turn_std = math.sqrt(sum(float(part[:3, :3].trace()) for part in parts))
        return away <= tie + STDS * spread and turned <= TIE_ANGLE + STDS * turn_std

    def _predicted(self) -> Pose:
        assert self.metre is not None  # checked by the callers
        return Pose(self.motion.rotation, self.metre * self.motion.translation) @ self.pose

    def _std(self) -> float:
        """Standard deviation of the position along its worst axis."""
        known = largest_std(self.pose, self.covariance)
        if not self.knows_motion or self.metre is None:
            return known
        drift = math.sqrt(float(np.linalg.eigvalsh(self.drift[3:, 3:])[-1]))
        return math.hypot(known, self.metre * drift)
