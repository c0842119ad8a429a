"""Tell pairs of photos that show one place from pairs that show two places that look alike.

Photos of two hallways of one design have hundreds of matches that fit one geometry: the doors, the
lamps, the ceiling. The missing matches give them away (Zach, Irschara and Bischof, "What can
missing correspondences tell us about 3D structure and motion?", 2008). A keypoint that other
photos of its place confirm should be found again in every photo that shows the place from nearby.
In another hallway the pictures, the numbers and the furniture are not found.

The share of confirmed keypoints that are found is also low between photos of one place that were
taken far apart. So there are two exceptions:

- Photos next to each other in time probably show one place, and need a smaller share.
- Any other pair is believed if third photos agree with it: believed pairs lead from its keypoints,
  over a third photo, to those that it matches them with. A third photo never links places that no
  believed pair links. Nor does it pass repetitions within a place: over a third photo, the first
  door in a row does not lead to the second.

Some pairs of two places lack nothing, because their photos show only what both places have. Photos
taken just before and after show more. So unless its photos were taken one shortly after the other,
a pair is not believed if most matches between these neighbours are of pairs that fail.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import compress, product

import numpy as np
from numpy.typing import NDArray

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.model import SfmPhoto
from mapping.progress import ItemProgress, not_told

# A keypoint is confirmed by a match with one of so many photos: those with most matches.
_CONFIRMING = 4
# Least share of confirmed keypoints that a pair must match: of photos next to each other in time,
# at most so many steps, and of all others. Measured with benchmarks/joining.py of commit f776606b.
_NEAR_STEPS = 3
_LEAST_NEAR, _LEAST_FAR = 0.1, 0.3
# Least share, counted in matches, of the pairs that pass among those of the neighbours of a pair's
# photos in time. In eight painted rooms it was 0 for pairs of two rooms, and 0.76 to 0.96 for pairs
# of two walks through one (tests/mapping/methods/test_painted_places.py makes such walks).
_LEAST_AROUND = 0.5
# Fewest matches of a pair that third photos must agree with.
_MIN_AGREEING = 15
# Fewer confirmed keypoints do not tell.
_MIN_EXPECTED = 20
_FIT_ROUNDS = 5
_FIT_SCALE_PX = 2.0
# Matches on a line do not fix an affine map.
_DAMPING = 1e-6
# Matches that are enough for a fit.
_MAX_FITTED = 200


def without_look_alikes(
    photos: Sequence[SfmPhoto], matches: Sequence[Matches], progress: ItemProgress = not_told
) -> list[Matches]:
    """Return the pairs that no missing matches contradict.

    Args:
        photos: in any order; those of one sensor are put in order of time.
    """
    confirmed = _Confirmed(photos, matches)
    order = ranks_in_time(photos)
    near = [_are_near(photos, order, pair) for pair in matches]
    passing = []
    for done, (pair, is_near) in enumerate(zip(matches, near, strict=True)):
        progress(done, len(matches))
        least = _LEAST_NEAR if is_near else _LEAST_FAR
        passing.append(_share_found(photos, confirmed, pair) >= least)
    around = _Around(photos, order, matches, passing, near)
    believed = [
        passes and (is_near or around.share_passing(pair) >= _LEAST_AROUND)
        for pair, passes, is_near in zip(matches, passing, near, strict=True)
    ]
    links = _Links(photos)
    for pair in compress(matches, believed):
        links.add(pair)
    kept = [
        pair
        for pair, known in zip(matches, believed, strict=True)
        if known or links.agree_with(pair)
    ]
    progress(len(matches), len(matches))
    return kept


class _Links:
    """Believed pairs, to follow keypoints from photo to photo."""

    def __init__(self, photos: Sequence[SfmPhoto]) -> None:
        self._counts = [len(photo.keypoints) for photo in photos]
        self._rows: dict[int, dict[int, NDArray[np.uint32]]] = defaultdict(dict)

    def add(self, pair: Matches) -> None:
        self._rows[pair.first][pair.second] = pair.rows
        self._rows[pair.second][pair.first] = pair.rows[:, ::-1]

    def agree_with(self, pair: Matches) -> bool:
        """Tell whether third photos link the keypoints that a pair matches, and to no others.

        Of the keypoints that third photos link, more than half must be linked as the pair matches
        them.
        """
        first, second = self._rows[pair.first], self._rows[pair.second]
        agrees = np.zeros(len(pair.rows), dtype=bool)
        differs = np.zeros(len(pair.rows), dtype=bool)
        for third in first.keys() & second.keys():
            there = self._lookup(pair.first, first[third])[pair.rows[:, 0]]
            back = self._lookup(pair.second, second[third])[pair.rows[:, 1]]
            linked = (there >= 0) & (back >= 0)
            agrees |= linked & (there == back)
            differs |= linked & (there != back)
        return bool(agrees.sum() >= max(_MIN_AGREEING, differs.sum()))

    def _lookup(self, photo: int, rows: NDArray[np.uint32]) -> NDArray[np.int64]:
        """Return (n,) the keypoint that each keypoint of a photo matches; -1 for none."""
        found = np.full(self._counts[photo], -1)
        found[rows[:, 0]] = rows[:, 1]
        return found


class _Around:
    """The pairs between the neighbours of a pair's photos in time, but not those near in time."""

    def __init__(
        self,
        photos: Sequence[SfmPhoto],
        order: Sequence[int],
        matches: Sequence[Matches],
        passing: Sequence[bool],
        near: Sequence[bool],
    ) -> None:
        self._places = [(photo.sensor, rank) for photo, rank in zip(photos, order, strict=True)]
        self._photos = {place: row for row, place in enumerate(self._places)}
        self._pairs = {
            frozenset((pair.first, pair.second)): (len(pair.rows), passes)
            for pair, passes, is_near in zip(matches, passing, near, strict=True)
            if not is_near
        }

    def share_passing(self, pair: Matches) -> float:
        """Return the share of those that pass, counted in matches; 1 if there are none."""
        sides = self._beside(pair.first, pair.second), self._beside(pair.second, pair.first)
        beside = set(map(frozenset, product(*sides)))
        beside.discard(frozenset((pair.first, pair.second)))
        found = [self._pairs[each] for each in beside if each in self._pairs]
        number = sum(matched for matched, _ in found)
        return sum(matched for matched, passes in found if passes) / number if number else 1.0

    def _beside(self, photo: int, other: int) -> list[int]:
        """Return a photo and its neighbours in time, as far as they are not nearer to the other."""
        sensor, rank = self._places[photo]
        other_sensor, other_rank = self._places[other]
        ranks = range(rank - _NEAR_STEPS, rank + _NEAR_STEPS + 1)
        return [
            self._photos[sensor, near]
            for near in ranks
            if (sensor, near) in self._photos
            and (sensor != other_sensor or abs(near - rank) <= abs(near - other_rank))
        ]


