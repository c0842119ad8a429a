"""Poses along a rig and along time: what fills the gaps between measured ones.

The post-processing of Humenberger et al. 2020 (rigs and image sequences), with centres instead of
translations interpolated, gaps limited in seconds, and every filled pose marked and widened. What
a filled pose is widened by, the constants below, is in metres: right for metric worlds.
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

# Unix times of 2001-01-01 and 2100-01-01 in seconds. Between them the unit follows from the size.
_FIRST_UNIX_S, _LAST_UNIX_S = 978_307_200, 4_102_444_800

# Errors of a rig's calibration, as standard deviations about and along each axis.
_RIG_ORIENTATION_STD = math.radians(0.2)
_RIG_POSITION_STD_M = 0.005
_RIG_POSITION_STD_PER_M = 0.01  # of the distance between the two cameras

# Unobserved motion of a device, as standard deviations about and along each axis. A car through a
# bend in town (KITTI) accelerates by 2.2 m/s^2 and 0.2 rad/s^2 per axis (root mean square), mostly
# towards the inside of the bend; a hand-held camera (7-Scenes) by 0.2 m/s^2 and 0.3 rad/s^2; a
# walking person's head by about 3 m/s^2 with each step, but only by centimetres.
_ACCELERATION = 2.0  # m/s^2
_ANGULAR_ACCELERATION = 1.0  # rad/s^2
# The least speeds counted with: a walk, and a look around. Both of the above turn at 0.2 to 0.5.
_WALKING_SPEED = 1.4  # m/s
_TURNING_SPEED = 0.5  # rad/s
# Counted with where a single pose leaves the speed unknown: a car in town.
_UNKNOWN_SPEED = 10.0  # m/s
# The spread of an angle that nothing is known about: uniform between -pi and pi.
_UNKNOWN_ANGLE_STD = math.pi / math.sqrt(3.0)

# The longest gap between measured instants that is filled, seconds: by default, and at most.
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
        covariance: (6, 6) of ``rig_from_previous_rig``, the motion since the instant before, for
            R <- Exp(w) R and t <- t + dt; None when unknown.
    """

    rig_from_odometry: Pose
    covariance: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TracedPose:
    """A pose with its uncertainty and what it rests on.

    Attributes:
        pose: ``device_from_world``: of a camera, or of a rig.
        covariance: (6, 6) of rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt.
        source: what it rests on.
        uncertainty: what ``covariance`` covers.
        num_inliers: correspondences that agree with it; 0 when it was filled.
    """

    pose: Pose
    covariance: NDArray[np.float64]
    source: PoseSource
    uncertainty: Uncertainty
    num_inliers: int = 0


def guess_time_unit(timestamps: Sequence[int]) -> TimeUnit | None:
    """Tell the unit of timestamps that are Unix times of this century.

    Returns:
        The unit in which all of them lie between 2001 and 2100. None where there is none: counters
        and times since a start, such as 0, 100, 200, look alike in every unit.
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
    """Give cameras of a rig without a pose that of the rig's best camera at the same instant.

    The best is the estimated one with most inliers; of equals, the first by sensor id.

    Args:
        instant: ``cam_from_world`` by sensor id, None where there is none.
        cam_from_rig: where the rig's cameras sit.

    Returns:
        The same sensors. Filled poses have source RIG and the giver's covariance, carried over by
        the rigid transform between the cameras, plus what its calibration may be wrong by. Sensors
        that the rig lacks stay as they are, and all do when none was estimated.
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
    """Fill instants without a pose from those before and after.

    Between two poses that are at most ``max_gap_s`` apart, the pose is interpolated (source
    INTERPOLATED). Elsewhere the nearest pose within ``max_gap_s`` is repeated (source NEAREST; of
    two as near, the earlier). Beyond that, nothing is filled, and a filled pose fills no other.

    Neither is ever more certain than the poses it comes from, and to these is added what the
    device may have done meanwhile, as independent deviations. Interpolated: an unknown
    acceleration a, which bends the path by (a / 2) (t - t_a) (t_b - t) but to no more than the
    nearest pose could be off; and an arc of a circle instead of its chord, where the device
    turned. Nearest: a motion at the trajectory's own speed, at least that of a walk.

    Args:
        times_s: seconds, strictly increasing. Unix times in nanoseconds lose digits as floats:
            count from the first instant.
        poses: ``device_from_world`` of each instant, whatever they rest on; None where there is
            none.
        max_gap_s: seconds; 0 fills nothing.

    Raises:
        InvalidInput: ``sequence.timestamps`` or ``sequence.max_gap``.
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
    """Return the pose on the way from a to b, both ``device_from_world``.

    The centre moves on a straight line, the rotation about one axis the shorter way (slerp:
    Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985), both evenly.

    Args:
        a: where ``share`` is 0.
        b: where ``share`` is 1.
        share: of the way.
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
    """The pose of a camera that sits rigidly beside one whose pose is known."""
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
    """The posed instants of a sequence.

    Attributes:
        times_s: when.
        poses: as many.
        speeds: (m/s, rad/s) from each to the next.
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
        """The pose at an instant between the posed ones, or beside."""
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
        # Errors that both share, such as the map's, do not average out: hence no (1 - share)^2
        # and share^2, but whichever is wider along every direction.
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
        """The highest speeds (m/s, rad/s) between neighbours, from one further on either side."""
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
    """Covariance of (w, dc) of another pose, with w in this device's axes."""
    jacobian = np.eye(6)
    jacobian[:3, :3] = device_from_world.rotation @ other.pose.rotation.T
    return propagated(jacobian, center_covariance(other.pose, other.covariance))


def _independent(orientation_std: float, position_std: float) -> NDArray[np.float64]:
    return np.diag([orientation_std**2] * 3 + [position_std**2] * 3)


def _wider(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """A covariance that is at least ``a`` and ``b`` along every direction: a + (b - a)_+."""
    scale = np.sqrt(np.diag(a) + np.diag(b))  # radians and metres must not be mixed
    units = np.outer(scale, scale)
    excess, axes = np.linalg.eigh((b - a) / units)
    return np.asarray(a + units * ((axes * np.maximum(excess, 0.0)) @ axes.T))
