"""A coarse index over all photos of all tiles, which ranks the tiles for a query.

A photo's stored descriptors are pooled to one vector (``localvlad``, with one vocabulary and one
projection for all tiles). The vector is rotated, so that all dimensions carry about as much
information. The photos of each tile are a few lists of an inverted file. A query is compared with
the codes of the lists most similar to it, and then with all codes of the tiles of the best photos.
Nothing here loops over all tiles or photos in Python (docs/decisions/0034-the-index-is-faiss.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive import FingerprintRecord, Map
from visloc.errors import refuse
from visloc.features import GlobalDescriptor, make_global_descriptor
from visloc.localization.query.fingerprints import check_fingerprint
from visloc.retrieval.inverted import (
    InvertedFile,
    MadeLists,
    bytes_of,
    largest,
    make_centers,
    make_lists,
)
from visloc.types import LocalFeatures
from visloc_extensions.sets.choosing import TileScore
from visloc_extensions.sets.files import CoarseIndex, MapSet

CoarseModel = Mapping[str, NDArray[np.float32]]

# Number of lists of a tile.
TILE_LISTS = 4
# Number of lists that are searched: the larger of this number and this share of all lists.
_MIN_LISTS, _SHARE_OF_LISTS = 400, 0.04
# Maximum number of photos whose tiles are ranked, and of tiles that are ranked.
_NUM_PROPOSED, MAX_RANKED = 1000, 50
# The score of a tile is the mean of its best photos: a single one may be similar by chance.
_NUM_BEST = 3
NO_PIXELS = np.empty((0, 0, 3), np.uint8)


def descriptors_of(opened: Map, model: CoarseModel) -> NDArray[np.float32]:
    """Return the descriptors (n, D) of a map's photos, from their stored local descriptors."""
    photos = range(len(opened.images))
    return np.array([descriptor_of(words_of(opened, photo), model) for photo in photos])


def descriptor_of(words: NDArray[np.float32], model: CoarseModel) -> NDArray[np.float32]:
    """Return the descriptor (D,) of a photo from its local descriptors (n, d)."""
    return localvlad().describe(NO_PIXELS, without_positions(words), model)


def described(rows: NDArray[np.float32], model: CoarseModel) -> MadeLists:
    """Make the TILE_LISTS lists of a tile from the descriptors (n, D) of its photos.

    ``model`` is that of the set, or of another set with the same local features.
    """
    turned = rows @ model["rotation"]
    centers = make_centers(turned, TILE_LISTS)
    # With fewer photos than lists, centres are repeated, and the lists of the copies stay empty.
    centers = centers[np.arange(TILE_LISTS) % len(centers)]
    return make_lists(turned, centers)


def coarse_index(described: Iterator[MadeLists], model: CoarseModel, path: Path) -> CoarseIndex:
    """Make an index of described tiles, and write its lists into a new file."""
    centers, sizes, counts = [], [], [0]

    def lists() -> Iterator[MadeLists]:
        for tile in described:
            centers.append(tile.centers)
            sizes.append(tile.sizes)
            counts.append(len(tile.ids))
            yield tile

    with path.open("xb") as file:
        file.writelines(bytes_of(lists()))
    return CoarseIndex(
        fingerprint=FingerprintRecord.of(localvlad().fingerprint),
        model=model,
        offsets=np.cumsum(counts, dtype=np.int64),
        inverted=InvertedFile(np.concatenate(centers), np.concatenate(sizes), path),
    )


def rank_tiles(
    map_set: MapSet, local: LocalFeatures, allowed: NDArray[np.bool_] | None = None
) -> tuple[TileScore, ...]:
    """Rank tiles by the similarity of their photos to a query, best first, at most 50.

    Args:
        local: the query's features.
        allowed: (T,) the tiles that may be ranked; None for all.
    """
    check_descriptor(map_set)
    dim, expected = local.descriptors.shape[1], map_set.coarse.model["vocabulary"].shape[1]
    if dim != expected:
        raise refuse(
            "map.array",
            f"the coarse model of {map_set.ref} does not fit its local features; build "
            "the set again",
            field="vocabulary",
            expected=f"{dim} columns",
            got=f"{expected} columns",
        )
    query = localvlad().describe(NO_PIXELS, local, map_set.coarse.model)
    return ranked(map_set.coarse, query, allowed)


