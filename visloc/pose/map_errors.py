"""What a map adds to the uncertainty of a pose: errors that its landmarks share.

The residuals of one photo cannot show them: a depth that is off, a calibration, the poses of
mapping photos, a map that is bent. A map's own test measures them (``mapping.own_test``).
"""

from __future__ import annotations

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
    """

    position_factor: float
    orientation_factor: float
    uncertainty: Uncertainty = Uncertainty.WHOLE

    def whole(self, rig_from_world: Pose, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Widen the covariance (6, 6) of a pose by the errors of the map.

        Rotation w and centre e, both in the rig's axes, are scaled apart, which keeps how they hang
        together: e = -(dt + [t] w), with [t] the matrix of the cross product. That matrix is its
        own inverse.
        """
        if self.uncertainty is Uncertainty.PHOTO_ONLY:
            return covariance  # to the last bit
        centred = np.eye(6)
        centred[3:, 3:] *= -1.0
        centred[3:, :3] = -cross_matrix(rig_from_world.translation)
        factors = np.repeat([self.orientation_factor, self.position_factor], 3)
        widening = centred @ (factors[:, None] * centred)
        whole = widening @ covariance @ widening.T
        return np.asarray((whole + whole.T) / 2)


# Of maps that were never tested: what is stated is the photo's part alone.
PHOTO_ONLY = MapErrors(1.0, 1.0, Uncertainty.PHOTO_ONLY)
