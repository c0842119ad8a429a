"""Weights of retrieved photos, with which their poses approximate that of the query.

Pion, Humenberger, Csurka, Cabon and Sattler, "Benchmarking Image Retrieval for Visual
Localization" (3DV 2020), section 3.1. The pose itself is averaged by ``visloc.pose.average``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from visloc.types import CoarseMethod

# Of the cosine in CSI; the paper's and kapture-localization's default.
CSI_POWER = 8.0

# Bound on the weights of BDI: a pose may lie so many times as far from the mean of the photos as
# they lie apart.
MOST_EXTRAPOLATED = 10.0

# From unit rows, the query (D,) and retrieved photos (k, D), to weights (k,) with sum 1.
Weighting = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def equal_weighted(query: NDArray[np.float64], photos: NDArray[np.float64]) -> NDArray[np.float64]:
    """EWB, equal weighted barycentre: ``w_i = 1 / k``."""
    del query
    return np.full(len(photos), 1.0 / len(photos))


def barycentric(query: NDArray[np.float64], photos: NDArray[np.float64]) -> NDArray[np.float64]:
    """BDI, barycentric descriptor interpolation: ``argmin |q - sum(w_i d_i)|`` with sum 1.

    Weights may be negative. If several solutions are equally good, as for identical photos, the one
    nearest to equal weights is returned. Photos that are almost identical would get huge weights of
    both signs, which say nothing and carry the pose far away. Weights are therefore drawn towards
    equal ones until their distances from these sum to ``MOST_EXTRAPOLATED`` at most.
    """
    equal = equal_weighted(query, photos)
    # Differences from equal weights that keep the sum: orthogonal to (1, ..., 1).
    centred = photos - photos.mean(axis=0)
    rest = np.linalg.lstsq(centred.T, query - equal @ photos, rcond=1e-9)[0]
    rest -= rest.mean()
    far = float(np.abs(rest).sum())
    return np.asarray(equal + rest * min(1.0, MOST_EXTRAPOLATED / max(far, MOST_EXTRAPOLATED)))


def cosine_similarity(
    query: NDArray[np.float64], photos: NDArray[np.float64]
) -> NDArray[np.float64]:
    """CSI, cosine similarity: ``w_i = (q . d_i)^8 / sum_j (q . d_j)^8``.

    A negative cosine counts as 0; the even power alone would make it positive. Equal weights if
    nothing is similar.
    """
    similar = np.maximum(photos @ query, 0.0)
    if similar.max(initial=0.0) <= 0.0:
        return equal_weighted(query, photos)
    powers = (similar / similar.max()) ** CSI_POWER
    return np.asarray(powers / powers.sum())


WEIGHTINGS: Mapping[CoarseMethod, Weighting] = {
    CoarseMethod.EWB: equal_weighted,
    CoarseMethod.BDI: barycentric,
    CoarseMethod.CSI: cosine_similarity,
}


def joined(
    descriptors: Mapping[str, NDArray[np.floating]], weights: Mapping[str, float] | None
) -> NDArray[np.float64]:
    """Join unit vectors (D,) or rows (n, D) of several global descriptors to one of unit length.

    The cosine of two joined vectors is the weighted mean of their cosines by descriptor.

    Args:
        weights: positive, of any sum, for each of them; None weighs all equally.
    """
    total = len(descriptors) if weights is None else sum(weights[name] for name in descriptors)
    parts = [
        np.asarray(rows, np.float64) * np.sqrt((1.0 if weights is None else weights[name]) / total)
        for name, rows in descriptors.items()
    ]
    return np.concatenate(parts, axis=-1)