class _Confirmed:
    """The keypoints of each photo that photos with most matches confirm."""

    def __init__(self, photos: Sequence[SfmPhoto], matches: Sequence[Matches]) -> None:
        partners: dict[int, list[tuple[int, int, NDArray[np.uint32]]]] = defaultdict(list)
        for pair in matches:
            for own, other, side in ((pair.first, pair.second, 0), (pair.second, pair.first, 1)):
                partners[own].append((-len(pair.rows), other, pair.rows[:, side]))
        self._strongest: dict[int, list[int]] = {}
        # One bit for each of the strongest, and one more to stand in for the other of a pair.
        self._bits = [np.zeros(len(photo.keypoints), np.uint8) for photo in photos]
        for own, found in partners.items():
            best = sorted(found, key=lambda each: each[:2])[: _CONFIRMING + 1]
            self._strongest[own] = [other for _, other, _ in best]
            for bit, (_, _, rows) in enumerate(best):
                self._bits[own][rows] |= np.uint8(1 << bit)

    def by_others(self, photo: int, partner: int) -> NDArray[np.intp]:
        """Return rows of the keypoints that photos other than the partner confirm."""
        strongest = self._strongest[photo]
        spare = strongest.index(partner) if partner in strongest else _CONFIRMING
        return np.flatnonzero(self._bits[photo] & np.uint8(0xFF ^ (1 << spare)))


def _share_found(photos: Sequence[SfmPhoto], confirmed: _Confirmed, pair: Matches) -> float:
    """Return the share of confirmed keypoints in the common field of view that the pair matches.

    The lower of both photos' shares; 1 if too few are confirmed to tell.
    """
    shares = [1.0]
    for side, own, other in ((0, pair.first, pair.second), (1, pair.second, pair.first)):
        rows = confirmed.by_others(own, other)
        if len(rows) < _MIN_EXPECTED:
            continue
        matched = pair.rows[:, side]
        ours = photos[own].keypoints.astype(np.float64)
        theirs = photos[other].keypoints[pair.rows[:, 1 - side]].astype(np.float64)
        some = slice(None, None, -(-len(matched) // _MAX_FITTED))
        moved = _with_one(ours[rows]) @ _affine_fit(ours[matched[some]], theirs[some])
        camera = photos[other].camera
        inside = ((moved > 0) & (moved < (camera.width, camera.height))).all(axis=1)
        found = np.zeros(len(ours), dtype=bool)
        found[matched] = True
        if inside.sum() >= _MIN_EXPECTED:
            shares.append(float(found[rows[inside]].mean()))
    return min(shares)


def _affine_fit(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the affine map (3, 2) that takes matched pixels (n, 2) to each other.

    It is rough, because depths differ: it only tells which part of a photo the other shows. The sum
    of the errors is minimized by reweighting, not the sum of their squares.
    """
    design = _with_one(ours)
    weights = np.ones(len(ours))
    damping = _DAMPING * np.eye(3)
    for _ in range(_FIT_ROUNDS):
        weighted = design.T * weights
        fit = np.linalg.solve(weighted @ design + damping, weighted @ theirs)
        errors = np.linalg.norm(design @ fit - theirs, axis=1)
        weights = 1 / np.maximum(errors, _FIT_SCALE_PX)
    return np.asarray(fit)


def _with_one(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([pixels, np.ones(len(pixels))])


def ranks_in_time(photos: Sequence[SfmPhoto]) -> list[int]:
    """Return the place of each photo in its sensor's order of time."""
    ranks = [0] * len(photos)
    taken: dict[str, int] = defaultdict(int)
    for row in sorted(range(len(photos)), key=lambda row: (photos[row].timestamp, row)):
        ranks[row] = taken[photos[row].sensor]
        taken[photos[row].sensor] += 1
    return ranks


def _are_near(photos: Sequence[SfmPhoto], ranks: Sequence[int], pair: Matches) -> bool:
    first, second = photos[pair.first], photos[pair.second]
    if first.sensor == second.sensor:
        return abs(ranks[pair.first] - ranks[pair.second]) <= _NEAR_STEPS
    return first.timestamp == second.timestamp