def check_descriptor(map_set: MapSet) -> None:
    """Refuse an index made with another revision of the descriptor."""
    check_fingerprint(map_set.coarse.fingerprint, localvlad().fingerprint, map_set.ref)


def ranked(
    coarse: CoarseIndex, query: NDArray[np.float32], allowed: NDArray[np.bool_] | None = None
) -> tuple[TileScore, ...]:
    """Rank tiles as ``rank_tiles`` does, for a query's descriptor (D,)."""
    turned = query @ coarse.model["rotation"]
    tiles = np.arange(len(coarse.offsets) - 1) if allowed is None else np.flatnonzero(allowed)
    if len(tiles) > MAX_RANKED:
        tiles = _proposed(coarse, turned, tiles)
    scores = np.array([_score(coarse, tile, turned) for tile in tiles.tolist()])
    order = np.argsort(-scores, kind="stable")
    return tuple(TileScore(int(tiles[i]), float(scores[i])) for i in order)


def _proposed(
    coarse: CoarseIndex, query: NDArray[np.float32], tiles: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the tiles of the photos most similar to a rotated query, in the order of the set."""
    inverted = coarse.inverted
    count = max(_MIN_LISTS, math.ceil(_SHARE_OF_LISTS * len(inverted.sizes)))
    among = None if len(tiles) == len(coarse.offsets) - 1 else _lists_of(coarse, tiles)
    lists = inverted.nearest_lists(query, count, among)
    photos, cosines = inverted.most_alike(query, lists, _NUM_PROPOSED)
    photos = photos[np.argsort(-cosines)]
    found = np.searchsorted(coarse.offsets, photos, "right") - 1
    found = found[np.isin(found, tiles)]  # a damaged list may name photos of another tile
    _, first = np.unique(found, return_index=True)
    return np.sort(found[np.sort(first)[:MAX_RANKED]])


def score_without(
    coarse: CoarseIndex, query: NDArray[np.float32], tile: int, left_out: NDArray[np.int64]
) -> float:
    """Score a tile as ``ranked`` does, but without some of its photos.

    Args:
        query: descriptor (D,).
        left_out: (k,) rows of the tile's photos, not all of them.
    """
    return _score(coarse, tile, query @ coarse.model["rotation"], left_out)


def _score(
    coarse: CoarseIndex,
    tile: int,
    query: NDArray[np.float32],
    left_out: NDArray[np.int64] | None = None,
) -> float:
    """Return the mean cosine of a rotated query with the best photos of a tile."""
    inverted, allowed = coarse.inverted, None
    if left_out is not None:
        allowed = np.ones(inverted.num_rows, np.bool_)
        allowed[coarse.offsets[tile] + left_out] = False
    _, cosines = inverted.rough_cosines(query, _lists_of(coarse, np.array([tile])), allowed)
    best = cosines[largest(cosines, _NUM_BEST)]
    return float(best.mean()) if len(best) else -1.0


def _lists_of(coarse: CoarseIndex, tiles: NDArray[np.int64]) -> NDArray[np.int64]:
    count = coarse.tile_lists
    return np.asarray((count * tiles[:, None] + np.arange(count)).ravel())


def localvlad() -> GlobalDescriptor:
    """The descriptor whose vectors the index holds."""
    return make_global_descriptor("localvlad")


def words_of(opened: Map, photo: int) -> NDArray[np.float32]:
    """Return the stored local descriptors (n, d) of a photo of a map."""
    scale = np.float32(opened.manifest.local_features.descriptor_scale)
    return opened.observations(photo)[1].astype(np.float32) * scale


def without_positions(words: NDArray[np.float32]) -> LocalFeatures:
    """Wrap descriptors (n, d) as local features, which the pooling expects."""
    nowhere = np.zeros(len(words), np.float32)
    return LocalFeatures(np.zeros((len(words), 2), np.float32), words, nowhere, nowhere)
