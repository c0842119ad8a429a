"""Ranks the mapping photos by similarity to the query, and those to compare with."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from visloc.retrieval.fusion import EQUAL_GHARM, LateFusion
from visloc.retrieval.inverted import InvertedFile, dot_products, largest

# Maps with more photos get an inverted file, unless a build asks for something else.
MAX_EXACT = 10_000
# In a map with an inverted file, up to so many photos that priors allow are all compared.
_MAX_ALLOWED_EXACT = 2000
# Photos that each descriptor proposes, and lists that it searches (docs/performance.md).
_MIN_PROPOSED, _PROPOSED_PER_RESULT = 300, 10
_LISTS = 50
# Larger than any cosine, and than any bound of a cosine from codes.
_ABOVE_ALL = 2.0
# If proposals do not stand out among at most so many photos, the codes of all are compared. So many
# of the best, and this share, are compared under the first descriptor, and the best half of these
# under the next.
_MAX_DOUBTFUL, _DOUBTFUL_ROWS, _DOUBTFUL_SHARE = 50_000, 1500, 0.09
_KEPT_BY_EACH = 0.5
# Among more photos, so many times as many are proposed, from so many times as many lists, if less
# than half of the wanted photos stand out: then the query's place is not among the proposals.
_WIDER_PROPOSED, _WIDER_LISTS = 20, 4


class IndexKind(StrEnum):
    """How the photos of a map are searched: ``auto`` is ``ivf`` beyond ``MAX_EXACT`` photos."""

    AUTO = "auto"
    FLAT = "flat"
    IVF = "ivf"


@dataclass(frozen=True, slots=True, eq=False)
class Retrieved:
    """The best mapping photos, best first.

    Attributes:
        images: (k,) int64 rows of the map's image table.
        scores: (k,) float64, fused.
        similarities: (k,) float64 cosine similarity by global descriptor.
    """

    images: NDArray[np.int64]
    scores: NDArray[np.float64]
    similarities: Mapping[str, NDArray[np.float64]]


def retrieve(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    top_k: int,
    photo_weights: NDArray[np.float64] | None = None,
    fusion: LateFusion = EQUAL_GHARM,
) -> Retrieved:
    """Rank the photos of a map by fused similarity to a query.

    In maps with an inverted file, each descriptor proposes the photos most like the query by their
    codes, and all proposals are compared under all descriptors. If they do not stand out, more are
    proposed. In other maps, and if priors leave few photos, all photos are compared.

    Args:
        query: unit vector (D,) by global descriptor; a zero vector is similar to nothing.
        index: unit rows of the map's photos by global descriptor.
        top_k: number of photos; fewer if the map has fewer.
        photo_weights: (n,) from 0, which excludes a photo, to 1. They scale the distance of a
            score from the lowest one, for ranking only: returned scores are not changed.
        fusion: fuses similarities into scores; it must use at least one of the descriptors.
    """
    index = {name: index[name] for name in fusion.counted(index)}
    allowed = None if photo_weights is None else photo_weights > 0
    compared, cosines = _compared(query, index, top_k, allowed, fusion)
    scores = fusion.scores(cosines)
    photos = np.arange(len(scores)) if compared is None else compared
    candidates = np.arange(len(scores))
    ranked = scores
    if photo_weights is not None:
        candidates = np.flatnonzero(photo_weights[photos])
        ranked = scores[candidates]
        ranked = (ranked - ranked.min(initial=np.inf)) * photo_weights[photos[candidates]]
    # A stable sort, so that equal scores keep the map's order on every machine.
    best = candidates[np.argsort(-ranked, kind="stable")[:top_k]]
    return Retrieved(
        images=photos[best],
        scores=scores[best],
        similarities={name: row[best] for name, row in cosines.items()},
    )


def compare(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    photos: NDArray[np.int64],
    photo_weights: NDArray[np.float64] | None = None,
    fusion: LateFusion = EQUAL_GHARM,
) -> Retrieved:
    """Compare a query with photos that the caller chose, in the caller's order.

    Args:
        photos: (k,) rows of ``index``, best first; those that ``photo_weights`` exclude are left
            out.
    """
    if photo_weights is not None:
        photos = photos[photo_weights[photos] > 0]
    cosines = _cosines(query, {name: index[name] for name in fusion.counted(index)}, photos)
    return Retrieved(photos, fusion.scores(cosines), cosines)


def _compared(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    top_k: int,
    allowed: NDArray[np.bool_] | None,
    fusion: LateFusion,
) -> tuple[NDArray[np.int64] | None, dict[str, NDArray[np.float64]]]:
    """The photos to rank, in the order of the map, and their cosines by descriptor.

    The photos are None where all of them are compared.
    """
    files = {name: rows.inverted for name, rows in index.items() if rows.inverted is not None}
    if len(files) < len(index):
        return None, _cosines(query, index, None)
    if allowed is None:
        allowed = np.ones(len(next(iter(index.values()))), np.bool_)
    left = int(np.count_nonzero(allowed))
    if left <= _MAX_ALLOWED_EXACT:
        photos = np.flatnonzero(allowed)
        return photos, _cosines(query, index, photos)
    count, many = max(_MIN_PROPOSED, _PROPOSED_PER_RESULT * top_k), left > _MAX_DOUBTFUL
    photos, limits = _proposed(query, files, allowed, min(left, count), _LISTS)
    cosines = _cosines(query, index, photos)
    if _num_outstanding(cosines, limits, fusion) >= (top_k / 2 if many else top_k):
        return photos, cosines
    if many:
        # Photos that priors leave may lie in lists further away.
        lists = math.ceil(_WIDER_LISTS * _LISTS * len(allowed) / left)
        photos, limits = _proposed(query, files, allowed, min(left, _WIDER_PROPOSED * count), lists)
        if _ABOVE_ALL not in limits.values():
            return photos, _cosines(query, index, photos)
    return _best_by_codes(query, index, files, top_k, allowed, fusion)


def _proposed(
    query: Mapping[str, NDArray[np.float32]],
    files: Mapping[str, InvertedFile],
    allowed: NDArray[np.bool_],
    count: int,
    num_lists: int,
) -> tuple[NDArray[np.int64], dict[str, float]]:
    """The allowed photos that are most like the query by their codes, in the order of the map.

    Also returns, by descriptor, an upper bound of the cosine of all other photos, as far as codes
    can tell: ``_ABOVE_ALL`` if there were fewer than ``count`` to propose.
    """
    photos, limits = [], {}
    for name, file in files.items():
        lists = file.nearest_lists(query[name], num_lists)
        found, rough = file.most_alike(query[name], lists, count, allowed)
        photos.append(found)
        enough = len(found) == count
        limits[name] = float(rough.min()) + file.error if enough else _ABOVE_ALL
    return np.unique(np.concatenate(photos)), limits


def _num_outstanding(
    cosines: Mapping[str, NDArray[np.float64]], limits: Mapping[str, float], fusion: LateFusion
) -> int:
    """Count the proposals that are at least as good as any other photo can be."""
    scores = fusion.scores({name: np.append(row, limits[name]) for name, row in cosines.items()})
    return int(np.count_nonzero(scores[:-1] >= scores[-1]))


def _best_by_codes(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    files: Mapping[str, InvertedFile],
    top_k: int,
    allowed: NDArray[np.bool_],
    fusion: LateFusion,
) -> tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]:
    """The allowed photos with the best fused scores by their codes, in the order of the map.

    Also returns their cosines by descriptor.
    """
    photos, cosines = np.flatnonzero(allowed), {}
    for name, file in files.items():
        found, rough = file.rough_cosines(query[name], np.arange(len(file.sizes)), allowed)
        every = np.full(len(allowed), -1.0)
        every[found] = rough
        cosines[name] = every[photos]
    count = _DOUBTFUL_ROWS + math.ceil(_DOUBTFUL_SHARE * len(photos))
    for name, rows in index.items():
        kept = np.sort(largest(fusion.scores(cosines), max(count, top_k)))
        photos, cosines = photos[kept], {other: row[kept] for other, row in cosines.items()}
        cosines[name] = rows.cosines(query[name], photos)
        count = math.ceil(_KEPT_BY_EACH * count)
    return photos, cosines


def _cosines(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    photos: NDArray[np.int64] | None,
) -> dict[str, NDArray[np.float64]]:
    return {name: rows.cosines(query[name], photos) for name, rows in index.items()}


# Excluded photos among this many most similar ones are matched too: they may show that the priors
# are wrong.
_NUM_PHOTOS = 5


def excluded_photos(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    retrieved: Retrieved,
    photo_weights: NDArray[np.float64] | None,
    fusion: LateFusion,
) -> NDArray[np.int64]:
    """Return photos (k,) that the priors exclude and that look as much like the query as others.

    On look-alike floors the most similar photo is a coin toss, so a photo need not be the very
    best to count.

    Args:
        photo_weights: of the priors, 0 for excluded photos; None when there are no priors.
    """
    if photo_weights is None:
        return np.empty(0, dtype=np.int64)
    # Ranked among all photos: of the excluded ones alone, often none looks like the query, which
    # takes longest to find out. Besides a photo that counts, at most four allowed and four excluded
    # ones are as good.
    everywhere = retrieve(query, index, 2 * _NUM_PHOTOS - 1, fusion=fusion)
    among = np.flatnonzero(photo_weights[everywhere.images] == 0)[:_NUM_PHOTOS]
    if len(among) < _NUM_PHOTOS and _are_better(everywhere, retrieved, fusion).all():
        # More allowed photos than four are as good: they are not in ``retrieved``, because they
        # count little, or because the caller chose others.
        excluded = np.asarray(photo_weights == 0, dtype=np.float64)
        everywhere = retrieve(query, index, _NUM_PHOTOS, excluded, fusion)
        among = np.arange(len(everywhere.images))
    others = Retrieved(
        everywhere.images[among],
        everywhere.scores[among],
        {name: row[among] for name, row in everywhere.similarities.items()},
    )
    return np.asarray(others.images[_are_better(others, retrieved, fusion)])


def _are_better(found: Retrieved, retrieved: Retrieved, fusion: LateFusion) -> NDArray[np.bool_]:
    """Return which of the photos that were found (k,) are better than the fifth retrieved."""
    # Fuse both lists together: scores that are ranks only compare within one ranking.
    both, num = (retrieved.similarities, found.similarities), len(retrieved.images)
    scores = fusion.scores({name: np.concatenate([f[name] for f in both]) for name in both[0]})
    best = np.sort(scores[:num])[::-1][:_NUM_PHOTOS]
    return np.asarray(scores[num:] > best.min(initial=np.inf))


@dataclass(frozen=True, slots=True, eq=False)
class GlobalRows:
    """Unit rows (n, D), one per photo; ``rows[i]`` reads some as float32.

    Attributes:
        values: (n, D) int8 or float32.
        scales: (n,) float32 factors of the rows of ``values``; None for 1.
        inverted: None in maps whose rows are all compared with every query.
    """

    values: NDArray[np.int8] | NDArray[np.float32]
    scales: NDArray[np.float32] | None = None
    inverted: InvertedFile | None = None

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, rows: int | slice | NDArray[np.integer]) -> NDArray[np.float32]:
        values = self.values[rows].astype(np.float32)
        if self.scales is not None:
            values *= np.asarray(self.scales[rows])[..., None]
        return values

    def cosines(
        self, query: NDArray[np.float32], photos: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Return the cosines (m,) of a unit vector (D,) with some rows (m,), or all."""
        found = dot_products(self.values, query, photos)
        if self.scales is not None:
            found *= self.scales if photos is None else self.scales[photos]
        # Unit vectors in float32 can give 1 + 1e-7.
        return np.clip(found.astype(np.float64), -1.0, 1.0)


def in_8_bits(rows: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Round unit rows (n, D) to int8; return them with scales (n,) that restore unit length.

    The zero rows of blank photos stay zero.
    """
    largest = np.abs(rows).max(axis=1, initial=0.0)
    steps = np.where(largest > 0, largest, 1) / np.float32(127)
    values = np.rint(rows / steps[:, None]).astype(np.int8)
    lengths = np.linalg.norm(values.astype(np.float32), axis=1)
    return values, np.where(lengths > 0, 1 / np.maximum(lengths, 1), 0).astype(np.float32)
