"""Learn from known poses by how much poses are further off than their photos tell."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

from visloc.archive.schema import MAX_FACTOR

_DIMENSIONS = 3
# Degrees of freedom of Student's t. Errors of held-out mapping photos are nearly normal; eight
# degrees of freedom leave room for some outliers.
_FREEDOM = 8
# The prior of the factor: about the median of six maps, and its weight as a number of photos.
_PRIOR_FACTOR, _PRIOR_PHOTOS = 2.0, 8.0
# A covariance is read with normal quantiles. So that 95 % of such errors lie in the ellipsoid that
# a normal distribution has for 95 %, it is wider by the ratio of both quantiles.
_SHARE = 0.95
_TAIL = math.sqrt(
    _DIMENSIONS * fdtri(_DIMENSIONS, _FREEDOM, _SHARE) / chdtri(_DIMENSIONS, 1.0 - _SHARE)
)
_MAX_ROUNDS, _SETTLED = 200, 1e-9
_LEAST_VARIANCE = 1e-12


def mahalanobis2(
    errors: NDArray[np.float64], covariances: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Squared lengths (n,) of errors (n, 3) in units of their covariances (n, 3, 3)."""
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", errors, solved))


def fitted_factor(squares: NDArray[np.float64]) -> float:
    """Fit by how much standard deviations are too small, at least 1.

    The scale of a multivariate t distribution by maximum likelihood (Lange, Little and Taylor
    1989), whose weights reduce the effect of outliers: s^2 is a third of the mean of
    (v + 3) m / (v + m / s^2). A map that is worse than usual is believed at once. A map that seems
    better is averaged with some photos of a usual map, so it needs many photos to be believed.

    Args:
        squares: (n,) squared errors of three dimensions in units of what the photos tell, m.

    Returns:
        The factor for which 95 % of such errors lie inside the normal ellipsoid of 95 %.
    """
    variance = _scale2(squares, _PRIOR_PHOTOS)
    if len(squares):
        variance = max(variance, _scale2(squares, 0.0))
    return min(max(_TAIL * math.sqrt(variance), 1.0), MAX_FACTOR)


def _scale2(squares: NDArray[np.float64], prior_photos: float) -> float:
    """Squared scale of the t distribution, with so many photos of a usual map beside."""
    variance = _PRIOR_FACTOR**2
    prior = _DIMENSIONS * prior_photos * _PRIOR_FACTOR**2
    for _ in range(_MAX_ROUNDS):
        weighted = (_FREEDOM + _DIMENSIONS) * squares / (_FREEDOM + squares / variance)
        new = (weighted.sum() + prior) / (_DIMENSIONS * (len(squares) + prior_photos))
        new = max(float(new), _LEAST_VARIANCE)  # of photos that are exact
        settled = abs(math.log(new / variance)) < _SETTLED
        variance = new
        if settled:
            break
    return variance
