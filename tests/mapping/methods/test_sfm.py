from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapping.methods.sfm import _on_unit, _rig_parallax_px, _with_their_groups, with_found_cameras
from mapping.methods.sparse.intrinsics import Doubt
from mapping.methods.sparse.model import SparseModel
from mapping.stages.landmarks import Observations, View
from mapping.stages.photos import MappingPhoto
from visloc.geometry import Camera, Pose
from visloc.kapture import FileRecord

GUESS = Camera("SIMPLE_RADIAL", 640, 480, (768.0, 320.0, 240.0, 0.0))
FOUND = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.1))


def photo_of(number: int, sensor: str, *, known: bool = False) -> MappingPhoto:
    record = FileRecord(number, sensor, f"{sensor}/{number}.jpg")
    return MappingPhoto(record, Path(record.path), "", GUESS, known, None, None, None)


def model_of(*cameras: Camera | None, doubts: dict[str, Doubt] | None = None) -> SparseModel:
    views = tuple(None if camera is None else View(camera, Pose.identity()) for camera in cameras)
    none = np.empty(0, np.int64)
    seen = Observations(none, none, none, np.empty((0, 2), np.float32))
    angles = np.empty(0, np.float32)
    return SparseModel(views, np.empty((0, 3)), seen, angles, False, doubts or {})


def test_a_photo_without_a_place_gets_the_camera_that_others_found() -> None:
    photos = [photo_of(0, "film"), photo_of(1, "film"), photo_of(0, "other")]
    found = with_found_cameras(photos, model_of(FOUND, None, None))
    assert found is not None
    assert [photo.camera for photo in found] == [FOUND, FOUND, GUESS]
    assert [photo.camera_known for photo in found] == [True, True, False]


def test_where_all_photos_have_a_place_nothing_is_done_again() -> None:
    photos = [photo_of(0, "film"), photo_of(1, "film")]
    assert with_found_cameras(photos, model_of(FOUND, FOUND)) is None


def test_a_camera_that_was_known_teaches_nothing() -> None:
    photos = [photo_of(0, "film", known=True), photo_of(1, "film", known=True)]
    assert with_found_cameras(photos, model_of(FOUND, None)) is None


def test_a_camera_in_doubt_stays_unknown() -> None:
    photos = [photo_of(0, "film"), photo_of(1, "film")]
    doubts = {"film": Doubt("undetermined", 500.0)}
    assert with_found_cameras(photos, model_of(FOUND, None, doubts=doubts)) is None


def test_pairs_are_verified_again_with_all_that_were_matched_together() -> None:
    pairs = np.array([[0, 1], [0, 3], [1, 2], [2, 3], [2, 4]])
    absent = np.array([False, False, False, True, False])
    assert pairs[_with_their_groups(pairs, absent)].tolist() == [[0, 1], [0, 3], [2, 3], [2, 4]]


@pytest.mark.parametrize(
    ("baseline", "parallax_px"), [(0.5, 50.0), (0.05, 5.0), (0.0, 0.0)], ids=str
)
def test_the_parallax_of_a_rig_is_its_baseline_over_the_depth_in_pixels(
    baseline: float, parallax_px: float
) -> None:
    photos = [photo_of(0, "left"), photo_of(0, "right"), photo_of(1, "left")]
    rig = {"left": Pose.identity(), "right": Pose(np.eye(3), np.array([-baseline, 0.0, 0.0]))}
    poses = rig["left"], rig["right"], Pose(np.eye(3), np.array([-9.0, 0.0, 0.0]))
    first, zeros = np.zeros(1, np.int64), np.zeros((1, 2), np.float32)
    model = SparseModel(
        tuple(View(FOUND, pose) for pose in poses),
        np.array([[0.0, 0.0, 5.0]]),
        Observations(first, first, first, zeros),
        np.zeros(1, np.float32),
        True,
        {},
    )
    assert _rig_parallax_px(photos, model, {"rig": rig}) == pytest.approx(parallax_px)


@pytest.mark.parametrize(
    ("scale", "margin", "unit_error", "noted", "doubted"),
    [
        (1.04, 0.001, 0.02, False, False),
        (0.9, 0.06, 0.02, False, False),  # the positions are as inexact
        (0.92, 0.003, 0.05, True, False),  # the rig may be
        (0.92, 0.003, 0.01, False, True),
        (0.5, 0.01, 0.2, False, True),
    ],
)
def test_positions_that_contradict_the_unit_of_rigs_are_noted_or_make_a_doubt(
    scale: float, margin: float, unit_error: float, noted: bool, doubted: bool
) -> None:
    notes, doubts = _on_unit(scale, margin, unit_error)
    assert (bool(notes), [doubt.kind for doubt in doubts]) == (noted, ["unit"] * doubted)
