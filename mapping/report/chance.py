"""The chance of being localized well, from what is expected to be found again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from mapping.report.sight import Sight
from visloc.geometry import Camera, cross_matrix
from visloc.types import DEFAULT_PRESET, PRESETS

# A pose has six numbers, a match two.
_FEWEST = 4.0
# What is thought before any run was seen: even chances at twice the inliers that a pose needs, and
# a position that is a tenth as uncertain as it may be; steeper with inliers than with uncertainty.
_PRIOR = np.array([0.0, 2.0, 0.5])
_EVEN_INLIERS = 2.0 * PRESETS[DEFAULT_PRESET].min_inliers
_EVEN_STD = 0.1
_PRIOR_VARIANCE = 1.0
# Of the allowed error; beyond, nothing is worse.
_WORST_STD = 10.0


@dataclass(frozen=True, slots=True)
class Outlook:
    """What a photo can expect at a pose.

    Attributes:
        expected_inliers: correct matches.
        position_std: of the position along all axes together, units of the world; infinity where
            so few matches determine none.
    """

    expected_inliers: float
    position_std: float


def outlook_of(
    sight: Sight, expected: NDArray[np.float64], share: float, camera: Camera, noise_px: float
) -> Outlook:
    """Add up what is in view.

    The uncertainty is that of the directions to the points: each match fixes both angles of one
    within noise by focal length. With the ray r and distance d, turning the camera by w and moving
    it by dt changes it by r x w + P dt / d, P projecting at right angles to r.

    Args:
        sight: what is in view.
        expected: (k,) matches expected of each place.
        share: of all places that those in view were drawn from.
        camera: of the photo.
        noise_px: standard deviation of a match along each axis of the picture.
    """
    total = float(expected.sum()) / share
    if total < _FEWEST:
        return Outlook(total, np.inf)
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
        return Outlook(total, np.inf)
    unit_free = information / np.outer(scale, scale)
    if np.linalg.eigvalsh(unit_free)[0] < 1e-9:
        return Outlook(total, np.inf)
    variances = np.diag(np.linalg.inv(unit_free)) / scale**2
    return Outlook(total, float(np.sqrt(variances[3:].sum())))


@dataclass(frozen=True, slots=True, eq=False)
class Chance:
    """A logistic model of success, that rises with expected inliers and falls with uncertainty.

    Attributes:
        steps: (3,) float64: at even inliers and uncertainty; per factor e of more inliers; per
            factor e of less uncertainty.
        max_position_error: units of the world; what counts as success.
    """

    steps: NDArray[np.float64]
    max_position_error: float

    def of(self, outlooks: list[Outlook]) -> NDArray[np.float64]:
        """Chances (n,) of success, 0 to 1."""
        return np.asarray(expit(_design(outlooks, self.max_position_error) @ self.steps))


def fit_chance(
    outlooks: list[Outlook], succeeded: NDArray[np.bool_], max_position_error: float
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

    bounds = [(None, None), (0.0, None), (0.0, None)]
    found = minimize(loss, _PRIOR, jac=True, method="L-BFGS-B", bounds=bounds)
    return Chance(np.asarray(found.x), max_position_error)


def _design(outlooks: list[Outlook], max_position_error: float) -> NDArray[np.float64]:
    inliers = np.array([outlook.expected_inliers for outlook in outlooks])
    stds = np.array([outlook.position_std for outlook in outlooks]) / max_position_error
    return np.column_stack(
        [
            np.ones(len(outlooks)),
            np.log((inliers + 1.0) / _EVEN_INLIERS),
            -np.log(np.clip(stds, 1e-6, _WORST_STD) / _EVEN_STD),
        ]
    )
