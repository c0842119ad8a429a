"""A film through two hallways of one design, joined by what both show, is parted again."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.methods import undoing
from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.model import MAPPER_CONFIGS, SfmPhoto, SparseModel
from mapping.methods.sparse.triangulation import reconstruct
from mapping.methods.undoing import reconstruct_places
from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (450.0, 320.0, 240.0))
CONFIG = MAPPER_CONFIGS["config1"]
NUM_POINTS, PHOTOS_EACH = 500, 8


def film(share: float) -> tuple[list[SfmPhoto], list[NDArray[np.int8]], list[Matches]]:
    """Photos along one hallway, then along another, in which a share of the points is the same.

    Keypoint k shows point k of either place. Two photos match where both find the same point.
    """
    random = np.random.default_rng(0)
    num_alike = round(share * NUM_POINTS)
    points = [random.uniform([-3, -2, 3], [3, 2, 9], (NUM_POINTS, 3)) for _ in range(2)]
    looks = [random.integers(-127, 128, (NUM_POINTS, 32)).astype(np.int8) for _ in range(2)]
    for each in (points, looks):
        each[1][:num_alike] = each[0][:num_alike]
    photos, descriptors, found = [], [], []
    for row in range(2 * PHOTOS_EACH):
        place, number = divmod(row, PHOTOS_EACH)
        # The film goes back through the second hallway.
        at = number if place == 0 else PHOTOS_EACH - 1.5 - number
        pose = Pose(np.eye(3), np.array([-0.25 * at, 0.05 * (number % 3), -0.1 * at]))
        pixels = project(CAMERA, pose.apply(points[place]))
        inside = ((pixels > 0) & (pixels < (640, 480))).all(axis=1)
        found.append(inside & (random.random(NUM_POINTS) < 0.85))
        photos.append(
            SfmPhoto(f"{row}.jpg", "cam", row, CAMERA, True, None, pixels.astype(np.float32))
        )
        # What is not found looks like nothing else.
        others = random.integers(-127, 128, looks[0].shape).astype(np.int8)
        descriptors.append(np.where(found[-1][:, None], looks[place], others))
    matches = []
    for a, b in combinations(range(len(photos)), 2):
        shown = found[a] & found[b]
        if place_of(a) != place_of(b):
            shown[num_alike:] = False
        rows = np.flatnonzero(shown).astype(np.uint32)
        if len(rows) >= CONFIG.min_num_matches:
            matches.append(Matches(a, b, np.column_stack([rows, rows])))
    return photos, descriptors, matches


def place_of(row: int) -> int:
    return row // PHOTOS_EACH


def places_in(model: SparseModel) -> set[int]:
    return {place_of(row) for row, view in enumerate(model.views) if view is not None}


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_a_film_through_two_hallways_makes_a_model_of_one(share: float, tmp_path: Path) -> None:
    photos, descriptors, matches = film(share)
    inputs: tuple[Any, ...] = ({}, matches, CONFIG, (), tmp_path, lambda *_: None)
    # There is something to undo.
    assert places_in(reconstruct(photos, *inputs)) == {0, 1}

    model = reconstruct_places(photos, descriptors.__getitem__, *inputs)
    assert len(places_in(model)) == 1
    assert sum(view is not None for view in model.views) == PHOTOS_EACH
    assert model.undone > 0


def test_a_hallway_walked_twice_stays_whole(tmp_path: Path) -> None:
    photos, descriptors, matches = film(1.0)
    model = reconstruct_places(
        photos, descriptors.__getitem__, {}, matches, CONFIG, (), tmp_path, lambda *_: None
    )
    assert all(model.views)
    assert model.undone == 0


def test_only_pairs_that_the_model_lacks_count_as_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos, descriptors, matches = film(0.25)
    inputs: tuple[Any, ...] = ({}, matches, CONFIG, (), tmp_path, lambda *_: None)
    monkeypatch.setattr("mapping.methods.undoing._MOST_MODELS", 1)
    model = reconstruct_places(photos, descriptors.__getitem__, *inputs)
    assert places_in(model) == {0, 1}
    assert model.undone == 0


def test_a_model_that_cannot_be_parted_stays(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its own test tells that it shows two places; nothing at all would tell less."""
    photos, descriptors, matches = film(0.25)
    made: list[SparseModel] = []

    def once(*arguments: Any) -> SparseModel:
        if made:
            raise refuse("sfm.no_model")
        made.append(reconstruct(*arguments))
        return made[0]

    monkeypatch.setattr(undoing, "reconstruct", once)
    model = reconstruct_places(
        photos, descriptors.__getitem__, {}, matches, CONFIG, (), tmp_path, lambda *_: None
    )
    assert model.views == made[0].views
    assert model.undone == 0
