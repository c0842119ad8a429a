"""A coarse index over all photos of all tiles, which ranks the tiles for a query.

A photo's stored descriptors are pooled to one vector (``localvlad``, with one vocabulary and one
projection for all tiles). The signs of its products with some planes are its code of a few bytes.
A query is compared with a few rows of every tile, then with the codes of the photos of the best
tiles, and finally, with its descriptor instead of its code, with the best of these. Nothing here
loops over all tiles or photos in Python (docs/decisions/0022-map-sets.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.archive import CoarseIndex, FingerprintRecord, Map, MapSet
from visloc.errors import refuse
from visloc.features import GlobalDescriptor, make_global_descriptor
from visloc.features.descriptors.vlad import KMEANS_MAX_WORDS, learn_words
from visloc.features.descriptors.whitening import WHITENING_MAX_PHOTOS, unit_rows
from visloc.localization.fingerprints import check_fingerprint
from visloc.retrieval.rows import GlobalRows, in_8_bits
from visloc.sets.choosing import TileScore
from visloc.types import LocalFeatures

CoarseModel = Mapping[str, NDArray[np.float32]]

# With 256, more wrong tiles came before the right one by chance (docs/scale.md).
BITS = 512
# Dimensions of a descriptor; the most informative come first.
_MAX_DIMS = 256
# Cluster centres of the photos' descriptors, per tile.
CENTROIDS = 4
# Tiles whose codes are compared: so many, or this share of a larger set.
_MIN_LOOKED_AT, _SHARE_LOOKED_AT = 400, 0.04
# Tiles that are compared with the descriptor, and ranked.
MAX_RANKED = 50
# A tile scores the mean of its best photos, as one alone may be similar by chance.
_NUM_BEST = 3
# Tiles of a large set that vocabulary and projection are learned from.
_MAX_TEACHERS = 256
_BLOCK_ROWS, _BLOCK_PHOTOS = 2**18, 2**14
_LEAST_SIDE = 1e-12  # for a query without features
_NO_PIXELS = np.empty((0, 0, 3), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class DescribedTile:
    """One tile in the index: (n, bits / 64) uint64 codes, (CENTROIDS, D) unit rows."""

    codes: NDArray[np.uint64]
    centroids: NDArray[np.float32]


def learn(
    open_tile: Callable[[int], Map], num_tiles: int, *, bits: int = BITS, seed: int = 0
) -> CoarseModel:
    """Learn the model of an index on a seeded sample of the tiles' photos.

    Args:
        open_tile: opens a tile of the set by its row; called a few times for each, with one tile
            open at a time.
        num_tiles: number of tiles.
        bits: length of a photo's code, a multiple of 64.
        seed: for the sample, the vocabulary and the planes.
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

    return learn_of_words(words_of, len(photos), bits, random)


def learn_of_words(
    words_of: Callable[[int], NDArray[np.float32]],
    num_photos: int,
    bits: int,
    random: np.random.Generator,
) -> CoarseModel:
    """Learn the model of an index on some photos.

    Args:
        words_of: returns the local descriptors (n, d) of a photo by its number; called twice.
        num_photos: number of photos.
        bits: length of a photo's code, a multiple of 64.
        random: for the sample of the descriptors, and the planes.
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
        "planes": random_planes(dim, bits, random),
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
    centers = unit_rows(learn_words(rows, CENTROIDS, seed))
    # A tile with fewer photos repeats rows.
    centroids = centers[np.arange(CENTROIDS) % len(centers)]
    return DescribedTile(codes_of(rows, model["planes"]), centroids)


def coarse_index(described: Iterator[DescribedTile], model: CoarseModel) -> CoarseIndex:
    """Join described tiles to an index."""
    codes, counts, centroids = [], [0], []
    for tile in described:
        codes.append(tile.codes)
        counts.append(len(tile.codes))
        centroids.append(tile.centroids)
    return CoarseIndex(
        fingerprint=FingerprintRecord.of(_descriptor().fingerprint),
        model=model,
        codes=np.concatenate(codes),
        offsets=np.cumsum(counts, dtype=np.int64),
        centroids=GlobalRows(*in_8_bits(np.concatenate(centroids))),
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
    tiles = _similar(coarse, query, _proposed(coarse, query, allowed))
    sides = _sides(coarse, query)
    scores = np.array([_score(coarse, tile, sides) for tile in tiles.tolist()])
    order = np.argsort(-scores, kind="stable")
    return tuple(TileScore(int(tiles[i]), float(scores[i])) for i in order)


def _similar(
    coarse: CoarseIndex, query: NDArray[np.float32], tiles: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The tiles whose codes differ least from the query's code, in the order of the set."""
    if len(tiles) <= MAX_RANKED:
        return tiles
    counts = coarse.offsets[tiles + 1] - coarse.offsets[tiles]
    ends = np.cumsum(counts)
    place = np.repeat(np.arange(len(tiles)), counts)
    rows = np.arange(len(place)) + np.repeat(coarse.offsets[tiles] - (ends - counts), counts)
    code = codes_of(query[None], coarse.model["planes"])[0]
    length = coarse.bits + 1
    # Photos by tile and by number of different bits.
    histogram = np.zeros((len(tiles), length), np.int64)
    for start in range(0, len(rows), _BLOCK_ROWS):
        some = slice(start, start + _BLOCK_ROWS)
        counted = np.bitwise_count(coarse.codes[rows[some]] ^ code)
        cells = place[some] * length
        # Column by column, as NumPy sums short rows slowly.
        for column in counted.T:
            cells += column
        histogram += np.bincount(cells, minlength=histogram.size).reshape(histogram.shape)
    best = np.diff(np.minimum(np.cumsum(histogram, axis=1), _NUM_BEST), axis=1, prepend=0)
    # The probability that a random plane separates two vectors is their angle over pi.
    cosines = np.cos(np.pi * np.arange(length) / coarse.bits)
    scores = best @ cosines / np.minimum(counts, _NUM_BEST)
    return np.sort(tiles[np.argpartition(-scores, MAX_RANKED)[:MAX_RANKED]])


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
    return _score(coarse, tile, _sides(coarse, query), left_out)


