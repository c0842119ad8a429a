"""Figures of a list of outcomes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom, chi2

from benchmarks.trust.outcomes import Outcome

INSIDE, LEVEL = 0.95, 0.01
NUM_BINS = 10


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """How stated uncertainties of the position hold.

    Attributes:
        count: answers with a truth.
        inside: truths inside the stated 95 % ellipsoid.
        p_value: chance of so few inside or fewer if the ellipsoids were right.
        ratio: median of the error over the root of the covariance's trace.
    """

    count: int
    inside: int
    p_value: float
    ratio: float

    @property
    def holds(self) -> bool:
        return self.p_value >= LEVEL


def uncertainty(outcomes: Sequence[Outcome]) -> Uncertainty | None:
    """Compare errors with stated covariances; None when there is nothing to compare."""
    inside, ratios = 0, []
    for each in outcomes:
        if each.error is None or each.covariance is None:
            continue
        error, covariance = np.array(each.error), np.array(each.covariance)
        inside += bool(error @ np.linalg.solve(covariance, error) <= chi2.ppf(INSIDE, 3))
        ratios.append(float(np.linalg.norm(error) / np.sqrt(np.trace(covariance))))
    if not ratios:
        return None
    return Uncertainty(len(ratios), inside, at_most(inside, len(ratios)), float(np.median(ratios)))


def at_most(inside: int, count: int) -> float:
    """Return the one-sided binomial p-value: the chance of at most so many inside at 95 %."""
    return float(binom.cdf(inside, count, INSIDE))


def calibration_error(probabilities: Sequence[float], right: Sequence[bool]) -> float:
    """Return the expected calibration error with ten bins of equal width.

    The mean over all answers of |share of right answers - mean probability| of the answer's bin
    (Naeini et al., "Obtaining Well Calibrated Probabilities Using Bayesian Binning", AAAI 2015).
    """
    stated, came = np.asarray(probabilities), np.asarray(right, dtype=np.float64)
    bins = np.minimum((stated * NUM_BINS).astype(int), NUM_BINS - 1)
    total = 0.0
    for each in np.unique(bins):
        of_bin = bins == each
        total += abs(came[of_bin].mean() - stated[of_bin].mean()) * of_bin.sum()
    return float(total / len(stated))
