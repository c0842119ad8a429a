"""A painted room, one of its shape with other pictures, and a second walk through the first."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from mapping.methods.matching.stages import Matches
from mapping.methods.matching.two_views import fits_two_views
from mapping.methods.sparse.look_alikes import without_look_alikes
from mapping.methods.sparse.model import MAPPER_CONFIGS, SfmPhoto
from mapping.methods.sparse.triangulation import reconstruct
from samples.render import render_photo
from samples.scene import Scene, make_room
from samples.trajectories import mapping_trajectory, query_trajectory, stereo_rig
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.matching.correspondences import mutual_nearest_neighbours
from visloc.matching.products import round_descriptors
from visloc.options import Inference
from visloc.types import LocalFeatures

RIG_CAMERA = stereo_rig(256, 192)["left"]
CAMERA = RIG_CAMERA.camera
CONFIG = MAPPER_CONFIGS["config1"]
PHOTOS_EACH = 8


def photographed(scene: Scene, rig_from_world: Sequence[Pose]) -> list[LocalFeatures]:
    # In 32 bits, which every machine has: in 8 bits it finds other keypoints.
    extractor = make_local_features("xfeat", inference=Inference.FP32, threads=1)
    return [
        extractor.extract(
            render_photo(scene, CAMERA, RIG_CAMERA.cam_from_rig @ pose), max_keypoints=800
        )
        for pose in rig_from_world
    ]


@pytest.fixture(scope="module")
def first() -> list[LocalFeatures]:
    return photographed(make_room(0), mapping_trajectory(PHOTOS_EACH))


def a_way_back(yaw_deg: float = 0.0) -> list[Pose]:
    """Up to 25 cm beside the first walk, in the other direction, looking elsewhere."""
    cos, sin = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    turn = Pose(np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]), np.zeros(3))
    return [turn @ pose for pose in query_trajectory(PHOTOS_EACH, PHOTOS_EACH)[::-1]]


def matched(features: Sequence[LocalFeatures]) -> tuple[list[SfmPhoto], list[Matches]]:
    """Photos of two walks, each with a camera of its own, and all pairs with verified matches."""
    photos = [
        SfmPhoto(f"{n}.jpg", f"walk {n // PHOTOS_EACH}", n, CAMERA, True, None, each.keypoints)
        for n, each in enumerate(features)
    ]
    descriptors = [round_descriptors(each.descriptors) for each in features]
    matches = []
    for a, b in combinations(range(len(photos)), 2):
        i, j, _ = mutual_nearest_neighbours(descriptors[a], descriptors[b])
        rows = np.column_stack([i, j]).astype(np.uint32)
        fits = fits_two_views(
            (CAMERA, CAMERA),
            photos[a].keypoints[i],
            photos[b].keypoints[j],
            CONFIG.filter_max_reproj_error,
            calibrated=True,
        )
        if fits.sum() >= CONFIG.min_num_matches:
            matches.append(Matches(a, b, rows[fits]))
    return photos, matches


def is_across(pair: Matches) -> bool:
    return pair.first < PHOTOS_EACH <= pair.second


@pytest.mark.parametrize("yaw_deg", [0.0, 20.0])
def test_a_second_walk_through_the_room_joins_the_first(
    first: list[LocalFeatures], yaw_deg: float, tmp_path: Path
) -> None:
    second = photographed(make_room(0), a_way_back(yaw_deg))
    photos, matches = matched([*first, *second])
    model = reconstruct(photos, {}, matches, CONFIG, (), tmp_path, lambda *_: None)
    assert all(model.views)


@pytest.mark.parametrize("seed", [1, 2])
def test_no_pair_joins_a_room_of_one_design_with_other_pictures(
    first: list[LocalFeatures], seed: int
) -> None:
    # One pair of either room lacks nothing: only its neighbours in time give it away.
    like = photographed(make_room(seed), a_way_back())
    photos, matches = matched([*first, *like])
    # There is something to tell apart.
    across = [pair for pair in matches if is_across(pair)]
    assert max(len(pair.rows) for pair in across) >= CONFIG.abs_pose_min_num_inliers
    assert not any(is_across(pair) for pair in without_look_alikes(photos, matches))
