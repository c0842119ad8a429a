"""How far off the place of a map on Earth may be, from how its fixes scatter about it.

The place is a least-squares fit of a similarity, ``enu' = c + exp(s) Exp(w) (enu - c) + t`` about
the middle c of the fixes. With J the derivatives of the n fixed positions by (w, t, s), and D the
variances of the fixes, which are larger upwards than level, the parameters have the covariance

    (J^T J)^-1 J^T D J (J^T J)^-1        (White, 1980, for a known D)

D comes from the residuals of the fixes that the fit rests on, level and up apart: the sum of their
squares by the degrees of freedom that the fit left them, the diagonal of 1 - J (J^T J)^-1 J^T, less
two: the variance of Student's t, since few fixes tell their scatter badly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Geodetic
from visloc.archive.places import enu_of
from visloc.archive.schema import PlaceError
from visloc.geopose import place_jacobian

# A direction that the fit leaves fewer degrees of freedom takes the variance of both.
_LEAST_FREEDOM = 3.0


def place_error(
    geodetic: Geodetic,
    points: NDArray[np.float64],
    positions: NDArray[np.float64],
    *,
    fits_scale: bool = True,
) -> PlaceError | None:
    """Return the error of a place that was fitted to fixes; None where they leave nothing over.

    Args:
        points: (n, 3) of the world, those that the fit rests on.
        positions: (n, 3) where they were said to be, metres east, north and up of the place.
    """
    placed = enu_of(points, geodetic)
    middle = placed.mean(axis=0)
    parameters = 7 if fits_scale else 6
    jacobian = place_jacobian(placed - middle)[:, :, :parameters].reshape(-1, parameters)
    gain = np.linalg.pinv(jacobian)
    # Points at the very same position, such as those of a rig at one fix, are one measurement.
    distinct = len(np.unique(positions, axis=0)) / len(positions)
    squares = distinct * np.square(placed - positions)
    freedom = distinct - np.einsum("ij,ji->i", jacobian, gain).reshape(-1, 3)
    if freedom.sum() < _LEAST_FREEDOM:
        return None
    both = _variance(squares, freedom)
    level, up = (
        _variance(squares[:, axes], freedom[:, axes])
        if freedom[:, axes].sum() >= _LEAST_FREEDOM
        else both
        for axes in (slice(0, 2), slice(2, 3))
    )
    variances = np.tile([level, level, up], len(points))
    covariance = np.zeros((7, 7))
    covariance[:parameters, :parameters] = (gain * variances) @ gain.T / distinct
    return PlaceError.model_validate(
        {
            "middle": middle.tolist(),
            "covariance": [row.tolist() for row in (covariance + covariance.T) / 2],
            "level": float(np.sqrt(level)),
            "up": float(np.sqrt(up)),
        }
    )


def _variance(squares: NDArray[np.float64], freedom: NDArray[np.float64]) -> float:
    """Return the variance of Student's t with so many degrees of freedom for its scale."""
    return float(squares.sum() / (freedom.sum() - 2))
