"""The chance of being localized well, and how well, from what is expected to be found again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear, minimize
from scipy.special import expit

from visloc.geometry import Camera, cross_matrix
from visloc.options import DEFAULT_PRESET, PRESETS
from visloc_extensions.report.sight import Sight

# A pose has six numbers, a match two.
_FEWEST = 4.0
# What is thought before any run was seen: even chances at twice the inliers that a pose needs, and
# a position that scatters by a tenth of what it may, a short walk away from the nearest photo;
# steepest with inliers.
_PRIOR = np.array([0.0, 2.0, 0.5, 0.5])
_EVEN_INLIERS = 2.0 * PRESETS[DEFAULT_PRESET].min_inliers
_EVEN_STD = 0.1
_EVEN_APART, _LEAST_APART, _MOST_APART = 0.3, 0.05, 4.0
_PRIOR_VARIANCE = 1.0
# Of the allowed error; beyond, nothing is worse.
_WORST_STD = 10.0
# Errors are thought to be as large as the scatter of the matches has them, and a little larger away
# from the mapping photos, which share the errors of the landmarks that they made.
_PRECISION_PRIOR, _PRECISION_PRIOR_WEIGHT = np.array([0.0, 1.0, 0.3]), 3.0
# Median length of a normal error in space, by the root of the sum of its variances.
_MEDIAN_LENGTH = 0.888


@dataclass(frozen=True, slots=True)
class Outlook:
    """The chance of a photo at a pose.

    Attributes:
        scatter: standard deviation of the position that the noise of these matches causes, along
            all axes together, units of the world; infinity where so few determine none.
        apart: radians to the nearest mapping photo.
    """

    expected_inliers: float
    scatter: float
    apart: float


def outlook_of(
    sight: Sight, expected: NDArray[np.float64], share: float, camera: Camera, noise_px: float
) -> Outlook:
    """Add up what is in view.

    The uncertainty is that of the directions to the points: each match fixes both angles of one
    within noise by focal length. With the ray r and distance d, turning the camera by w and moving
    it by dt changes it by r x w + P dt / d, P projecting at right angles to r.

    Args:
        expected: (k,) matches expected of each place.
        share: of all places that those in view were drawn from.
        noise_px: standard deviation of a match along each axis of the picture.
    """
    total = float(expected.sum()) / share
    if total < _FEWEST:
        return Outlook(total, np.inf, sight.apart)
    weights = expected / share * (camera.focal_length / noise_px) ** 2
    rays, by_distance = sight.rays, weights / sight.distances
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    information = np.empty((6, 6))
    information[:3, :3] = np.einsum("n,nij->ij", weights, across)
    information[3:, 3:] = np.einsum("n,nij->ij", by_distance / sight.distances, across)
    information[:3, 3:] = cross_matrix(by_distance @ rays)
    information[3:, :3] = information[:3, 3:].T
    scale = np.sqrt(np.diag(information))
    if not (scale > 0).all():
        return Outlook(total, np.inf, sight.apart)
    unit_free = information / np.outer(scale, scale)
    if np.linalg.eigvalsh(unit_free)[0] < 1e-9:
        return Outlook(total, np.inf, sight.apart)
    variances = np.diag(np.linalg.inv(unit_free)) / scale**2
    return Outlook(total, float(np.sqrt(variances[3:].sum())), sight.apart)


@dataclass(frozen=True, slots=True, eq=False)
class Chance:
    """A logistic model of success.

    It rises with expected inliers, and falls with scatter and the distance to the nearest photo.

    Attributes:
        steps: (4,) float64: where all of them are even; per factor e of each.
        max_position_error: units of the world; what counts as success.
    """

    steps: NDArray[np.float64]
    max_position_error: float

    def of(self, outlooks: Sequence[Outlook]) -> NDArray[np.float64]:
        """Chances (n,) of success, 0 to 1."""
        return np.asarray(expit(_design(outlooks, self.max_position_error) @ self.steps))


def fit_chance(
    outlooks: Sequence[Outlook], succeeded: NDArray[np.bool_], max_position_error: float
) -> Chance:
    """Fit the model to runs; without any it is what was thought before.

    Args:
        outlooks: of n runs.
        succeeded: (n,) which were localized well.
        max_position_error: that was allowed, units of the world.
    """
    if not outlooks:
        return Chance(_PRIOR, max_position_error)
    design, wanted = _design(outlooks, max_position_error), succeeded.astype(np.float64)

    def loss(steps: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        logits = design @ steps
        off = (steps - _PRIOR) / _PRIOR_VARIANCE
        value = np.logaddexp(0.0, logits).sum() - wanted @ logits + 0.5 * off @ (steps - _PRIOR)
        return float(value), design.T @ (expit(logits) - wanted) + off

    bounds = [(None, None)] + [(0.0, None)] * 3
    found = minimize(loss, _PRIOR, jac=True, method="L-BFGS-B", bounds=bounds)
    return Chance(np.asarray(found.x), max_position_error)


@dataclass(frozen=True, slots=True, eq=False)
class Precision:
    """How large errors are where a photo is localized.

    Attributes:
        steps: (3,) float64 of the logarithm of the standard deviation: at the even distance to the
            nearest photo; per factor e of scatter; per factor e of that distance.
    """

    steps: NDArray[np.float64]

    def std(self, outlook: Outlook) -> float:
        """Standard deviation of the position along all axes together, units of the world."""
        if not np.isfinite(outlook.scatter):
            return np.inf
        return float(np.exp(_precision_design([outlook])[0] @ self.steps))


def fit_precision(
    outlooks: Sequence[Outlook], errors: NDArray[np.float64], max_position_error: float
) -> Precision:
    """Fit the model to the runs that were localized; without any it is what was thought before.

    Args:
        outlooks: of n runs.
        errors: (n,) of the position, units of the world; infinity when refused.
        max_position_error: larger ones are mistakes, not scatter.
    """
    scatters = np.array([outlook.scatter for outlook in outlooks])
    used = np.flatnonzero(np.isfinite(scatters) & (errors > 0) & (errors <= max_position_error))
    weight = np.sqrt(_PRECISION_PRIOR_WEIGHT)
    design = _precision_design([outlooks[int(row)] for row in used])
    wanted = np.log(errors[used] / _MEDIAN_LENGTH)
    found = lsq_linear(
        np.vstack([design, weight * np.eye(3)]),
        np.concatenate([wanted, weight * _PRECISION_PRIOR]),
        bounds=([-np.inf, 0.0, 0.0], np.inf),
    )
    return Precision(np.asarray(found.x))


def _precision_design(outlooks: Sequence[Outlook]) -> NDArray[np.float64]:
    scatters = np.array([outlook.scatter for outlook in outlooks])
    return np.column_stack([np.ones(len(outlooks)), np.log(scatters), _far(outlooks)])


def _design(outlooks: Sequence[Outlook], max_position_error: float) -> NDArray[np.float64]:
    inliers = np.array([outlook.expected_inliers for outlook in outlooks])
    scatters = np.array([outlook.scatter for outlook in outlooks]) / max_position_error
    return np.column_stack(
        [
            np.ones(len(outlooks)),
            np.log((inliers + 1.0) / _EVEN_INLIERS),
            -np.log(np.clip(scatters, 1e-6, _WORST_STD) / _EVEN_STD),
            -_far(outlooks),
        ]
    )


def _far(outlooks: Sequence[Outlook]) -> NDArray[np.float64]:
    """Logarithm (n,) of the distance to the nearest photo; 0 at the even one."""
    apart = np.array([outlook.apart for outlook in outlooks])
    return np.asarray(np.log(np.clip(apart + _LEAST_APART, 0.0, _MOST_APART) / _EVEN_APART))
