"""From the cells of a feature map to one vector."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Smaller values are raised to this, since a power of a negative number means nothing.
MIN_ACTIVATION = 1e-6


def generalized_mean(features: NDArray[np.float32], exponent: float) -> NDArray[np.float32]:
    """Return (C,), per channel the generalized mean over the cells of features (C, h, w).

    (mean of max(f, 1e-6)^p)^(1/p), from Radenovic et al., "Fine-tuning CNN image retrieval with no
    human annotation" (TPAMI 2018), equation 3: 1 is the mean, towards infinity the maximum.
    """
    cells = np.maximum(features.reshape(len(features), -1), MIN_ACTIVATION).astype(np.float64)
    means: NDArray[np.float64] = np.mean(cells**exponent, axis=1) ** (1.0 / exponent)
    return means.astype(np.float32)
