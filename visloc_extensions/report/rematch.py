"""How likely a place in view is found again, learned from the held-out runs by counting.

A log-linear model of the number of correct matches that a place in view brings (Poisson
regression). Its steps go one way only: a place never gains by being seen from further aside, by
a greater change of scale, by fewer photos, or by something standing in front of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from visloc_extensions.report.sight import Sight

# Between knots the logarithm is linear, beyond the last it is level.
_ANGLE_KNOTS_DEG = (0.0, 2.5, 5.0, 10.0, 20.0, 40.0, 80.0)
_OCTAVE_KNOTS = (0.0, 0.25, 0.5, 1.0, 2.0)
_OBSERVER_KNOTS = (0.0, 1.0, 2.0, 3.0)  # binary logarithm
_BEHIND_KNOTS = (0.1, 0.4, 1.0)
# What is thought before any run was seen: about the mean of maps of three places and methods.
_PRIOR = np.concatenate(
    [
        [-1.5],
        [0.3, 0.3, 0.4, 0.5, 1.0, 1.5],  # angle
        [0.5, 0.7, 0.7, 1.0],  # further away
        [0.5, 0.7, 0.7, 1.0],  # nearer
        [0.4, 0.4, 0.4],  # observers
        [0.5, 0.5],  # behind
    ]
)
_PRIOR_WEIGHT = 2.0  # matches that it is worth
# Places as alike as this are counted together.
_ANGLE_BINS_DEG = (1, 2, 3, 4, 6, 8, 10, 13, 16, 20, 25, 30, 40, 50, 60, 80, 100)
_OCTAVE_BINS = (-2, -1.5, -1, -0.7, -0.5, -0.35, -0.2, -0.1, 0, 0.1, 0.2, 0.35, 0.5, 0.7, 1, 1.5, 2)
_OBSERVER_BINS = (1.5, 2.5, 4.5, 8.5)
_BEHIND_BINS = (0.1, 0.25, 0.4, 0.7, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Counted:
    """Places in view, counted by kind: those that are seen about alike.

    Attributes:
        kinds: (c,) int64, sorted.
        sums: (c, p + 2) float64, over the places of each kind: what the model is made of, how many
            there were, correct matches with them.
    """

    kinds: NDArray[np.int64]
    sums: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Rematch:
    """The fitted model.

    Attributes:
        steps: (p,) float64: the logarithm for a place seen as the photo saw it, by one photo;
            then how much each step between knots changes it.
    """

    steps: NDArray[np.float64]

    def expected(self, sight: Sight) -> NDArray[np.float64]:
        """Correct matches (k,) expected of each place in view."""
        return np.asarray(np.exp(np.minimum(_design(sight) @ self.steps, 5.0)))


def count(sight: Sight, matches: NDArray[np.int64]) -> Counted:
    """Count the places in view of one run.

    Args:
        matches: (k,) correct matches with each.
    """
    kind = np.zeros(len(sight), dtype=np.int64)
    for values, bins in (
        (sight.angles_deg, _ANGLE_BINS_DEG),
        (sight.octaves, _OCTAVE_BINS),
        (sight.observers, _OBSERVER_BINS),
        (sight.behind, _BEHIND_BINS),
    ):
        kind = kind * (len(bins) + 1) + np.digitize(values, bins)
    of_each = np.column_stack([_design(sight), np.ones(len(sight)), matches])
    return _by_kind(kind, of_each)


def fit_rematch(runs: list[Counted]) -> Rematch:
    """Fit the model to what was counted in some runs; without any it is what was thought before."""
    if not runs:
        return Rematch(_PRIOR)
    counted = _by_kind(
        np.concatenate([run.kinds for run in runs]), np.concatenate([run.sums for run in runs])
    )
    places, matches = counted.sums[:, -2], counted.sums[:, -1]
    design = counted.sums[:, :-2] / places[:, None]

    def loss(steps: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        logs = np.minimum(design @ steps, 5.0)
        expected = places * np.exp(logs)
        off = steps - _PRIOR
        value = expected.sum() - matches @ logs + 0.5 * _PRIOR_WEIGHT * (off @ off)
        return float(value), design.T @ (expected - matches) + _PRIOR_WEIGHT * off

    bounds = [(None, None)] + [(0.0, None)] * (len(_PRIOR) - 1)
    found = minimize(loss, _PRIOR, jac=True, method="L-BFGS-B", bounds=bounds)
    return Rematch(np.asarray(found.x))


def _by_kind(kinds: NDArray[np.int64], rows: NDArray[np.float64]) -> Counted:
    """Add up rows (n, q) of the same kind."""
    order = np.argsort(kinds, kind="stable")
    found, first = np.unique(kinds[order], return_index=True)
    if len(found) == 0:
        return Counted(found, rows)
    return Counted(found, np.add.reduceat(rows[order], first, axis=0))


def _design(sight: Sight) -> NDArray[np.float64]:
    return np.column_stack(
        [
            np.ones(len(sight)),
            -_climbed(sight.angles_deg, _ANGLE_KNOTS_DEG),
            -_climbed(sight.octaves, _OCTAVE_KNOTS),
            -_climbed(-sight.octaves, _OCTAVE_KNOTS),
            _climbed(np.log2(sight.observers), _OBSERVER_KNOTS),
            -_climbed(sight.behind, _BEHIND_KNOTS),
        ]
    )


def _climbed(values: NDArray[np.float64], knots: tuple[float, ...]) -> NDArray[np.float64]:
    """How much (n, knots - 1) of each step between knots lies below values (n,), 0 to 1."""
    low, high = np.array(knots[:-1]), np.array(knots[1:])
    return np.asarray(np.clip((values[:, None] - low) / (high - low), 0.0, 1.0))
