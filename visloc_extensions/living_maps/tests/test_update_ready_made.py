from __future__ import annotations

import shutil
from pathlib import Path

from tests.mapping.pipeline.test_build_ready_made import KINDS, Build, Rewrite
from visloc.archive import verify_map
from visloc.evaluation import pose_error
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc_extensions.living_maps.updating import UpdateSettings, update_map


def test_a_capture_of_features_alone_joins_a_map_of_such(
    described: Path, tmp_path: Path, build_walk: Build, rewrite: Rewrite
) -> None:
    images = read_dataset(described).images
    for name, odd in (("first", False), ("second", True)):
        shutil.copytree(described, tmp_path / name)
        own = tuple(image for image in images if (image.timestamp // 1000 % 2 == 1) == odd)
        rewrite(tmp_path / name, images=own)
    before = build_walk(tmp_path / "first", tmp_path / "maps", **KINDS)
    settings = UpdateSettings("walk", tmp_path / "second", tmp_path / "maps")
    after = verify_map(update_map(settings, lambda *_: None).folder)

    assert (len(before.images), len(after.images)) == (8, 16)
    assert after.manifest.local_features == before.manifest.local_features
    truth = {image.path: read_dataset(described).pose(image) for image in images}
    for image, row in zip(after.images, after.image_poses, strict=True):
        pose = truth[image.name]
        assert pose is not None
        assert pose_error(Pose.from_quaternion(row[:4], row[4:]), pose)[0] < 0.02
