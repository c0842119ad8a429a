"""A city of tiles without photos: descriptors as alike as real photos' are (``benchmarks.tiles``).

Eight passes of a camera lead through each tile, a photo every 20 cm. The descriptor of a photo is
the unit vector along a sum of independent parts:

- what the neighbourhood has in common, blocks of 4 x 4 tiles: photos of a tile that see nothing of
  each other are no more alike than photos of neighbouring tiles;
- what is seen from there, which changes along the pass (a first-order autoregression) and is new on
  every pass: within 3 m in some tiles, as in a room where a camera turns, 20 m in others, as in a
  street;
- what changes from photo to photo even at one place: little in some tiles, much in others;
- in every fifth pass, instead of a random share of the first two, what one of 64 kinds of
  look-alikes shows, frequent ones and rare ones, anywhere in the city.

A query is one more photo, a metre beside a pass. The directions of the parts have the variances of
the real photos in ``tile_similarities.json``, their lengths are chosen here so that the quantiles
there come out (``benchmarks.tiles`` prints both). That file was measured with
``benchmarks/tile_similarities.py`` of commit f776606b (docs/scale.md).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.features.descriptors.whitening import unit_rows
from visloc.retrieval.inverted import MadeLists
from visloc_extensions.sets.coarse import CoarseModel, described
from visloc_extensions.sets.coarse_model import random_rotation

SIMILARITIES = Path(__file__).parent / "tile_similarities.json"
# Of the quantiles in that file, and what is compared (docs/scale.md).
LEVELS = (0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 0.9999)
NAMES = ("nearest", "co-visible", "apart", "elsewhere", "own centroids", "other centroids")
PASSES = 8
NEIGHBOURHOOD = 4
# Share of a photo's squared length that the next photo of the same place shows too: from the first
# in the easiest tiles to the second in the hardest, few of which are so hard.
_MOST_STABLE, _LEAST_STABLE, _STABLE_POWER = 0.89, 0.56, 3
# Of that, what belongs to the neighbourhood.
_LEAST_COMMON, _MOST_COMMON = 0.33, 0.63
# Metres along which what is seen changes, photos of a pass apart, and a query beside it.
_SHORTEST_M, _LONGEST_M = 3.0, 20.0
_STEP_M, _BESIDE_M = 0.2, 1.0
# Share of the passes that show a look-alike; how many kinds there are, the n-th 1/n as frequent.
_LOOK_ALIKE, _KINDS = 0.2, 64
# Of the squared lengths of all photos, on average: what changes along a pass, and photo by photo.
_CHANGING, _NOISE = 0.4, 0.2

Rows = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Tile:
    """The photos of one tile.

    Attributes:
        rows: (n, D) unit rows, pass by pass.
        queries: (q, D) unit rows.
        passes: (q,) on which pass each query is.
    """

    rows: Rows
    queries: Rows
    passes: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class City:
    """Tiles on a square grid, each made anew from the seed whenever it is asked for.

    Attributes:
        num_tiles: row by row.
        num_photos: of each tile, a multiple of ``PASSES``.
        seed: of everything.
    """

    num_tiles: int
    num_photos: int
    seed: int = 0

    @property
    def side(self) -> int:
        """Tiles of one row of the grid."""
        return int(np.ceil(np.sqrt(self.num_tiles)))

    @cached_property
    def stds(self) -> dict[str, Rows]:
        """(D,) standard deviations by axis of ``within``, ``nearest`` and ``common``."""
        real = json.loads(SIMILARITIES.read_text())["spectra"]
        shares = {name: np.array(values) for name, values in real.items()}
        rest = shares["places"] - _CHANGING * shares["within"] - _NOISE * shares["nearest"]
        shares["common"] = np.maximum(rest, 1e-5)
        return {
            name: np.sqrt(values / values.sum()).astype(np.float32)
            for name, values in shares.items()
        }

    @cached_property
    def kinds(self) -> Rows:
        """(K, D) what look-alikes look like."""
        return unit_rows(_normal(self._random(0, 0), _KINDS, self.stds["places"]))

    def neighbourhood(self, tile: int) -> int:
        """Return the number of the block of tiles that a tile belongs to."""
        line, column = divmod(tile, self.side)
        return line // NEIGHBOURHOOD * self.side + column // NEIGHBOURHOOD

    def tile(self, tile: int, num_queries: int = 0) -> Tile:
        """Make the photos of a tile, and some queries in it."""
        random, stds = self._random(1, tile), self.stds
        look = _Look.drawn(random, self.kinds)
        common = _normal(self._random(2, self.neighbourhood(tile)), 1, stds["common"])
        seen = _along_passes(
            random, self.num_photos, stds["within"], np.exp(-_STEP_M / look.metres)
        )
        passes = np.repeat(np.arange(PASSES), self.num_photos // PASSES)
        rows = look.photos(common, seen, passes, _normal(random, len(seen), stds["nearest"]))
        random = self._random(3, tile)
        # The same places for each seed: cities of two seeds are two descriptors of one city.
        beside = np.random.default_rng(tile).integers(self.num_photos, size=num_queries)
        kept = np.exp(-_BESIDE_M / look.metres)
        new = _normal(random, num_queries, stds["within"])
        seen = kept * seen[beside] + np.sqrt(1 - kept**2) * new
        noise = _normal(random, num_queries, stds["nearest"])
        return Tile(rows, look.photos(common, seen, passes[beside], noise), passes[beside])

    def _random(self, *what: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, *what))


@dataclass(frozen=True, eq=False)
class _Look:
    """What distinguishes one tile from others.

    Attributes:
        stable: share of a photo's squared length that does not change from photo to photo.
        common: of that, the neighbourhood's.
        metres: along which what is seen changes.
        alike: (PASSES, 1) share of a look-alike.
        kinds: (PASSES, D) what it looks like.
    """

    stable: float
    common: float
    metres: float
    alike: Rows
    kinds: Rows

    @staticmethod
    def drawn(random: np.random.Generator, kinds: Rows) -> _Look:
        """Draw one."""
        u, v, w = random.random(3)
        frequency = 1 / np.arange(1, len(kinds) + 1)
        which = random.choice(len(kinds), PASSES, p=frequency / frequency.sum())
        has_one = random.random(PASSES) < _LOOK_ALIKE
        alike = (has_one * random.random(PASSES)).astype(np.float32)[:, None]
        stable = _MOST_STABLE - (_MOST_STABLE - _LEAST_STABLE) * u**_STABLE_POWER
        common = stable * (_LEAST_COMMON + (_MOST_COMMON - _LEAST_COMMON) * v)
        metres = _SHORTEST_M * (_LONGEST_M / _SHORTEST_M) ** w
        return _Look(stable, common, metres, alike, kinds[which])

    def photos(self, common: Rows, seen: Rows, passes: NDArray[np.int64], noise: Rows) -> Rows:
        """Put the parts of photos (n, D) together."""
        own = np.sqrt(self.common) * unit_rows(common) + np.sqrt(self.stable - self.common) * seen
        alike, kinds = self.alike[passes], self.kinds[passes]
        stable = np.sqrt(1 - alike) * own + np.sqrt(self.stable * alike) * kinds
        return unit_rows((stable + np.sqrt(1 - self.stable) * noise).astype(np.float32))


def similarities(
    city: City, tiles: Sequence[int], model: CoarseModel, queries: int = 4
) -> dict[str, list[float]]:
    """Return quantiles, at ``LEVELS``, of the same similarities as in ``SIMILARITIES``.

    Photos of the same pass stand for co-visible ones, those of the other passes for photos apart;
    elsewhere are tiles of other neighbourhoods.
    """
    made = [city.tile(tile, queries) for tile in tiles]
    neighbourhoods = np.array([city.neighbourhood(tile) for tile in tiles])
    centroids = [centroids_of(described(tile.rows, model), model) for tile in made]
    found: dict[str, list[Rows]] = {name: [] for name in NAMES}
    for number, tile in enumerate(made):
        own = tile.queries @ tile.rows.T
        found["nearest"].append(own.max(axis=1))
        by_pass = own.reshape(len(own), PASSES, -1)
        same = np.arange(PASSES) == tile.passes[:, None]
        found["co-visible"].append(by_pass[same].ravel())
        found["apart"].append(by_pass[~same].ravel())
        found["own centroids"].append((tile.queries @ centroids[number].T).max(axis=1))
        for other in np.flatnonzero(neighbourhoods != neighbourhoods[number]).tolist():
            some = made[other].rows[:: max(1, len(tile.rows) // 20)]
            found["elsewhere"].append((tile.queries @ some.T).ravel())
            closest = (tile.queries @ centroids[other].T).max(axis=1)
            found["other centroids"].append(closest)
    return {
        name: np.quantile(np.concatenate(some), LEVELS, method="inverted_cdf").round(4).tolist()
        for name, some in found.items()
    }


def centroids_of(tile: MadeLists, model: CoarseModel) -> Rows:
    """Return the unit centres of a tile's lists as descriptors."""
    return unit_rows(tile.centers) @ model["rotation"].T


def generated_model(dim: int, words: int = 128, word_dim: int = 128) -> CoarseModel:
    """Return a model of the size of a real one, which knows nothing.

    Pooling and projecting a query by it takes as long as by a real one.
    """
    random = np.random.default_rng(0)
    vocabulary = random.standard_normal((words, word_dim), dtype=np.float32)
    axes = random.standard_normal((words * word_dim, dim), dtype=np.float32)
    return {
        "vocabulary": unit_rows(vocabulary),
        "mean": np.zeros(words * word_dim, np.float32),
        "axes": axes / np.float32(word_dim),
        "rotation": random_rotation(dim, random),
    }


def _along_passes(random: np.random.Generator, count: int, stds: Rows, kept: float) -> Rows:
    """Return (count, D) what is seen from each photo, of which the next one keeps a share."""
    seen = _normal(random, count, stds).reshape(PASSES, -1, len(stds))
    for photo in range(1, seen.shape[1]):
        seen[:, photo] *= np.sqrt(1 - kept**2)
        seen[:, photo] += kept * seen[:, photo - 1]
    return seen.reshape(count, -1)


def _normal(random: np.random.Generator, count: int, stds: Rows) -> Rows:
    return random.standard_normal((count, len(stds)), dtype=np.float32) * stds
