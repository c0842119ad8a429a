"""How sharp a frame is."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SHARPNESS_SIDE = 960  # of the longer side: motion blur of a pixel or two is visible at this size


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of grey levels (h, w), comparable among near frames."""
    return float(cv2.Laplacian(cv2.GaussianBlur(grey, (3, 3), 0), cv2.CV_32F).var())
