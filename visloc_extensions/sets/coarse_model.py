"""Learning the model of a set's coarse index: its vocabulary, projection and rotation."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.features.descriptors.vlad import KMEANS_MAX_WORDS
from visloc.features.descriptors.whitening import WHITENING_MAX_PHOTOS
from visloc.retrieval.inverted import width_of
from visloc_extensions.sets.coarse import (
    NO_PIXELS,
    CoarseModel,
    localvlad,
    without_positions,
    words_of,
)

# Dimensions of a descriptor; the most informative come first.
_MAX_DIMS = 256
# Tiles of a large set that vocabulary and projection are learned from.
_MAX_TEACHERS = 256


def learn(open_tile: Callable[[int], Map], num_tiles: int, *, seed: int = 0) -> CoarseModel:
    """Learn the model of an index on a seeded sample of the tiles' photos.

    Args:
        open_tile: opens a tile of the set by its row; called a few times for each, with one tile
            open at a time.
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

    def words(number: int) -> NDArray[np.float32]:
        tile, photo = photos[number]
        if tile not in opened:
            opened.clear()
            opened[tile] = open_tile(tile)
        return words_of(opened[tile], photo)

    return learn_of_words(words, len(photos), random)


def learn_of_words(
    read_words: Callable[[int], NDArray[np.float32]],
    num_photos: int,
    random: np.random.Generator,
) -> CoarseModel:
    """Learn the model of an index on some photos.

    Args:
        read_words: returns the local descriptors (n, d) of a photo by its number; called twice.
        random: for the sample of the descriptors, and the rotation.
    """
    descriptor = localvlad()
    most = KMEANS_MAX_WORDS // num_photos
    words = [_sample(read_words(number), most, random) for number in range(num_photos)]
    model = descriptor.learn_vocabulary(np.concatenate(words), int(random.integers(2**32)))
    pooled = [
        descriptor.pool(NO_PIXELS, without_positions(read_words(number)), model)
        for number in range(num_photos)
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


def random_rotation(dim: int, random: np.random.Generator) -> NDArray[np.float32]:
    """Return (dim, W) rows of a random rotation, which keep cosines; W is ``width_of(dim)``.

    A bit for each dimension says most where all dimensions say about as much.
    """
    square, _ = np.linalg.qr(random.normal(size=(width_of(dim), width_of(dim))))
    return square[:dim].astype(np.float32)


def _sample(
    words: NDArray[np.float32], most: int, random: np.random.Generator
) -> NDArray[np.float32]:
    if len(words) <= most:
        return words
    return words[np.sort(random.choice(len(words), most, replace=False))]