def _sides(coarse: CoarseIndex, query: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the signed distances (bits,) from the planes, in units of their root mean square."""
    sides = query @ coarse.model["planes"]
    return np.asarray(sides / max(float(np.sqrt(np.mean(sides**2))), _LEAST_SIDE))


def _score(
    coarse: CoarseIndex,
    tile: int,
    sides: NDArray[np.float32],
    left_out: NDArray[np.int64] | None = None,
) -> float:
    """The mean cosine of a query with the best photos of a tile.

    Args:
        coarse: the index.
        tile: row of the tile.
        sides: of the query's descriptor.
        left_out: (k,) rows of the tile's photos that do not count; None for none.
    """
    start, stop = int(coarse.offsets[tile]), int(coarse.offsets[tile + 1])
    best = np.empty(0, np.float32)
    for block in range(start, stop, _BLOCK_PHOTOS):
        codes = np.ascontiguousarray(coarse.codes[block : min(block + _BLOCK_PHOTOS, stop)], "<u8")
        bits = np.unpackbits(codes.view(np.uint8), axis=1, bitorder="little")
        # A bit counts by the query's distance from the plane: for unit vectors, the mean of sign
        # times distance is proportional to their cosine.
        signed = 2.0 * (bits.astype(np.float32) @ sides) - sides.sum()
        cosines = math.sqrt(math.pi / 2) / coarse.bits * signed
        if left_out is not None:
            cosines = cosines[~np.isin(np.arange(block, block + len(codes)), start + left_out)]
        best = np.sort(np.concatenate([best, cosines]))[-_NUM_BEST:]
    return float(best.mean())


def codes_of(rows: NDArray[np.float32], planes: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Return the codes (n, bits / 64) of descriptors (n, D)."""
    packed = np.packbits(rows @ planes > 0, axis=1, bitorder="little")
    return packed.view("<u8").astype(np.uint64)


def _proposed(
    coarse: CoarseIndex, query: NDArray[np.float32], allowed: NDArray[np.bool_] | None
) -> NDArray[np.int64]:
    """The tiles whose codes are compared, in the order of the set."""
    num_tiles = len(coarse.offsets) - 1
    tiles = np.arange(num_tiles) if allowed is None else np.flatnonzero(allowed)
    most = max(_MIN_LOOKED_AT, math.ceil(_SHARE_LOOKED_AT * num_tiles))
    if len(tiles) <= most:
        return tiles
    closest = coarse.centroids.cosines(query).reshape(num_tiles, -1).max(axis=1)[tiles]
    return np.sort(tiles[np.argpartition(-closest, most)[:most]])


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


def random_planes(dim: int, bits: int, random: np.random.Generator) -> NDArray[np.float32]:
    """Return normals (dim, bits) of planes, orthogonal in groups of ``dim``."""
    blocks = []
    for start in range(0, bits, dim):
        square, _ = np.linalg.qr(random.normal(size=(dim, dim)))
        blocks.append(square[:, : bits - start])
    return np.concatenate(blocks, axis=1).astype(np.float32)
