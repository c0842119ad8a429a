"""A coarse index over all photos of all tiles, which ranks the tiles for a query.

A photo's stored descriptors are pooled to one vector (``localvlad``, with one vocabulary and one
projection for all tiles), and turned, so that no dimension tells more than another. The photos of
each tile are a few lists of an inverted file. A query is compared with the codes of the lists that
are most like it, and then with all codes of the tiles of the best photos. Nothing here loops over
all tiles or photos in Python (docs/decisions/0034-the-index-is-faiss.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive import CoarseIndex, FingerprintRecord, Map, MapSet
from visloc.errors import refuse
from visloc.features import GlobalDescriptor, make_global_descriptor
from visloc.features.descriptors.vlad import KMEANS_MAX_WORDS
from visloc.features.descriptors.whitening import WHITENING_MAX_PHOTOS
from visloc.localization.fingerprints import check_fingerprint
from visloc.retrieval.inverted import (
    InvertedFile,
    MadeLists,
    bytes_of,
    make_centers,
    make_lists,
    width_of,
)
from visloc.sets.choosing import TileScore
from visloc.types import LocalFeatures

CoarseModel = Mapping[str, NDArray[np.float32]]

# Dimensions of a descriptor; the most informative come first.
_MAX_DIMS = 256
# Lists of a tile.
TILE_LISTS = 4
# Lists that are searched: so many, or this share of those of a larger set.
_MIN_LISTS, _SHARE_OF_LISTS = 400, 0.04
# Photos whose tiles are ranked, and how many tiles at most.
_NUM_PROPOSED, MAX_RANKED = 1000, 50
# A tile scores the mean of its best photos, as one alone may be similar by chance.
_NUM_BEST = 3
# Tiles of a large set that vocabulary and projection are learned from.
_MAX_TEACHERS = 256
_NO_PIXELS = np.empty((0, 0, 3), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class DescribedTile:
    """One tile in the index: (TILE_LISTS, W) float32 centres of its lists, and these."""

    centers: NDArray[np.float32]
    lists: MadeLists


def learn(open_tile: Callable[[int], Map], num_tiles: int, *, seed: int = 0) -> CoarseModel:
    """Learn the model of an index on a seeded sample of the tiles' photos.

    Args:
        open_tile: opens a tile of the set by its row; called a few times for each, with one tile
            open at a time.
        num_tiles: number of tiles.
        seed: for the sample, the vocabulary and the rotation.
    """
    random = np.random.default_rng(seed)
    teachers = np.sort(
        random.choice(num_tiles, min(num_tiles, _MAX_TEACHERS), replace=False)
    ).tolist()
    most = math.ceil(WHITENING_MAX_PHOTOS / len(teachers))
    photos = []
    for tile in teachers:
        last = len(open_tile(tile).images) - 1
        some = np.unique(np.linspace(0, last, most).astype(int)).tolist()
        photos += [(tile, photo) for photo in some]
    # One at a time, as a process may open about a thousand files and a map has several.
    opened: dict[int, Map] = {}

    def words_of(number: int) -> NDArray[np.float32]:
        tile, photo = photos[number]
        if tile not in opened:
            opened.clear()
            opened[tile] = open_tile(tile)
        return _words(opened[tile], photo)

    return learn_of_words(words_of, len(photos), random)


def learn_of_words(
    words_of: Callable[[int], NDArray[np.float32]],
    num_photos: int,
    random: np.random.Generator,
) -> CoarseModel:
    """Learn the model of an index on some photos.

    Args:
        words_of: returns the local descriptors (n, d) of a photo by its number; called twice.
        num_photos: number of photos.
        random: for the sample of the descriptors, and the rotation.
    """
    descriptor = _descriptor()
    most = KMEANS_MAX_WORDS // num_photos
    words = [_sample(words_of(number), most, random) for number in range(num_photos)]
    model = descriptor.learn_vocabulary(np.concatenate(words), int(random.integers(2**32)))
    pooled = [
        descriptor.pool(_NO_PIXELS, _local(words_of(number)), model) for number in range(num_photos)
    ]
    projection = descriptor.learn_projection(np.array(pooled))
    dim = min(projection["axes"].shape[1], _MAX_DIMS)
    axes = np.ascontiguousarray(projection["axes"][:, :dim])
    return {
        **model,
        "mean": projection["mean"],
        "axes": axes,
        "rotation": random_rotation(dim, random),
    }


def describe(opened: Map, model: CoarseModel, *, seed: int = 0) -> DescribedTile:
    """Describe the photos of a tile from their stored descriptors.

    ``model`` is that of the set, or of another set with the same local features.
    """
    return described(descriptors_of(opened, model), model, seed=seed)


def photo_descriptor(opened: Map, photo: int, model: CoarseModel) -> NDArray[np.float32]:
    """Return the descriptor (D,) of a photo of a map, from its stored local descriptors."""
    return descriptor_of(_words(opened, photo), model)


def descriptors_of(opened: Map, model: CoarseModel) -> NDArray[np.float32]:
    """Return the descriptors (n, D) of a map's photos, from their stored local descriptors."""
    photos = range(len(opened.images))
    return np.array([photo_descriptor(opened, photo, model) for photo in photos])


def descriptor_of(words: NDArray[np.float32], model: CoarseModel) -> NDArray[np.float32]:
    """Return the descriptor (D,) of a photo from its local descriptors (n, d)."""
    return _descriptor().describe(_NO_PIXELS, _local(words), model)


