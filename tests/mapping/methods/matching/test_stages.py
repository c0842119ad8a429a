from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.cluster.workers import Workers
from mapping.methods.matching import stages
from mapping.methods.matching.stages import (
    Verification,
    find_fixed,
    fits_poses,
    match_pairs,
    outside_fixed,
)
from mapping.stages.camera_mask import CameraMask, are_masked
from mapping.stages.context import BuildContext
from mapping.stages.landmarks import View
from mapping.stages.networks import Networks
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import WorkFolder
from visloc.geometry import Camera, Pose
from visloc.kapture import FileRecord
from visloc.kapture.matches import open_matches, write_matches
from visloc.matching.products import EightBitRows, round_descriptors
from visloc.options import Inference
from visloc.pose.reprojection import project
from visloc.types import Fingerprint, LocalFeatures

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
POINTS = np.random.default_rng(0).uniform([-2, -1.5, 4], [2, 1.5, 8], (60, 3))
NUM_WRONG = 20


class TrueFeatures:
    """Keypoint k of every photo shows point k; the first 20 of odd photos are elsewhere."""

    fingerprint = Fingerprint("true", 1, {})
    descriptor_dim = 60
    computed_with = None
    max_keypoints = 60

    def key(self, photo: MappingPhoto) -> str:
        return photo.name

    def prepare(self, photo: MappingPhoto) -> None:
        pass

    def turn(self, _photo: MappingPhoto) -> int:
        return 1

    def read(self, photo: MappingPhoto) -> LocalFeatures:
        pose = pose_of(photo.record.timestamp)
        pixels = project(CAMERA, pose.apply(POINTS)).astype(np.float32)
        if photo.record.timestamp % 2:
            pixels[:NUM_WRONG] = np.random.default_rng(1).uniform(0, 480, (NUM_WRONG, 2))
        ones = np.ones(60, np.float32)
        return LocalFeatures(pixels, np.eye(60, dtype=np.float32), ones, ones)


def pose_of(number: int) -> Pose:
    return Pose(np.eye(3), np.array([-0.3 * number, 0.05 * number, 0.0]))


def make_photo(number: int) -> MappingPhoto:
    record = FileRecord(number, "cam", f"{number}.jpg")
    return MappingPhoto(record, Path(record.path), "", CAMERA, True, pose_of(number), None, None)


def matched(root: Path, pairs: NDArray[np.int64], **changes: object) -> list[tuple[int, int, int]]:
    values = {"max_error_px": 4.0, "min_matches": 15, "poses_known": True} | changes
    networks = Networks(None, Inference.TORCH)
    context = BuildContext(WorkFolder(root), TrueFeatures(), networks, Workers(1), lambda *_: None)
    photos = [make_photo(number) for number in range(3)]
    found, _ = match_pairs(context, photos, pairs, Verification(**values))  # type: ignore[arg-type]
    return [(pair.first, pair.second, len(pair.rows)) for pair in found]


PAIRS = np.array([[0, 1], [0, 2], [1, 2]])


@pytest.mark.parametrize("poses_known", [True, False])
def test_wrong_matches_do_not_fit_and_right_ones_do(tmp_path: Path, poses_known: bool) -> None:
    found = {(a, b): num for a, b, num in matched(tmp_path, PAIRS, poses_known=poses_known)}
    assert found[0, 2] == 60
    # A wrong one may lie on its line by chance.
    assert 40 <= found[0, 1] <= 43
    assert 40 <= found[1, 2] <= 43


def test_partners_are_in_memory_one_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounded: list[weakref.ref[NDArray[np.int8]]] = []
    alive: list[int] = []

    def watched(descriptors: NDArray[np.float32]) -> EightBitRows:
        found = round_descriptors(descriptors)
        rounded.append(weakref.ref(found.rows))
        alive.append(sum(rows() is not None for rows in rounded))
        return found

    monkeypatch.setattr(stages, "round_descriptors", watched)
    matched(tmp_path, np.array([[0, 1], [0, 2]] * 5))
    assert len(alive) == 11
    assert max(alive) <= 3  # the photo, the partner before and the next one


def test_a_pair_with_fewer_matches_than_are_asked_for_has_none(tmp_path: Path) -> None:
    assert matched(tmp_path, PAIRS, min_matches=50) == [(0, 2, 60)]


def test_no_pairs_have_no_matches(tmp_path: Path) -> None:
    assert matched(tmp_path, np.empty((0, 2), dtype=np.int64)) == []


def test_finished_matches_are_found_again(tmp_path: Path) -> None:
    def items() -> dict[Path, int]:
        return {path: path.stat().st_ino for path in tmp_path.rglob("*.npz")}

    matched(tmp_path, PAIRS)
    before = items()
    assert len(before) == 4  # matches and verified, of two photos with partners
    matched(tmp_path, PAIRS, max_error_px=1.0)
    after = items()
    assert after.items() >= before.items()
    assert {path.parent.name for path in after.keys() - before.keys()} == {"verified"}


