"""Whitening of global descriptors, learned on the photos of the map itself."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from visloc.types import LocalFeatures

# Full whitening (1) learns the noise of a small map. On maps of 20 to 60 photos it lost up to 40 %
# of the mapping photos nearest to a query from its first ten; 0.5 lost up to 10 %, 0.25 almost
# none, and it still tones down what all photos of a map share.
WHITENING_EXPONENT = 0.25
WHITENING_MAX_DIMS = 1024
WHITENING_MAX_PHOTOS = 2048
# The part of the fingerprint that all descriptors whitened in this way share.
WHITENING_PARAMETERS: Mapping[str, int | float | str] = {
    "whitening_exponent": WHITENING_EXPONENT,
    "whitening_max_dims": WHITENING_MAX_DIMS,
    "whitening_max_photos": WHITENING_MAX_PHOTOS,
}


class WhitenedDescriptor(ABC):
    """The part of a ``GlobalDescriptor`` that whitens raw vectors, as learned on the map."""

    @abstractmethod
    def pool(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,
        vocabulary: Mapping[str, NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        """Return the raw vector (R,) of one photo, of unit length or zero."""

    def learn_projection(self, pooled: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """Learn ``mean`` (R,) and ``axes`` (R, D) from the raw vectors (n, R) of a map."""
        mean, axes = learn_whitening(pooled)
        return {"mean": mean, "axes": axes}

    def project(
        self, pooled: NDArray[np.float32], model: Mapping[str, NDArray[np.float32]]
    ) -> NDArray[np.float32]:
        """Whiten raw vectors (..., R) to rows (..., D) of unit length; zero rows stay zero."""
        return whiten(pooled, model["mean"], model["axes"])

    def describe(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,
        model: Mapping[str, NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        """Return ``project(pool(...))``: (D,), unit length, or zero for a vector of zeros."""
        return self.project(self.pool(rgb, local, model), model)


def learn_whitening(
    pooled: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the mean (R,) and the axes (R, D) of partial PCA whitening.

    Axis i is an eigenvector of the covariance, scaled by its variance to the power
    ``-WHITENING_EXPONENT / 2``: 0 would only rotate, 1 would make all variances equal. D is at
    most ``WHITENING_MAX_DIMS`` and at most the rank of the centred vectors, so n - 1.

    Vectors that do not differ (one photo, or the same photo again and again) have no covariance:
    then the mean is zero and their common direction the only axis. Without any vector but zeros,
    the only axis is zero.

    Args:
        pooled: (n, R), rows of unit length; zero rows, of blank photos, teach nothing and are
            left out. Of more than ``WHITENING_MAX_PHOTOS`` rows evenly spaced ones are used.
    """
    rows = pooled[pooled.any(axis=1)]
    if len(rows) > WHITENING_MAX_PHOTOS:
        rows = rows[np.linspace(0, len(rows) - 1, WHITENING_MAX_PHOTOS).astype(np.int64)]
    size = pooled.shape[1]
    if len(rows) == 0:
        return np.zeros(size, np.float32), np.zeros((size, 1), np.float32)
    mean = rows.mean(axis=0, dtype=np.float64)
    centred = rows - mean
    # Photos are fewer than the thousands of dimensions R: the n x n Gram matrix has the same
    # eigenvalues as the R x R covariance, and its eigenvectors lead to those of the other.
    variances, vectors = np.linalg.eigh(centred @ centred.T / len(rows))
    variances, vectors = variances[::-1], vectors[:, ::-1]
    # Rows are of unit length, so variances below 1e-10 are rounding; those far below the largest
    # are of photos so alike that their difference means nothing.
    significant = variances > max(1e-10, 1e-6 * variances[0])
    variances = variances[significant][:WHITENING_MAX_DIMS]
    vectors = vectors[:, significant][:, :WHITENING_MAX_DIMS]
    if len(variances) == 0:
        return np.zeros(size, np.float32), mean[:, None].astype(np.float32)
    axes = centred.T @ vectors / np.sqrt(len(rows) * variances)
    axes *= variances ** (-WHITENING_EXPONENT / 2.0)
    return mean.astype(np.float32), np.ascontiguousarray(axes, dtype=np.float32)


def whiten(
    pooled: NDArray[np.float32], mean: NDArray[np.float32], axes: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Project raw vectors (..., R) to rows (..., D) of unit length; zero rows stay zero."""
    projected: NDArray[np.float32] = np.matmul(pooled - mean, axes)
    projected[~pooled.any(axis=-1)] = 0.0
    # A vector at the very mean has no direction but rounding.
    return unit_rows(projected, 1e-6)


def unit_rows(
    rows: NDArray[np.float32], floor: NDArray[np.float32] | float = 0.0
) -> NDArray[np.float32]:
    """Scale rows (..., d) to unit length; those not longer than ``floor`` become zero."""
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    unit = np.zeros_like(rows)
    np.divide(rows, lengths, out=unit, where=lengths > floor)
    return unit
