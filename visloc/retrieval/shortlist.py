"""Selects the photos of a very large map that are compared with a query.

An inverted file (Sivic and Zisserman 2003) in plain arrays: the rows of one global descriptor are
clustered by spherical k-means, and the clusters nearest to the query are compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.retrieval.products import dot_products

# With 2 sqrt(n) clusters, comparing the centres takes as long as comparing a few clusters.
_CLUSTERS_PER_ROOT = 2.0
_SAMPLES_PER_CLUSTER = 50
_ITERATIONS = 10
_BLOCK_ROWS = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """The photos of a map, clustered by one global descriptor.

    Attributes:
        centers: (C, D) float32 unit rows.
        offsets: (C + 1,) int64; members offsets[c]:offsets[c + 1] belong to cluster c.
        members: (n,) uint32 rows of the map's image table, each once.
    """

    centers: NDArray[np.float32]
    offsets: NDArray[np.int64]
    members: NDArray[np.uint32]

    def nearest(
        self, query: NDArray[np.float32], count: int, allowed: NDArray[np.bool_] | None
    ) -> NDArray[np.int64]:
        """Photos of the clusters nearest to a query, at least ``count`` if there are so many.

        Args:
            query: unit vector (D,).
            count: minimum number of photos.
            allowed: (n,) the photos that may be returned; None for all.
        """
        found: list[NDArray[np.int64]] = []
        wanted = count
        # A stable sort, so that equal clusters keep their order on every machine.
        for cluster in np.argsort(-dot_products(self.centers, query), kind="stable"):
            if wanted <= 0:
                break
            start, stop = self.offsets[cluster], self.offsets[cluster + 1]
            photos = self.members[start:stop].astype(np.int64)
            found.append(photos if allowed is None else photos[allowed[photos]])
            wanted -= len(found[-1])
        return np.concatenate(found) if found else np.empty(0, np.int64)


def make_clusters(rows: NDArray[np.float32], seed: int = 0) -> Clusters:
    """Cluster unit rows (n, D), reading only blocks and a sample into memory."""
    num = len(rows)
    count = min(num, round(_CLUSTERS_PER_ROOT * math.sqrt(num)))
    random = np.random.default_rng(seed)
    chosen = np.sort(random.choice(num, min(num, _SAMPLES_PER_CLUSTER * count), replace=False))
    sample = np.asarray(rows[chosen], np.float32)
    centers = sample[np.sort(random.choice(len(sample), count, replace=False))]
    for _ in range(_ITERATIONS):
        nearest = _nearest(sample, centers)
        order = np.argsort(nearest, kind="stable")
        used, starts = np.unique(nearest[order], return_index=True)
        # A centre that lost all its rows stays where it is.
        centers[used] = _unit(np.add.reduceat(sample[order], starts, axis=0))
    cluster = _nearest(rows, centers)
    sizes = np.bincount(cluster, minlength=count)
    return Clusters(
        centers,
        np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        np.argsort(cluster, kind="stable").astype(np.uint32),
    )


def united(photos: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """The union of several selections of photos, in the order of the map."""
    return np.unique(np.concatenate(photos))


def _nearest(rows: NDArray[np.float32], centers: NDArray[np.float32]) -> NDArray[np.int64]:
    nearest = np.empty(len(rows), np.int64)
    for start in range(0, len(rows), _BLOCK_ROWS):
        block = slice(start, start + _BLOCK_ROWS)
        nearest[block] = (rows[block] @ centers.T).argmax(axis=1)
    return nearest


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(lengths, np.float32(1e-12)))
