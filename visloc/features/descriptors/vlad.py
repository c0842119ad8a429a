"""VLAD: many descriptors of one photo, its words, summed up in one vector.

Aggregation after Jegou et al., "Aggregating local descriptors into a compact image
representation" (CVPR 2010), with the intra-normalization of Arandjelovic and Zisserman, "All
about VLAD" (CVPR 2013). Vocabulary and whitening are learned on the photos of the map itself.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from visloc.features.base import Fingerprint, GlobalDescriptor
from visloc.features.descriptors.whitening import (
    WHITENING_PARAMETERS,
    WhitenedDescriptor,
    unit_rows,
)
from visloc.options import Inference
from visloc.types import LocalFeatures

VOCABULARY_SIZE = 128
KMEANS_ITERATIONS = 20
KMEANS_MAX_WORDS = 100_000
TRAINING_WORDS_PER_PHOTO = 1000


def learn_words(words: NDArray[np.float32], count: int, seed: int) -> NDArray[np.float32]:
    """Cluster words by k-means (Lloyd) and return the centres (min(count, n), d).

    Of more than ``KMEANS_MAX_WORDS`` words a seeded sample is used. Equal words and seeds give
    equal centres.

    Args:
        words: (n, d); n may be 0.
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
    return vlad_of_sums(*_sum_by_nearest(words, centres), centres)


def vlad_of_sums(
    sums: NDArray[np.float32], counts: NDArray[np.float32], centres: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the VLAD vector (K * d,) from the sums (K, d) and counts (K,) of centres' words."""
    residuals: NDArray[np.float32] = sums - counts[:, None] * centres
    # Words that lie exactly at their centre leave only rounding errors, which are no direction.
    floor = np.float32(1e-5) * np.linalg.norm(sums, axis=1, keepdims=True)
    return unit_rows(unit_rows(residuals, floor).ravel())


class VladDescriptor(WhitenedDescriptor):
    """A ``GlobalDescriptor`` by VLAD; a subclass says what the words of a photo are.

    Its model holds ``vocabulary`` (K, d), ``mean`` (R,) and ``axes`` (R, D), R = K * d.
    """

    fingerprint: Fingerprint
    needs_image: bool
    needs_local_features: bool
    needs_vocabulary = True
    computed_with: str | None = None  # plain code

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
        """Aggregate one photo to a raw vector (R,) of unit length; zero where no word was found."""
        return aggregate(self.words(rgb, local), vocabulary["vocabulary"])


# The part of the fingerprint that all VLAD descriptors share.
VLAD_PARAMETERS: Mapping[str, int | float | str] = {
    "vocabulary_size": VOCABULARY_SIZE,
    "kmeans_iterations": KMEANS_ITERATIONS,
    "kmeans_max_words": KMEANS_MAX_WORDS,
    "training_words_per_photo": TRAINING_WORDS_PER_PHOTO,
    **WHITENING_PARAMETERS,
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


def load_localvlad(
    _weights_dir: Path | None = None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> GlobalDescriptor:
    """Make the descriptor, which needs no weights."""
    return LocalVlad()


class LocalVlad(VladDescriptor):
    """A photo's words are the descriptors of its local features, whatever their length."""

    # The local features have a fingerprint of their own.
    fingerprint = Fingerprint("localvlad", revision=1, parameters=dict(VLAD_PARAMETERS))
    needs_image = False
    needs_local_features = True

    def words(
        self,
        rgb: NDArray[np.uint8],  # noqa: ARG002 - not needed
        local: LocalFeatures,
    ) -> NDArray[np.float32]:
        """Return the local features' descriptors (N, D)."""
        return local.descriptors


ORIENTATIONS = 8  # a power of two
CELLS_PER_SIDE = 4
# A cell is this wide in the photo shrunk for its scale; patches overlap by all but one cell.
CELL_PX = 4
# Grey levels between the neighbours of a pixel, averaged over a patch: below, it is mere noise.
MIN_CONTRAST = 1.0


def tent() -> NDArray[np.float32]:
    """Return the weights of a cell's pixels along one axis: twice as wide as the cell."""
    weights = np.convolve(np.ones(CELL_PX), np.ones(CELL_PX)) / CELL_PX**2
    return weights.astype(np.float32)
