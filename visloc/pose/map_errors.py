"""The errors of a map, which its landmarks share: they add to the uncertainty of every pose.

The residuals of one photo cannot show them: a depth that is off, a calibration, the poses of
mapping photos, a map that is bent. A map's own test measures them (``mapping.own_test``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose, cross_matrix
from visloc.types import Uncertainty


@dataclass(frozen=True, slots=True)
class MapErrors:
    """How much further poses in a map are off than the scatter of their photos tells.

    Attributes:
        position_factor: of the standard deviations of the camera's centre; at least 1.
        orientation_factor: of the standard deviations of the rotation about that centre.
        uncertainty: whether the factors were measured.
        position_std: by how much the map as a whole is bent, along each axis of the world: standard
            deviation, in its unit.
    """

    position_factor: float
    orientation_factor: float
    uncertainty: Uncertainty = Uncertainty.WHOLE
    position_std: float = 0.0

    def whole(
        self,
        rig_from_world: Pose,
        covariance: NDArray[np.float64],
        of_camera: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Widen the covariance (6, 6) of a pose by the errors of the map.

        The part of it that comes from the doubt in the camera, ``of_camera``, stays: no landmark
        has a say in it. Rotation w and centre e, both in the rig's axes, are scaled apart, which
        keeps how they hang together: e = -(dt + [t] w), with [t] the matrix of the cross product.
        That matrix is its own inverse.
        """
        if self.uncertainty is Uncertainty.PHOTO_ONLY:
            return covariance  # to the last bit
        factors = self.orientation_factor, self.position_factor
        if of_camera is None:
            return self._bent(_widened(rig_from_world, covariance, *factors))
        widened = _widened(rig_from_world, covariance - of_camera, *factors)
        return self._bent(widened + of_camera)

    def part(self, rig_from_world: Pose, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the part (6, 6) of the whole covariance that is the map's own.

        Poses next to each other share these errors, which no number of photos averages out. Added
        to the photo's ``covariance``, it gives the variances that ``whole`` has, of the rotation
        and of the camera's centre. It is a covariance itself, as their difference not always is.
        """
        factors = self.orientation_factor, self.position_factor
        beyond = (math.sqrt(f**2 - 1.0) for f in factors)
        return self._bent(_widened(rig_from_world, covariance, *beyond))

    def _bent(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Add what the whole map is off by, the same in all directions."""
        if self.position_std == 0.0:
            return covariance  # to the last bit
        # dt = -R e, and R takes nothing away from what is the same in all directions.
        moved = np.repeat([0.0, self.position_std**2], 3)
        return np.asarray(covariance + np.diag(moved))


def _widened(
    rig_from_world: Pose,
    covariance: NDArray[np.float64],
    orientation_factor: float,
    position_factor: float,
) -> NDArray[np.float64]:
    centred = np.eye(6)
    centred[3:, 3:] *= -1.0
    centred[3:, :3] = -cross_matrix(rig_from_world.translation)
    factors = np.repeat([orientation_factor, position_factor], 3)
    widening = centred @ (factors[:, None] * centred)
    widened = widening @ covariance @ widening.T
    return np.asarray((widened + widened.T) / 2)


# Of maps that were never tested: what is stated is the photo's part alone.
PHOTO_ONLY = MapErrors(1.0, 1.0, Uncertainty.PHOTO_ONLY)