def test_the_limit_is_in_pixels_of_the_photos() -> None:
    views = View(CAMERA, pose_of(0)), View(CAMERA, Pose(np.eye(3), np.array([-1.0, 0.0, 0.0])))
    # The epipolar lines of two cameras side by side are the rows.
    at = np.array([[300.0, 200.0]] * 3, np.float32)
    shifted = np.array([[250.0, 203.0], [250.0, 205.0], [350.0, 200.0]], np.float32)
    fits = fits_poses(views, at, shifted, 4.0)
    assert fits[:2].tolist() == [True, False]


class FeaturesOnALogo(TrueFeatures):
    """The camera turns as well, and its pictures bear a logo with the first 30 keypoints."""

    def __init__(self, fixed: Mapping[str, CameraMask] | None = None) -> None:
        self.fixed = fixed or {}

    def outside(self, fixed: Mapping[str, CameraMask]) -> FeaturesOnALogo:
        return FeaturesOnALogo(fixed)

    def key(self, photo: MappingPhoto) -> str:
        return f"{photo.name} {len(self.fixed)}"

    logo = np.random.default_rng(2).uniform([500, 400], [600, 460], (30, 2)).astype(np.float32)

    def read(self, photo: MappingPhoto) -> LocalFeatures:
        angle = 0.1 * photo.record.timestamp
        turn = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        )
        seen = Pose(turn, np.zeros(3)) @ pose_of(photo.record.timestamp)
        pixels = project(CAMERA, seen.apply(POINTS)).astype(np.float32)
        pixels[:30] = self.logo
        ones = np.ones(60, np.float32)
        found = LocalFeatures(pixels, np.eye(60, dtype=np.float32), ones, ones)
        masks = [~are_masked(CAMERA, mask, pixels) for mask in self.fixed.values()]
        return found.of(np.all([np.ones(60, bool), *masks], axis=0))


def test_what_is_fixed_to_the_picture_has_no_verified_matches(tmp_path: Path) -> None:
    networks = Networks(None, Inference.TORCH)
    features = FeaturesOnALogo()
    context = BuildContext(WorkFolder(tmp_path), features, networks, Workers(1), lambda *_: None)
    photos = [make_photo(number) for number in range(4)]
    pairs = np.array([[a, b] for a in range(4) for b in range(a + 1, 4)])
    plain = Verification(4.0, 15, poses_known=False)
    fixed = find_fixed(context, photos, pairs, plain)
    assert fixed.keys() == {"cam"}
    assert are_masked(CAMERA, fixed["cam"], features.logo).mean() > 0.8
    outside = outside_fixed(context, photos, fixed)
    found, key = match_pairs(outside, photos, pairs, plain)
    assert len(found) == 6
    for pair in found:
        looks = outside.features.read(photos[pair.first]).descriptors[pair.rows[:, 0]]
        assert len(looks) >= 28
        assert (looks.argmax(axis=1) >= 30).mean() > 0.8  # the others are points of the place
    assert key != match_pairs(context, photos, pairs, plain)[1]


def test_given_matches_of_what_is_fixed_to_the_picture_are_left_out(tmp_path: Path) -> None:
    photos = [make_photo(number) for number in range(4)]
    pairs = np.array([[a, b] for a in range(4) for b in range(a + 1, 4)])
    rows = np.column_stack([np.arange(60), np.arange(60)])
    for a, b in pairs.tolist():
        write_matches(tmp_path / "given", photos[a].name, photos[b].name, rows)
    context = BuildContext(
        WorkFolder(tmp_path / "work"),
        FeaturesOnALogo(),
        Networks(None, Inference.TORCH),
        Workers(1),
        lambda *_: None,
        open_matches(tmp_path / "given"),
    )
    plain = Verification(4.0, 15, poses_known=False)
    fixed = find_fixed(context, photos, pairs, plain)
    assert fixed.keys() == {"cam"}
    outside = outside_fixed(context, photos, fixed)
    assert outside.features is context.features  # whose rows the matches name
    found, key = match_pairs(outside, photos, pairs, plain)
    assert len(found) == 6
    assert all((pair.rows >= 30).mean() > 0.8 for pair in found)
    assert key != match_pairs(context, photos, pairs, plain)[1]


def test_photos_of_one_camera_each_have_nothing_fixed(tmp_path: Path) -> None:
    networks = Networks(None, Inference.TORCH)
    context = BuildContext(
        WorkFolder(tmp_path), FeaturesOnALogo(), networks, Workers(1), lambda *_: None
    )
    photos = [
        replace(photo, record=replace(photo.record, sensor_id=photo.name))
        for photo in map(make_photo, range(4))
    ]
    pairs = np.array([[a, b] for a in range(4) for b in range(a + 1, 4)])
    assert find_fixed(context, photos, pairs, Verification(4.0, 15, poses_known=False)) == {}
