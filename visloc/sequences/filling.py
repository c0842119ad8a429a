"""Fill the gaps between measured poses, from the rig's other cameras and from other instants.

This is the post-processing of Humenberger et al. 2020 (rigs and image sequences), with three
differences: camera centres are interpolated instead of translations, gaps are limited in seconds,
and every filled pose says so and has a larger covariance. The constants below say how much larger.
They are in metres, so they hold for metric worlds only.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.geometry import (
    Pose,
    center_covariance,
    covariance_from_center,
    propagated,
    rotation_angle,
)
from visloc.types import PoseSource, Uncertainty

# Unix times of 2001-01-01 and 2100-01-01 in seconds. A Unix time between them tells its unit by its
# size.
_FIRST_UNIX_S, _LAST_UNIX_S = 978_307_200, 4_102_444_800

# Errors of a rig's calibration: standard deviations about each axis, and along each axis.
_RIG_ORIENTATION_STD = math.radians(0.2)
_RIG_POSITION_STD_M = 0.005
_RIG_POSITION_STD_PER_M = 0.01  # of the distance between the two cameras

# Unobserved motion of a device: standard deviations about each axis, and along each axis. For
# comparison, root mean squares per axis:
#   a car through a bend in town (KITTI): 2.2 m/s^2, mostly towards the inside, and 0.2 rad/s^2;
#   a hand-held camera (7-Scenes): 0.2 m/s^2 and 0.3 rad/s^2;
#   a walking person's head: about 3 m/s^2 with each step, but it moves by centimetres only.
_ACCELERATION = 2.0  # m/s^2
_ANGULAR_ACCELERATION = 1.0  # rad/s^2
# Lower bounds of the speed: a walk, and a look around. The car and the camera above turn at 0.2 to
# 0.5 rad/s.
_WALKING_SPEED = 1.4  # m/s
_TURNING_SPEED = 0.5  # rad/s
# The speed that is assumed where a single pose tells none: a car in town.
_UNKNOWN_SPEED = 10.0  # m/s
# Standard deviation of an unknown angle: uniform between -pi and pi.
_UNKNOWN_ANGLE_STD = math.pi / math.sqrt(3.0)

# The longest gap between measured instants that is filled, in seconds: the default and its limit.
DEFAULT_MAX_GAP_S = 1.0
MAX_GAP_S = 60.0


class TimeUnit(StrEnum):
    """The unit of a timestamp."""

    S = "s"
    MS = "ms"
    US = "us"
    NS = "ns"

    @property
    def seconds(self) -> float:
        """The length of the unit in seconds."""
        return {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[self.value]


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """The pose of a rig according to a tracker, in the tracker's own world.

    Attributes:
        rig_from_odometry: the pose, metres.
        covariance: (6, 6) of the motion since the previous instant, ``rig_from_previous_rig``:
            rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt. None when unknown.
    """

    rig_from_odometry: Pose
    covariance: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TracedPose:
    """A pose with its uncertainty and its origin.

    Attributes:
        pose: ``device_from_world``, where the device is a camera or a rig.
        covariance: (6, 6) of rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt.
        uncertainty: which errors ``covariance`` covers.
        num_inliers: matches that agree with it; 0 for a filled pose.
    """

    pose: Pose
    covariance: NDArray[np.float64]
    source: PoseSource
    uncertainty: Uncertainty
    num_inliers: int = 0


def guess_time_unit(timestamps: Sequence[int]) -> TimeUnit | None:
    """Guess the unit of timestamps that are Unix times of this century.

    Returns:
        The unit in which all timestamps lie between 2001 and 2100; None if there is no such unit.
        Counters and times since a start, such as 0, 100, 200, do not tell their unit.
    """
    if not timestamps:
        return None
    first, last = min(timestamps), max(timestamps)
    for unit in TimeUnit:
        steps = round(1.0 / unit.seconds)
        if _FIRST_UNIX_S * steps <= first and last < _LAST_UNIX_S * steps:
            return unit
    return None


def fill_rig(
    instant: Mapping[str, TracedPose | None], cam_from_rig: Mapping[str, Pose]
) -> dict[str, TracedPose | None]:
    """Fill the missing poses of a rig's cameras from its best camera at the same instant.

    The best camera is the one with most inliers among those with an estimated pose. Of equals, the
    first by sensor id.

    Args:
        instant: ``cam_from_world`` by sensor id; None for a missing pose.
        cam_from_rig: the pose of each of the rig's cameras.

    Returns:
        The same sensors. A filled pose has source RIG. Its covariance is that of the best camera,
        carried over by the rigid transform between both, plus the error of the rig's calibration.
        Sensors that the rig lacks stay as they are. If no pose was estimated, nothing is filled.
    """
    estimated = {
        sensor: traced
        for sensor, traced in instant.items()
        if sensor in cam_from_rig and traced is not None and traced.source is PoseSource.ESTIMATED
    }
    filled = dict(instant)
    if not estimated:
        return filled
    best = min(estimated, key=lambda sensor: (-estimated[sensor].num_inliers, sensor))
    rig_from_best = cam_from_rig[best].inverse()
    for sensor, traced in instant.items():
        if traced is None and sensor in cam_from_rig:
            filled[sensor] = _carried(estimated[best], cam_from_rig[sensor] @ rig_from_best)
    return filled


def fill_sequence(
    times_s: Sequence[float], poses: Sequence[TracedPose | None], max_gap_s: float
) -> list[TracedPose | None]:
    """Fill instants without a pose from the poses before and after them.

    The first rule that applies counts:

    1. The instant lies between two poses that are at most ``max_gap_s`` apart: its pose is
       interpolated (source INTERPOLATED).
    2. The nearest pose is at most ``max_gap_s`` away: it is repeated (source NEAREST). Of two that
       are equally near, the earlier one counts.
    3. Otherwise nothing is filled.

    A filled pose fills no other. Its covariance is at least that of the poses it comes from. The
    motion that nobody saw is added to it as independent deviations:

    - INTERPOLATED: an unknown acceleration a bends the path by (a / 2) (t - t_a) (t_b - t). This
      deviation is at most that of repeating the nearest pose. Where the device turned, an arc of
      a circle may replace its chord.
    - NEAREST: a motion at the trajectory's own speed, or at that of a walk if that is faster.

    Args:
        times_s: seconds, strictly increasing. Unix times in nanoseconds lose digits as floats:
            count from the first instant.
        poses: ``device_from_world`` of each instant, of any source; None for a missing pose.
        max_gap_s: seconds; 0 fills nothing.
    """
    _check(times_s, max_gap_s)
    if max_gap_s == 0:
        return list(poses)
    track = _Track.of(times_s, poses)
    # 0.4 s between two Unix times can come out as 0.4000001 s: their last digit may be wrong.
    reach_s = max_gap_s + 2.0 * math.ulp(max((abs(time) for time in times_s), default=0.0))
    return [
        traced if traced is not None else track.at(time, reach_s)
        for time, traced in zip(times_s, poses, strict=True)
    ]


def interpolate_pose(a: Pose, b: Pose, share: float) -> Pose:
    """Interpolate between two poses, both ``device_from_world``.

    The centre moves on a straight line. The rotation turns about one axis, the shorter way (slerp:
    Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985). Both move evenly.

    Args:
        a: the pose where ``share`` is 0.
        b: the pose where ``share`` is 1.
        share: the part of the way from a to b.
    """
    w, *axis = Pose(b.rotation @ a.rotation.T, np.zeros(3)).rotation_wxyz  # w >= 0: the short way
    sine = math.hypot(*axis)
    half_angle = share * math.atan2(sine, w)
    stretch = math.sin(half_angle) / sine if sine > 0 else share
    turn = Pose.from_quaternion([math.cos(half_angle), *(stretch * np.array(axis))], np.zeros(3))
    rotation = turn.rotation @ a.rotation
    start = a.center
    return Pose(rotation, -rotation @ (start + share * (b.center - start)))


def _carried(giver: TracedPose, cam_from_giver: Pose) -> TracedPose:
    """Return a camera's pose from that of another one, to which it is fixed."""
    pose = cam_from_giver @ giver.pose
    # R = S R_g and t = S t_g + u: an error (w, dt) of the giver arrives as (S w, S dt).
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = cam_from_giver.rotation
    lever_m = float(np.linalg.norm(cam_from_giver.translation))
    calibration = _independent(
        _RIG_ORIENTATION_STD, _RIG_POSITION_STD_M + _RIG_POSITION_STD_PER_M * lever_m
    )
    covariance = propagated(jacobian, giver.covariance) + covariance_from_center(pose, calibration)
    return TracedPose(pose, covariance, PoseSource.RIG, giver.uncertainty)


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """The instants of a sequence that have a pose.

    Attributes:
        times_s: (n) seconds.
        poses: (n) of these times.
        speeds: (n - 1) in (m/s, rad/s), from each pose to the next.
    """

    times_s: list[float]
    poses: list[TracedPose]
    speeds: list[tuple[float, float]]

    @staticmethod
    def of(times_s: Sequence[float], poses: Sequence[TracedPose | None]) -> _Track:
        posed = [(t, p) for t, p in zip(times_s, poses, strict=True) if p is not None]
        speeds = [
            (_distance(a.pose, b.pose) / (t_b - t_a), _angle(a.pose, b.pose) / (t_b - t_a))
            for (t_a, a), (t_b, b) in pairwise(posed)
        ]
        return _Track([t for t, _ in posed], [p for _, p in posed], speeds)

    def at(self, time_s: float, reach_s: float) -> TracedPose | None:
        """Return the pose at a time by the rules of ``fill_sequence``."""
        following = bisect_left(self.times_s, time_s)
        beside = [k for k in (following - 1, following) if 0 <= k < len(self.poses)]
        if len(beside) == 2 and self.times_s[following] - self.times_s[following - 1] <= reach_s:
            return self._between(following - 1, time_s)
        nearest = min(beside, key=lambda k: abs(self.times_s[k] - time_s), default=None)
        if nearest is None or abs(self.times_s[nearest] - time_s) > reach_s:
            return None
        return self._beside(nearest, time_s)

    def _between(self, before: int, time_s: float) -> TracedPose:
        a, b = self.poses[before], self.poses[before + 1]
        since_s, until_s = time_s - self.times_s[before], self.times_s[before + 1] - time_s
        share = since_s / (since_s + until_s)
        pose = interpolate_pose(a.pose, b.pose, share)
        # Errors that both poses share, such as the map's, do not average out. So the covariances
        # are not weighted by (1 - share)^2 and share^2; the wider one counts in every direction.
        measured = _wider(_seen_from(pose, a), _seen_from(pose, b))

        short_s, long_s = sorted((since_s, until_s))
        speed, angular_speed = self._speed_around(before, before + 1)
        bend = short_s * min(_ACCELERATION / 2 * long_s, speed)
        twist = short_s * min(_ANGULAR_ACCELERATION / 2 * long_s, angular_speed)
        sagitta = _distance(a.pose, b.pose) / 2 * math.tan(_angle(a.pose, b.pose) / 4)
        arc = 4 * share * (1 - share) * sagitta
        between = _independent(min(twist, _UNKNOWN_ANGLE_STD), math.hypot(bend, arc))
        covariance = covariance_from_center(pose, measured + between)
        both_whole = a.uncertainty is b.uncertainty is Uncertainty.WHOLE
        uncertainty = Uncertainty.WHOLE if both_whole else Uncertainty.PHOTO_ONLY
        return TracedPose(pose, covariance, PoseSource.INTERPOLATED, uncertainty)

    def _beside(self, nearest: int, time_s: float) -> TracedPose:
        known = self.poses[nearest]
        away_s = abs(time_s - self.times_s[nearest])
        speed, angular_speed = self._speed_around(nearest, nearest)
        moved = _independent(min(angular_speed * away_s, _UNKNOWN_ANGLE_STD), speed * away_s)
        covariance = known.covariance + covariance_from_center(known.pose, moved)
        return replace(known, covariance=covariance, source=PoseSource.NEAREST, num_inliers=0)

    def _speed_around(self, first: int, last: int) -> tuple[float, float]:
        """Return the highest speeds (m/s, rad/s) among these poses and one more on either side."""
        around = self.speeds[max(first - 1, 0) : last + 1]
        if not around:
            return _UNKNOWN_SPEED, _TURNING_SPEED
        return (
            max(_WALKING_SPEED, *(speed for speed, _ in around)),
            max(_TURNING_SPEED, *(angular_speed for _, angular_speed in around)),
        )


