"""Whether measured poses and the motion between them can all be right."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.pose.motion import UncertainPose, chain, difference

# Quantiles of chi-square with six degrees of freedom: 0.5, 0.99 and 0.999.
_CHI2_HALF = 5.35
_CHI2_99 = 16.81
CHI2_999 = 22.46
# A measured pose may be off by more than its covariance tells, because maps have errors that
# many points share: 0.1 degrees and 1 cm. Only more than that is a contradiction.
_MAP_ERROR = np.diag([math.radians(0.1) ** 2] * 3 + [0.01**2] * 3)
# Two measured poses that agree could do so by chance; three leave a fourth no excuse.
_MIN_WITNESSES = 3
_FACTOR_STEP = 1.5
_MAX_FACTOR = 1e6


@dataclass(frozen=True, slots=True)
class Piece:
    """A run of instants in which all measured poses agree with the motion.

    Attributes:
        measured: the instants whose measured poses count.
    """

    first: int
    last: int
    measured: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A measured pose beside an earlier one that the motion carried on.

    Attributes:
        error: (6,) the difference.
        poses: (6, 6) its covariance as far as it comes from the two measured poses.
        motion: (6, 6) ... from the motion.
    """

    error: NDArray[np.float64]
    poses: NDArray[np.float64]
    motion: NDArray[np.float64]

    def chi2(self, factor: float = 1.0) -> float:
        """The squared error, normalized, were the motion's covariance ``factor`` times larger."""
        return float(self.error @ np.linalg.solve(self.poses + factor * self.motion, self.error))

    def contradicts(self, factor: float = 1.0) -> bool:
        """Whether more than chance and the map's errors is left, with ``factor`` as in ``chi2``."""
        total = self.poses + factor * self.motion + 2.0 * _MAP_ERROR
        return float(self.error @ np.linalg.solve(total, self.error)) > CHI2_999


def agreeing_pieces(
    measured: Mapping[int, UncertainPose], links: Sequence[UncertainPose]
) -> tuple[list[Piece], list[UncertainPose]]:
    """Cut a sequence where measured poses contradict the motion between them.

    Consecutive measured poses are compared through the motion (chi-square, 0.999, beyond what
    maps are off by). One that contradicts both neighbours while these agree is taken for a
    look-alike place and does not count, provided that it alone was in the way: then all the
    others, at least three, agree. A motion that keeps contradicting shows no such thing.

    Where nothing contradicts, the pieces reach to the ends of the sequence; otherwise only from
    measured pose to measured pose.

    Args:
        measured: poses by instant, at least one.
        links: N - 1 motions.

    Returns:
        The pieces, in order, and the links with covariances that the comparisons bear out: all are
        enlarged until half of the comparisons are within their median, and those between two
        poses that fit badly (0.99), yet within the map's error, until the misfit is one
        standard deviation.
    """
    anchors, comparisons = _without_outliers(measured, links)
    runs = [[anchors[0]]]
    for anchor, comparison in zip(anchors[1:], comparisons, strict=True):
        if comparison.contradicts():
            runs.append([anchor])
        else:
            runs[-1].append(anchor)
    common = _factor(comparisons, _CHI2_HALF)
    factors = np.full(len(links), common)
    for (a, b), comparison in zip(itertools.pairwise(anchors), comparisons, strict=True):
        if comparison.chi2(common) > _CHI2_99:
            factors[a:b] = _factor([comparison], 1.0)
    # Odometry that is wrong between measured poses may be as wrong before and after them.
    worst = factors.max(initial=1.0)
    factors[: anchors[0]] = factors[anchors[-1] :] = worst
    scaled = [link.scaled(factor) for link, factor in zip(links, factors, strict=True)]
    if len(runs) == 1:
        return [Piece(0, len(links), tuple(runs[0]))], scaled
    return [Piece(run[0], run[-1], tuple(run)) for run in runs], scaled


def _without_outliers(
    measured: Mapping[int, UncertainPose], links: Sequence[UncertainPose]
) -> tuple[list[int], list[Comparison]]:
    """The instants that count, and the comparisons of each with the next."""
    everyone = sorted(measured)
    comparisons = [compare(a, b, measured, links) for a, b in itertools.pairwise(everyone)]
    kept, fits = list(everyone), list(comparisons)
    i = 1
    while i < len(kept) - 1:
        if fits[i - 1].contradicts() and fits[i].contradicts():
            across = compare(kept[i - 1], kept[i + 1], measured, links)
            if not across.contradicts():
                del kept[i]
                fits[i - 1 : i + 1] = [across]
                continue
        i += 1
    if len(kept) >= _MIN_WITNESSES and not any(fit.contradicts() for fit in fits):
        return kept, fits
    return everyone, comparisons


def compare(
    a: int, b: int, measured: Mapping[int, UncertainPose], links: Sequence[UncertainPose]
) -> Comparison:
    """Compare the measured pose of instant b with that of a, carried there by the motion."""
    motion = chain(links, a, b)
    predicted = UncertainPose(motion.pose, np.zeros((6, 6))) @ measured[a]
    return Comparison(
        error=difference(measured[b].pose, predicted.pose),
        poses=predicted.covariance + measured[b].covariance,
        motion=motion.covariance,
    )


def _factor(comparisons: Sequence[Comparison], expected: float) -> float:
    """Return the factor on the motion's covariance that makes the median chi-square expected."""
    factor = 1.0
    while comparisons and factor < _MAX_FACTOR:
        if np.median([comparison.chi2(factor) for comparison in comparisons]) <= expected:
            break
        factor *= _FACTOR_STEP
    return factor
