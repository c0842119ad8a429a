"""VLAD: many descriptors of one photo, its words, summed up in one vector.

Aggregation after Jegou et al., "Aggregating local descriptors into a compact image
representation" (CVPR 2010), with the intra-normalization of Arandjelovic and Zisserman, "All
about VLAD" (CVPR 2013). Vocabulary and whitening are learned on the photos of the map itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from visloc.features.base import Fingerprint
from visloc.types import LocalFeatures

VOCABULARY_SIZE = 128
KMEANS_ITERATIONS = 20
KMEANS_MAX_WORDS = 100_000
TRAINING_WORDS_PER_PHOTO = 1000

# Full whitening (1) learns the noise of a small map. On maps of 20 to 60 photos it lost up to 40 %
# of the mapping photos nearest to a query from its first ten; 0.5 lost up to 10 %, 0.25 almost
# none, and it still tones down what all photos of a map share.
WHITENING_EXPONENT = 0.25
WHITENING_MAX_DIMS = 1024
WHITENING_MAX_PHOTOS = 2048


def learn_words(words: NDArray[np.float32], count: int, seed: int) -> NDArray[np.float32]:
    """Cluster words by k-means (Lloyd) and return the centres (min(count, n), d).

    Of more than ``KMEANS_MAX_WORDS`` words a seeded sample is used. Equal words and seeds give
    equal centres.

    Args:
        words: (n, d); n may be 0.
        count: how many centres are wanted.
        seed: of the sample and of the first centres.
    """
    random = np.random.default_rng(seed)
    if len(words) > KMEANS_MAX_WORDS:
        words = words[np.sort(random.choice(len(words), KMEANS_MAX_WORDS, replace=False))]
    count = min(count, len(words))
    if count == 0:
        return np.zeros((0, words.shape[1]), np.float32)
    centres = words[np.sort(random.choice(len(words), count, replace=False))].astype(np.float32)
    for _ in range(KMEANS_ITERATIONS):
        sums, counts = _sum_by_nearest(words, centres)
        # A centre that lost all its words stays where it is.
        used = counts > 0
        centres[used] = sums[used] / counts[used, None]
    return centres


def aggregate(words: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the VLAD vector (K * d,) of words (n, d) for centres (K, d).

    Per centre the differences of its words to it are summed, each sum is scaled to unit length
    (intra-normalization), then the whole vector. Without words, or when every word is a centre,
    the vector is zero.
    """
    if len(words) == 0 or len(centres) == 0:
        return np.zeros(centres.size, np.float32)
    sums, counts = _sum_by_nearest(words, centres)
    residuals: NDArray[np.float32] = sums - counts[:, None] * centres
    # What words right at their centre leave is rounding, not a direction.
    floor = np.float32(1e-5) * np.linalg.norm(sums, axis=1, keepdims=True)
    return _unit_rows(_unit_rows(residuals, floor).ravel())


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
    return _unit_rows(projected, 1e-6)


class VladDescriptor(ABC):
    """A ``GlobalDescriptor`` by VLAD; a subclass says what the words of a photo are.

    Its model holds ``vocabulary`` (K, d), ``mean`` (R,) and ``axes`` (R, D), R = K * d.
    """

    @property
    @abstractmethod
    def fingerprint(self) -> Fingerprint:
        """Name and parameters; kept in the manifest of every map."""

    @property
    @abstractmethod
    def needs_image(self) -> bool:
        """Whether it looks at the pixels; if not, ``rgb`` may be an image without any."""

    @abstractmethod
    def words(self, rgb: NDArray[np.uint8], local: LocalFeatures) -> NDArray[np.float32]:
        """Return the words (n, d) of one photo, rows of unit length; n may be 0."""

    def training_words(
        self, rgb: NDArray[np.uint8], local: LocalFeatures, seed: int
    ) -> NDArray[np.float32]:
        """Return a seeded sample (n, d) of the photo's words, n <= 1000."""
        words = self.words(rgb, local)
        if len(words) <= TRAINING_WORDS_PER_PHOTO:
            return words
        random = np.random.default_rng(seed)
        return words[np.sort(random.choice(len(words), TRAINING_WORDS_PER_PHOTO, replace=False))]

    def learn_vocabulary(
        self, words: NDArray[np.float32], seed: int
    ) -> dict[str, NDArray[np.float32]]:
        """Learn ``vocabulary`` (K, d) from words (n, d); K is 128, or n when that is less."""
        return {"vocabulary": learn_words(words, VOCABULARY_SIZE, seed)}

    def pool(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,
        vocabulary: Mapping[str, NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        """Aggregate one photo to a raw vector (R,) of unit length; zero for a blank photo."""
        return aggregate(self.words(rgb, local), vocabulary["vocabulary"])

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
        """Return ``project(pool(...))``: (D,), unit length, or zero for a blank photo."""
        return self.project(self.pool(rgb, local, model), model)


# What every VLAD descriptor's fingerprint holds.
VLAD_PARAMETERS: Mapping[str, int | float | str] = {
    "vocabulary_size": VOCABULARY_SIZE,
    "kmeans_iterations": KMEANS_ITERATIONS,
    "kmeans_max_words": KMEANS_MAX_WORDS,
    "training_words_per_photo": TRAINING_WORDS_PER_PHOTO,
    "whitening_exponent": WHITENING_EXPONENT,
    "whitening_max_dims": WHITENING_MAX_DIMS,
    "whitening_max_photos": WHITENING_MAX_PHOTOS,
}


def _sum_by_nearest(
    words: NDArray[np.float32], centres: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Sum the words (n, d) nearest to each of the centres (K, d): sums (K, d), counts (K,)."""
    # |w - c|^2 is least where w.c - |c|^2 / 2 is greatest; of equal ones the first is taken.
    closeness = words @ centres.T
    closeness -= 0.5 * np.square(centres).sum(axis=1)
    nearest = closeness.argmax(axis=1)
    n, k = len(words), len(centres)
    membership = sparse.csr_array((np.ones(n, np.float32), nearest, np.arange(n + 1)), shape=(n, k))
    counts = np.bincount(nearest, minlength=k).astype(np.float32)
    return np.asarray(membership.T @ words, dtype=np.float32), counts


def _unit_rows(
    rows: NDArray[np.float32], floor: NDArray[np.float32] | float = 0.0
) -> NDArray[np.float32]:
    """Scale rows (..., d) to unit length; those not longer than ``floor`` become zero."""
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    unit = np.zeros_like(rows)
    np.divide(rows, lengths, out=unit, where=lengths > floor)
    return unit
