"""Whether a device that was in one tile of a set may be where another sees it a moment later."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.archive import SetOutline
from visloc.geometry import Pose, rotation_angle
from visloc.localization.judge import STDS, TIE_ANGLE, TIE_REACH_SHARE
from visloc.pose.centre import largest_std
from visloc.pose.motion import default_motion_covariance
from visloc.priors import PositionPrior
from visloc.sequences.filling import Odometry

# What no device exceeds of which no motion is known: a car on a country road.
_FASTEST = 30.0  # m/s


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Where a device was last measured in a set, and how it has moved since.

    Attributes:
        timestamp: of that instant.
        pose: rig_from_set.
        covariance: (6, 6) of it.
        metre: in units of the set; None where that is not known.
        odometry: of the newest instant; None where the chain is broken.
        motion: rig_from_rig since that instant, metres.
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
        """Begin with an instant that was measured; attributes as of the class."""
        nothing = np.zeros((6, 6))
        return Track(timestamp, pose, covariance, metre, odometry, Pose.identity(), nothing)

    def moved(self, odometry: Odometry | None) -> Track:
        """Add the motion to one more instant; None when it has no odometry."""
        if odometry is None or self.odometry is None:
            return replace(self, odometry=None)
        step = odometry.rig_from_odometry @ self.odometry.rig_from_odometry.inverse()
        more = default_motion_covariance(step)
        if odometry.covariance is not None:
            more = odometry.covariance
        return replace(self, odometry=odometry, motion=step @ self.motion, drift=self.drift + more)

    @property
    def knows_motion(self) -> bool:
        """Whether odometry tells where the device is now."""
        return self.odometry is not None and self.metre is not None

    def area(self, outline: SetOutline) -> PositionPrior:
        """Return where the device may be now, by its odometry, in the frame of the set."""
        tie = TIE_REACH_SHARE * float(outline.reaches.max())
        return PositionPrior(self._predicted().center, tie + STDS * self._std())

    def allows(
        self, pose: Pose, covariance: NDArray[np.float64], seconds: float, reach: float
    ) -> bool:
        """Tell whether the device may be where another tile has it.

        Args:
            pose: there, rig_from_set.
            covariance: (6, 6) of it.
            seconds: since the instant that was measured.
            reach: how far the photos of the two tiles see, which says how well they are tied.
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
        assert self.metre is not None  # the caller has looked
        return Pose(self.motion.rotation, self.metre * self.motion.translation) @ self.pose

    def _std(self) -> float:
        """Of the position, along its worst axis."""
        known = largest_std(self.pose, self.covariance)
        if not self.knows_motion or self.metre is None:
            return known
        drift = math.sqrt(float(np.linalg.eigvalsh(self.drift[3:, 3:])[-1]))
        return math.hypot(known, self.metre * drift)