def described(rows: NDArray[np.float32], model: CoarseModel, *, seed: int = 0) -> DescribedTile:
    """Describe a tile from the descriptors (n, D) of its photos."""
    turned = rows @ model["rotation"]
    centers = make_centers(turned, TILE_LISTS, seed)
    # A tile with fewer photos repeats centres, whose lists stay empty.
    centers = centers[np.arange(TILE_LISTS) % len(centers)]
    return DescribedTile(centers, make_lists(turned, centers))


def coarse_index(described: Iterator[DescribedTile], model: CoarseModel, path: Path) -> CoarseIndex:
    """Join described tiles to an index, whose lists are written into a new file."""
    centers, sizes, counts = [], [], [0]

    def lists() -> Iterator[MadeLists]:
        for tile in described:
            centers.append(tile.centers)
            sizes.append(tile.lists.sizes)
            counts.append(len(tile.lists.ids))
            yield tile.lists

    with path.open("xb") as file:
        file.writelines(bytes_of(lists()))
    return CoarseIndex(
        fingerprint=FingerprintRecord.of(_descriptor().fingerprint),
        model=model,
        offsets=np.cumsum(counts, dtype=np.int64),
        inverted=InvertedFile(np.concatenate(centers), np.concatenate(sizes), path),
    )


def rank_tiles(
    map_set: MapSet, local: LocalFeatures, allowed: NDArray[np.bool_] | None = None
) -> tuple[TileScore, ...]:
    """Rank tiles by the similarity of their photos to a query, best first, at most 50.

    Args:
        map_set: the set.
        local: the query's features.
        allowed: (T,) the tiles that may be ranked; None for all.

    Raises:
        Conflict: ``map.features`` for an index made with another revision of the descriptor.
        MapCorrupt: ``map.array`` for a vocabulary of other local features.
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
    query = _descriptor().describe(_NO_PIXELS, local, map_set.coarse.model)
    return ranked(map_set.coarse, query, allowed)


def check_descriptor(map_set: MapSet) -> None:
    """Refuse an index made with another revision of the descriptor.

    Raises:
        Conflict: ``map.features``.
    """
    check_fingerprint(map_set.coarse.fingerprint, _descriptor().fingerprint, map_set.ref)


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
    """The tiles whose photos' codes are most like the query's, in the order of the set."""
    inverted = coarse.inverted
    count = max(_MIN_LISTS, math.ceil(_SHARE_OF_LISTS * len(inverted.sizes)))
    lists = inverted.nearest_lists(query, count, _lists_of(coarse, tiles))
    photos, _ = inverted.nearest(query, _NUM_PROPOSED, lists)
    found = np.searchsorted(coarse.offsets, photos, "right") - 1
    found = found[np.isin(found, tiles)]  # a damaged list may name photos of another tile
    _, first = np.unique(found, return_index=True)
    return np.sort(found[np.sort(first)[:MAX_RANKED]])


def score_without(
    coarse: CoarseIndex, query: NDArray[np.float32], tile: int, left_out: NDArray[np.int64]
) -> float:
    """Score a tile as ``ranked`` does, as if it did not have some of its photos.

    Args:
        coarse: the index.
        query: descriptor (D,).
        tile: row of the tile.
        left_out: (k,) rows of the tile's photos, not all of them.
    """
    return _score(coarse, tile, query @ coarse.model["rotation"], left_out)


def _score(
    coarse: CoarseIndex,
    tile: int,
    query: NDArray[np.float32],
    left_out: NDArray[np.int64] | None = None,
) -> float:
    """The mean cosine of a query, which was turned, with the best photos of a tile."""
    inverted, allowed = coarse.inverted, None
    if left_out is not None:
        allowed = np.ones(inverted.num_rows, np.bool_)
        allowed[coarse.offsets[tile] + left_out] = False
    _, cosines = inverted.nearest(query, _NUM_BEST, _lists_of(coarse, np.array([tile])), allowed)
    return float(np.clip(cosines, -1, 1).mean()) if len(cosines) else -1.0


def _lists_of(coarse: CoarseIndex, tiles: NDArray[np.int64]) -> NDArray[np.int64]:
    count = coarse.tile_lists
    return np.asarray((count * tiles[:, None] + np.arange(count)).ravel())


def _descriptor() -> GlobalDescriptor:
    return make_global_descriptor("localvlad")


def _words(opened: Map, photo: int) -> NDArray[np.float32]:
    scale = np.float32(opened.manifest.local_features.descriptor_scale)
    return opened.observations(photo)[1].astype(np.float32) * scale


def _local(words: NDArray[np.float32]) -> LocalFeatures:
    """Descriptors as local features without positions."""
    nowhere = np.zeros(len(words), np.float32)
    return LocalFeatures(np.zeros((len(words), 2), np.float32), words, nowhere, nowhere)


def _sample(
    words: NDArray[np.float32], most: int, random: np.random.Generator
) -> NDArray[np.float32]:
    if len(words) <= most:
        return words
    return words[np.sort(random.choice(len(words), most, replace=False))]


def random_rotation(dim: int, random: np.random.Generator) -> NDArray[np.float32]:
    """Return (dim, W) rows of a random rotation, which keep cosines; W is ``width_of(dim)``.

    A bit for each dimension says most where all dimensions say about as much.
    """
    square, _ = np.linalg.qr(random.normal(size=(width_of(dim), width_of(dim))))
    return square[:dim].astype(np.float32)
