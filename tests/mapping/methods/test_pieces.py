"""Photos of three rooms that nothing links: models of those that have enough photos."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from mapping.methods.matching.stages import Matches
from mapping.methods.pieces import MIN_PHOTOS, models_beside
from mapping.methods.sparse.model import MAPPER_CONFIGS, SfmPhoto, SparseModel
from mapping.methods.sparse.triangulation import reconstruct
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (450.0, 320.0, 240.0))
CONFIG = MAPPER_CONFIGS["config1"]
# Photos of each room; the last one has too few.
IN_ROOM = (8, 6, MIN_PHOTOS - 1)
ROOM_OF = np.repeat(np.arange(len(IN_ROOM)), IN_ROOM)


@pytest.fixture(scope="module")
def photographed() -> tuple[list[SfmPhoto], list[Matches]]:
    """Keypoint k of a photo shows point k of its room; photos of the rooms are mixed."""
    random = np.random.default_rng(0)
    points = [random.uniform([-3, -2, 3], [3, 2, 9], (400, 3)) for _ in IN_ROOM]
    photos, inside = [], []
    for row, room in enumerate(random.permutation(ROOM_OF)):
        at = sum(photo.sensor == str(room) for photo in photos)
        pose = Pose(np.eye(3), np.array([-0.25 * at, 0.05 * (at % 3), -0.1 * at]))
        pixels = project(CAMERA, pose.apply(points[room]))
        inside.append(((pixels > 0) & (pixels < (640, 480))).all(axis=1))
        photos.append(
            SfmPhoto(f"{row}.jpg", str(room), row, CAMERA, True, None, pixels.astype(np.float32))
        )
    matches = []
    for a, b in combinations(range(len(photos)), 2):
        if photos[a].sensor == photos[b].sensor:
            rows = np.flatnonzero(inside[a] & inside[b]).astype(np.uint32)
            matches.append(Matches(a, b, np.column_stack([rows, rows])))
    return photos, matches


def make(
    photos: Sequence[SfmPhoto], work: Path, rows: Sequence[int], matches: Sequence[Matches]
) -> SparseModel:
    some = [photos[row] for row in rows]
    return reconstruct(some, {}, matches, CONFIG, (), work, lambda *_: None)


def rooms_in(model: SparseModel, photos: Sequence[SfmPhoto]) -> list[str]:
    return [p.sensor for p, view in zip(photos, model.views, strict=True) if view is not None]


def test_each_room_with_enough_photos_has_a_model(
    photographed: tuple[list[SfmPhoto], list[Matches]], tmp_path: Path
) -> None:
    photos, matches = photographed
    make_some = partial(make, photos, tmp_path)
    largest = make_some(range(len(photos)), matches)
    assert rooms_in(largest, photos) == ["0"] * IN_ROOM[0]
    (other,) = models_beside(largest, matches, make_some)
    assert rooms_in(other, photos) == ["1"] * IN_ROOM[1]


def test_observations_are_of_the_photos_that_they_were_before(
    photographed: tuple[list[SfmPhoto], list[Matches]], tmp_path: Path
) -> None:
    photos, matches = photographed
    make_some = partial(make, photos, tmp_path)
    (other,) = models_beside(make_some(range(len(photos)), matches), matches, make_some)
    seen = other.observations
    for row in np.unique(seen.views).tolist():
        view, own = other.views[row], seen.views == row
        assert view is not None
        pixels = project(view.camera, view.cam_from_world.apply(other.points[seen.points[own]]))
        np.testing.assert_allclose(pixels, photos[row].keypoints[seen.rows[own]], atol=0.5)


def test_that_there_is_no_further_model_prints_nothing(
    photographed: tuple[list[SfmPhoto], list[Matches]],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    photos, matches = photographed
    few = Matches(0, 1, matches[0].rows[: CONFIG.min_num_matches])
    with pytest.raises(InvalidInput) as refused:
        make(photos, tmp_path, (matches[0].first, matches[0].second), [few])
    assert refused.value.code == "sfm.no_model"
    assert capfd.readouterr() == ("", "")
