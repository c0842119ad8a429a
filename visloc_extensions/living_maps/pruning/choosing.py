"""Chooses which observations and photos of a map to keep.

Every photo keeps the same number, K, of observations: landmarks that cover every photo K times let
a query near any photo be localized (Li et al. 2010, Cao and Snavely 2014). Observations are taken
from the cells of a photo in turn, so that they are spread over it. Within a cell the choice is
random, except that landmarks that two other photos have kept already come last. Preferring
landmarks that many photos see lost queries, because those lie close together and a query matches
each of them only once (README.md of this extension).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mapping.stages.imported_points import FILE_NAME as IMPORTED_POINTS
from mapping.stages.publishing import PAIRS
from visloc.archive import Map
from visloc.archive.checks import json_text
from visloc.archive.schema import photo_file
from visloc.localization.map_view.constraints import MapGeometry

# Cells of a photo, along its width and height.
_CELLS = (8, 6)
# Observations of a landmark that count as new in the photos they are in.
_DISTINCT = 2
# Photos are dropped rather than that each keeps fewer observations than this, while others cover
# them: stand within so many radians, of turn and of parallax together.
_ENOUGH = 80
_COVERED_WITHIN = 0.4
# With fewer in a photo, its neighbourhood is lost: a pose needs 30 inliers.
_LEAST = 50
_HEADER_BYTES = 128  # of an ``.npy``
# Neither is needed to localize, nor true of a part of the photos.
LEFT_OUT = (PAIRS, IMPORTED_POINTS)


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """The part of a map that stays.

    Attributes:
        images: (n,) photos.
        observations: (M,) of the map, none of photos that go.
        per_photo: most observations of one photo.
    """

    images: NDArray[np.bool_]
    observations: NDArray[np.bool_]
    per_photo: int


def choose(opened: Map, fits: Callable[[Kept], bool], *, whole_landmarks: bool) -> Kept | None:
    """Keep as much as fits.

    Args:
        fits: whether so much may stay; what is part of something that fits does too.
        whole_landmarks: whether a landmark that stays keeps all its observations by photos that
            stay: where only their number counts.

    Returns:
        What stays; None where the least that a map needs does not fit, which ``least`` tells.
    """
    turn = _turns(opened)
    num, most = len(opened.images), int(turn.max()) + 1
    order, num_needed = np.arange(num), num

    def kept(num_photos: int, per_photo: int) -> Kept:
        images = np.zeros(len(order), np.bool_)
        images[order[:num_photos]] = True
        return _kept(opened, turn, images, per_photo, whole_landmarks=whole_landmarks)

    if not fits(kept(num, min(_ENOUGH, most))):
        order, num_needed = _photos_by_need(opened)  # slow in large maps
        num = _most(num_needed, num, lambda count: fits(kept(count, _ENOUGH)))
    found = kept(num, _most(min(_LEAST, most), most, lambda count: fits(kept(num, count))))
    return found if fits(found) else None


def least(opened: Map, *, whole_landmarks: bool) -> Kept:
    """Return the least that ``choose`` keeps."""
    order, num_needed = _photos_by_need(opened)
    images = np.zeros(len(order), np.bool_)
    images[order[:num_needed]] = True
    return _kept(opened, _turns(opened), images, _LEAST, whole_landmarks=whole_landmarks)


def size_with(opened: Map, kept: Kept) -> int:
    """Bytes of the files of a map with what is kept, manifest aside."""
    files, num_photos = opened.manifest.files, len(opened.images)
    of_photos = int(kept.images.sum()) / num_photos
    of_observations = int(kept.observations.sum()) / len(kept.observations)
    of_landmarks = num_landmarks(opened, kept) / len(opened.landmarks)
    pictures = {photo_file(row): stays for row, stays in enumerate(kept.images.tolist())}
    total = 0
    for name, entry in files.items():
        if name in pictures:
            total += entry.size * pictures[name]
        elif name == "images.json":
            stay = [asdict(opened.images[row]) for row in np.flatnonzero(kept.images)]
            total += len(json_text({"images": stay}).encode())
        elif name == "observation_offsets.npy":
            total += entry.size - 8 * (num_photos - int(kept.images.sum()))
        elif name.startswith("landmark"):
            total += _shortened(entry.size, of_landmarks)
        elif name.startswith("observation_"):
            total += _shortened(entry.size, of_observations)
        elif name == "image_poses.npy" or name.startswith(("global/", "index/")):
            whole = name.endswith(".model.npz")
            total += entry.size if whole else _shortened(entry.size, of_photos)
        elif name not in LEFT_OUT:
            total += entry.size
    return total


def _shortened(size: int, share: float) -> int:
    """Bytes of an ``.npy`` of which a part of the rows stays."""
    return _HEADER_BYTES + math.ceil((size - _HEADER_BYTES) * share)


def num_landmarks(opened: Map, kept: Kept) -> int:
    """How many landmarks a map has with what is kept."""
    return len(np.unique(opened.observation_landmarks[kept.observations]))


def _kept(
    opened: Map,
    turn: NDArray[np.int64],
    images: NDArray[np.bool_],
    per_photo: int,
    *,
    whole_landmarks: bool,
) -> Kept:
    of_kept = np.repeat(images, np.diff(opened.observation_offsets))
    observations = of_kept & (turn < per_photo)
    if whole_landmarks:
        stay = np.zeros(len(opened.landmarks), np.bool_)
        stay[opened.observation_landmarks[observations]] = True
        observations = of_kept & stay[opened.observation_landmarks]
    return Kept(images, observations, per_photo)


def _turns(opened: Map) -> NDArray[np.int64]:
    """(M,) when an observation is taken of its photo, from 0: from cell after cell."""
    offsets, landmarks = opened.observation_offsets, opened.observation_landmarks
    photo = np.repeat(np.arange(len(opened.images)), np.diff(offsets))
    chance = np.random.default_rng(0).random(len(landmarks))
    late = _ranks(np.asarray(landmarks, np.int64), chance) >= _DISTINCT
    columns, rows = _CELLS
    cells = []
    for image, record in enumerate(opened.images):
        camera = opened.cameras[record.camera]
        x, y = opened.keypoints(image).T
        column = np.clip(x * columns / camera.width, 0, columns - 1).astype(np.int64)
        row = np.clip(y * rows / camera.height, 0, rows - 1).astype(np.int64)
        cells.append(row * columns + column)
    cell = photo * (columns * rows) + np.concatenate(cells)
    return _ranks(photo, chance, _ranks(cell, chance, late), late)


def _ranks(group: NDArray[np.int64], *keys: NDArray[np.generic]) -> NDArray[np.int64]:
    """The place of each row in its group when rows are sorted by keys, the last one first."""
    order = np.lexsort((*keys, group))
    _, starts = np.unique(group[order], return_index=True)
    sizes = np.diff(np.append(starts, len(group)))
    ranks = np.empty(len(group), np.int64)
    ranks[order] = np.arange(len(group)) - np.repeat(starts, sizes)
    return ranks


def _photos_by_need(opened: Map) -> tuple[NDArray[np.int64], int]:
    """Photos so ordered that every beginning covers the map best, and how many are needed.

    The next one is that which is furthest from all before (Gonzalez 1985). Those after the needed
    ones all have a photo that stands within ``_COVERED_WITHIN``.
    """
    geometry = MapGeometry(opened)
    turns = Rotation.from_quat(opened.image_poses[:, :4], scalar_first=True).as_matrix()
    # Euclidean distances of these are angles: of the parallax, and nearly of the turn.
    reach = max(geometry.reach, 1e-9)
    views = np.hstack([geometry.centers / reach, turns.reshape(-1, 9) / np.sqrt(2)])
    order, radii = [0], [np.inf]
    away = np.linalg.norm(views - views[0], axis=1)
    while len(order) < len(views):
        away[order[-1]] = -1.0
        furthest = int(away.argmax())
        order.append(furthest)
        radii.append(float(away[furthest]))
        away = np.minimum(away, np.linalg.norm(views - views[furthest], axis=1))
    return np.array(order), int(np.count_nonzero(np.array(radii) > _COVERED_WITHIN))


def _most(low: int, high: int, fits: Callable[[int], bool]) -> int:
    """The largest number from low to high that fits; low if none does."""
    while low < high:
        middle = (low + high + 1) // 2
        if fits(middle):
            low = middle
        else:
            high = middle - 1
    return low