def _check(times_s: Sequence[float], max_gap_s: float) -> None:
    for i, time in enumerate(times_s):
        if not math.isfinite(time) or (i > 0 and time <= times_s[i - 1]):
            raise refuse(
                "sequence.timestamps",
                field=f"times_s[{i}]",
                expected="finite numbers, each greater than the one before",
                got=time if i == 0 else f"{time} after {times_s[i - 1]}",
            )
    if not (math.isfinite(max_gap_s) and max_gap_s >= 0):
        raise refuse(
            "sequence.max_gap",
            field="max_gap_s",
            expected="a finite number of seconds, not negative",
            got=max_gap_s,
        )


def _distance(a: Pose, b: Pose) -> float:
    return float(np.linalg.norm(b.center - a.center))


def _angle(a: Pose, b: Pose) -> float:
    return rotation_angle(b.rotation @ a.rotation.T)


def _seen_from(device_from_world: Pose, other: TracedPose) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of another pose's rotation and centre, in this device's axes."""
    jacobian = np.eye(6)
    jacobian[:3, :3] = device_from_world.rotation @ other.pose.rotation.T
    return propagated(jacobian, center_covariance(other.pose, other.covariance))


def _independent(orientation_std: float, position_std: float) -> NDArray[np.float64]:
    return np.diag([orientation_std**2] * 3 + [position_std**2] * 3)


def _wider(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a covariance that is at least ``a`` and ``b`` in every direction: a + (b - a)_+."""
    scale = np.sqrt(np.diag(a) + np.diag(b))  # radians and metres must not be mixed
    units = np.outer(scale, scale)
    excess, axes = np.linalg.eigh((b - a) / units)
    return np.asarray(a + units * ((axes * np.maximum(excess, 0.0)) @ axes.T))
