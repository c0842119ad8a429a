"""Late fusion: one score per mapping photo from its cosine similarities to the query.

Section 3.2 of Humenberger et al. 2020. An operator takes similarities (m, n), one row per global
descriptor, and gives fused scores (n,).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GHARM_GAMMA = 0.5


def gharm(similarities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Generalized harmonic mean with gamma 0.5 and equal weights 1 / m.

    ``1 / mean(1 / (gamma + s_i / m)) - gamma``. A low similarity under one descriptor pulls the
    score down more than in the arithmetic mean. The result lies within [-1/m, 1/m]: it is not a
    cosine and must not be compared with one. A single descriptor keeps its cosine. For m = 2 the
    formula has its pole at s = -1; the limit, -gamma, is returned there.
    """
    m = len(similarities)
    if m == 1:
        return np.asarray(similarities[0])
    shifted = GHARM_GAMMA + similarities / m
    # With m >= 2 and s >= -1 nothing is negative but by rounding; the tiny floor is the limit.
    shifted = np.maximum(shifted, 1e-12)
    return np.asarray(m / np.sum(1.0 / shifted, axis=0) - GHARM_GAMMA)
