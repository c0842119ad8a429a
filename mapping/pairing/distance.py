"""Photos taken from nearby in similar directions.

For two cameras at a distance d (between their centres) and an angle a (of the rotation between
them), the score is ``2 - (d / max_distance + a / max_angle)``, from 2 for equal poses down to 0
(Humenberger et al. 2020, turned so that more is better). Pairs beyond either limit are rejected.
Occlusion is unknown: two cameras may pair through a wall.

The search is exact. The sum in the score is at least the Euclidean distance between two cameras
when each is the point ``(centre / max_distance, rotation matrix / (sqrt(2) max_angle))`` in twelve
dimensions, because the Frobenius distance of two rotations is ``2 sqrt(2) sin(a / 2) <=
sqrt(2) a``. A k-d tree over these points gives each photo some nearest ones; when its k-th best
pair is better than the farthest of them could be, no photo beyond can matter. The few other photos,
such as those of a camera that stood still, are compared with all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapping.pairing.posed import PosedPhotos, nearest, posed_photos
from mapping.pairing.ranking import Candidates, best_of_each, best_of_rows, unite
from mapping.pairing.scene import Pairs, Scene
from mapping.pairing.settings import PairSettings

# Pairs scored at a time: some 100 MiB with all that is computed of them.
_BLOCK_SIZE = 2**20
# Neighbours to search per pair. In six dimensions, a sum of two lengths below s
# takes about 1/8 of the volume of the ball of radius s; hence somewhat more than 8.
_NEIGHBOURS_PER_PAIR = 12
# No accepted pair is farther apart in the tree than sqrt(2); rounding must lose none.
_SEARCH_RADIUS = 1.5


def pair_by_distance(scene: Scene, settings: PairSettings) -> Pairs:
    """Pair every photo with the ``top_k`` nearest in position and rotation.

    Photos without a pose get no pair. Two photos from the same place, which differ by a rotation
    only, still pair with a high score; their matches are lost, since given poses confirm none
    without a baseline (``visloc.matching.verification.epipolar_errors``).
    """
    posed = posed_photos(scene, "distance")
    found = unite(_search(posed, settings))
    return Pairs(posed.rows[found.rows], found.scores)


def _search(posed: PosedPhotos, settings: PairSettings) -> Iterator[Candidates]:
    top_k = settings.top_k
    everyone = np.arange(len(posed.rows))
    num_neighbours = _NEIGHBOURS_PER_PAIR * top_k + 1  # a photo finds itself
    if num_neighbours >= len(everyone):
        undecided = [everyone]
    else:
        undecided = []
        points = _tree_points(posed, settings)
        tree = cKDTree(points)
        for photos in _blocks(everyone, num_neighbours):
            bounds, others = nearest(tree, points[photos], num_neighbours, within=_SEARCH_RADIUS)
            missing = np.isinf(bounds)
            scores = _scores(posed, settings, photos, np.where(missing, photos[:, None], others))
            kth = np.partition(scores, -top_k, axis=1)[:, -top_k]
            # Strictly better, by more than rounding: equal scores are ranked by row.
            decided = missing[:, -1] | (2.0 - kth < bounds[:, -1] * (1 - 1e-6) - 1e-9)
            undecided.append(photos[~decided])
            row, column = np.nonzero(decided[:, None] & (scores > -np.inf))
            yield best_of_each(photos[row], others[row, column], scores[row, column], top_k)
    for photos in _blocks(np.concatenate(undecided), len(everyone)):
        yield best_of_rows(photos, _scores(posed, settings, photos, everyone[None]), top_k)


def _tree_points(posed: PosedPhotos, settings: PairSettings) -> NDArray[np.float64]:
    """Make the points (p, 12) whose distances bound ``2 - score`` from below."""
    centers = (posed.centers - posed.centers.mean(axis=0)) / settings.max_distance
    rotations = posed.rotations.reshape(-1, 9) / (
        math.sqrt(2.0) * math.radians(settings.max_angle_deg)
    )
    return np.hstack([centers, rotations])


def _scores(
    posed: PosedPhotos,
    settings: PairSettings,
    photos: NDArray[np.int64],
    others: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Score photos (b,) with others (b or 1, c); minus infinity where rejected or the same."""
    rotations = posed.rotations.reshape(-1, 9)
    distance = _distances(posed.centers, photos, others)
    half_sine = np.minimum(_distances(rotations, photos, others) / math.sqrt(8.0), 1.0)
    angle = 2.0 * np.arcsin(half_sine)
    max_angle = math.radians(settings.max_angle_deg)
    scores = 2.0 - (distance / settings.max_distance + angle / max_angle)
    rejected = (distance > settings.max_distance) | (angle > max_angle)
    scores[rejected | (photos[:, None] == others)] = -np.inf
    return scores


def _distances(
    points: NDArray[np.float64], photos: NDArray[np.int64], others: NDArray[np.int64]
) -> NDArray[np.float64]:
    # Axis by axis: little memory, and the same bits whatever the shape and order of a pair.
    squares = np.zeros(np.broadcast_shapes((len(photos), 1), others.shape))
    for axis in points.T:
        squares += (axis[photos][:, None] - axis[others]) ** 2
    return np.sqrt(squares)


def _blocks(photos: NDArray[np.int64], pairs_per_photo: int) -> Iterator[NDArray[np.int64]]:
    step = max(1, _BLOCK_SIZE // pairs_per_photo)
    for start in range(0, len(photos), step):
        yield photos[start : start + step]
