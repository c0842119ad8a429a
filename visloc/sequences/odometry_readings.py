"""Which conventions of odometry the photos leave open, and whether these differ in a pose.

Odometry is believed where no other reading of it that fits the photos leads elsewhere. One photo
fits all of them, and so do many of a rig that stands still; a straight way fits some.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.motion import UncertainPose, chain, default_motion_covariance, difference
from visloc.pose_conventions import READINGS, UNIT_READINGS
from visloc.sequences.agreement import CHI2_999, compare
from visloc.sequences.filling import Odometry

AS_SENT = "as sent"
_READINGS: Mapping[str, Callable[[Pose], Pose]] = {
    AS_SENT: lambda pose: pose,
    **READINGS,
    **UNIT_READINGS,
}
ALL_READINGS = frozenset(_READINGS)
# Noise of five times the stated standard deviation is no sign of another convention.
_NOISE = 5.0**2
_NO_MOTION = UncertainPose(Pose.identity(), np.zeros((6, 6)))


def narrowed(
    readings: frozenset[str],
    run: Sequence[Odometry],
    measured: Mapping[int, UncertainPose],
) -> frozenset[str]:
    """Keep the readings that fit how neighbouring measured poses moved, and the first and last.

    If none of ``readings`` fits, all others are tried. ``measured`` is by index in ``run``.
    """
    order = sorted(measured)
    for start, end in [*pairwise(order), *zip(order[:1], order[-1:], strict=True)]:
        ends = {0: measured[start], end - start: measured[end]}
        if not compare(0, end - start, ends, [_NO_MOTION] * (end - start)).contradicts():
            continue  # whatever its convention, odometry of a rig that stands still fits
        fits = partial(_fits, run[start : end + 1], ends)
        if fits(AS_SENT) or not fits(AS_SENT, _NOISE):
            readings = (
                frozenset(filter(fits, readings))
                or frozenset(filter(fits, ALL_READINGS))
                or readings
            )
    return readings


def lead_elsewhere(
    readings: frozenset[str],
    run: Sequence[Odometry],
    start: int,
    end: int,
    covariance: NDArray[np.float64],
) -> bool:
    """Whether a reading carries the pose at ``start`` to another one at ``end`` than as sent.

    ``covariance`` (6, 6) is that of the pose at ``end``, as in ``UncertainPose``.
    """
    first = min(start, end)
    links = _links(run[first : max(start, end) + 1], AS_SENT)
    sent = chain(links, start - first, end - first)
    total = covariance + sent.covariance  # either reading has the noise of the motion
    for name in readings:
        read = _READINGS[name]
        motion = read(run[end].rig_from_odometry) @ read(run[start].rig_from_odometry).inverse()
        error = difference(motion, sent.pose)
        if float(error @ np.linalg.solve(total, error)) > CHI2_999:
            return True
    return False


def link_between(
    before: Odometry, after: Odometry, name: str = AS_SENT
) -> tuple[Pose, NDArray[np.float64]]:
    """The motion between two instants, and its covariance (6, 6) as in ``RelativeMotion``."""
    a, b = (_READINGS[name](each.rig_from_odometry) for each in (before, after))
    motion = b @ a.inverse()
    stated = after.covariance
    return motion, default_motion_covariance(motion) if stated is None else stated


def _fits(
    run: Sequence[Odometry], ends: Mapping[int, UncertainPose], name: str, noise: float = 1.0
) -> bool:
    return not compare(0, len(run) - 1, ends, _links(run, name)).contradicts(noise)


def _links(run: Sequence[Odometry], name: str) -> list[UncertainPose]:
    return [UncertainPose.from_additive(*link_between(a, b, name)) for a, b in pairwise(run)]
