"""Incremental mapping whose wrong loop closures are found in the finished model, and undone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.colmap_scene import Rigs
from mapping.methods.sparse.contradictions import ModelPhoto, Places, find_places
from mapping.methods.sparse.look_alikes import without_look_alikes
from mapping.methods.sparse.model import MapperConfig, SfmPhoto, SparseModel
from mapping.methods.sparse.pair_agreement import contradicted_pairs
from mapping.methods.sparse.triangulation import reconstruct
from mapping.progress import ItemProgress, Progress, part_of
from mapping.stages.landmarks import rows_by_value
from visloc.errors import InvalidInput

# At most so many models are made. Errors of the last one stay, and the map's own test reports them.
_MOST_MODELS = 4
# Matches of a pair that is tried although it may look alike. In a collection of ten photos, most
# true ones have 240 to 690; pairs that fold other walls of a lobby onto its map have 70 to 160.
_MANY_MATCHES = 200
PLACES = "look-alike places"


def reconstruct_places(
    photos: Sequence[SfmPhoto],
    describe: Callable[[int], NDArray[np.int8]],
    rigs: Rigs,
    matches: Sequence[Matches],
    config: MapperConfig,
    refine: Sequence[str],
    work: Path,
    progress: Progress,
) -> SparseModel:
    """Reconstruct, then repeat it without the pairs of photos that the model shows to be wrong.

    Arguments and errors are those of ``reconstruct``. ``progress`` has one more stage, ``PLACES``.

    Args:
        describe: returns the descriptors (k, D) of a photo's keypoints, all with one scale.
    """
    how = config, refine, work, progress
    told = partial(progress, PLACES)
    try:
        model = reconstruct(photos, rigs, matches, *how)
    except InvalidInput:
        whole = _of_all_pairs(photos, describe, rigs, matches, *how)
        if whole is None:
            raise
        return whole
    if None in model.views:
        whole = _of_all_pairs(photos, describe, rigs, matches, *how)
        if whole is not None and whole.views.count(None) < model.views.count(None):
            return whole
    undone = 0
    for _ in range(_MOST_MODELS - 1):
        kept = _without_two_places(photos, describe, matches, model, told)
        if len(kept) == len(matches):
            break
        try:
            model = reconstruct(photos, rigs, kept, *how)
        except InvalidInput:
            break  # too little is left; the map's own test tells that it shows two places
        undone += len(matches) - len(kept)
        matches = kept
    return replace(model, undone=undone)


def _of_all_pairs(
    photos: Sequence[SfmPhoto],
    describe: Callable[[int], NDArray[np.int8]],
    rigs: Rigs,
    matches: Sequence[Matches],
    config: MapperConfig,
    refine: Sequence[str],
    work: Path,
    progress: Progress,
) -> SparseModel | None:
    """Reconstruct with pairs that look alike by many matches, too; None if two places show.

    The filter of look-alike pairs also drops true ones, such as those of a wide photo and of one
    from nearby. Of those with few matches, most are wrong. A photo has no place if most of its
    matches contradict the pose that it gets.
    """
    how = config, refine, work, progress
    believed = {(p.first, p.second) for p in without_look_alikes(photos, matches)}
    matches = [
        pair
        for pair in matches
        if len(pair.rows) >= _MANY_MATCHES or (pair.first, pair.second) in believed
    ]
    if len(matches) == len(believed):
        return None
    try:
        model = reconstruct(photos, rigs, matches, *how, filtered=False)
        against, _ = contradicted_pairs(model, photos, matches, config.filter_max_reproj_error)
        counts = np.zeros((2, len(photos)), np.int64)
        for row, pairs in enumerate((matches, against)):
            for pair in pairs:
                counts[row, [pair.first, pair.second]] += len(pair.rows)
        astray = set(np.flatnonzero(2 * counts[1] > counts[0]).tolist())
        if astray:
            matches = [pair for pair in matches if not {pair.first, pair.second} & astray]
            model = reconstruct(photos, rigs, matches, *how, filtered=False)
    except InvalidInput:
        return None
    told = partial(progress, PLACES)
    kept = _without_two_places(photos, describe, matches, model, told)
    return model if len(kept) == len(matches) else None


def _without_two_places(
    photos: Sequence[SfmPhoto],
    describe: Callable[[int], NDArray[np.int8]],
    matches: Sequence[Matches],
    model: SparseModel,
    progress: ItemProgress,
) -> list[Matches]:
    number, places = _places_of(photos, describe, model, progress)
    return [
        pair
        for pair in matches
        if pair.first not in number
        or pair.second not in number
        or not places.tell_apart(number[pair.first], number[pair.second])
    ]


def _places_of(
    photos: Sequence[SfmPhoto],
    describe: Callable[[int], NDArray[np.int8]],
    model: SparseModel,
    progress: ItemProgress,
) -> tuple[dict[int, int], Places]:
    """Return the order of the photos in a model, by their rows, and the places that they show."""
    observations = model.observations
    own = dict(rows_by_value(observations.views))
    none = np.empty(0, np.int64)
    number: dict[int, int] = {}
    placed: list[ModelPhoto] = []
    describing = part_of(progress, 0, 2)
    for row, (photo, view) in enumerate(zip(photos, model.views, strict=True)):
        describing(row, len(photos))
        if view is None:
            continue
        number[row] = len(placed)
        seen = own.get(row, none)
        placed.append(
            ModelPhoto(
                view,
                photo.keypoints,
                describe(row),
                observations.points[seen],
                observations.rows[seen],
            )
        )
    places = find_places(placed, model.points, part_of(progress, 1, 2))
    progress(len(photos), len(photos))
    return number, places
