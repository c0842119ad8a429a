"""Real AP-GeM, fused with a descriptor of our own, by every operator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapping.methods.sfm_settings import SfmSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import Map, open_map
from visloc.evaluation import pose_error
from visloc.geometry import Camera, PixelOrigin, Pose
from visloc.kapture import open_features, open_local_features, read_dataset, read_local
from visloc.localization.localizer import Localizer
from visloc.options import Fusion, LocalizeOptions
from visloc.pose.reprojection import project
from visloc.types import Localized, QueryFeatures

APGEM = "kapture:AP-GeM-LM18"
Asked = list[tuple[QueryFeatures, Camera, Pose]]


@pytest.fixture(scope="module")
def localizer(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Localizer:
    gallery = shared_data / "virtual_gallery"
    settings = BuildSettings(
        gallery / "mapping",
        "gallery",
        tmp_path_factory.mktemp("maps"),
        method="sfm",
        local_features="kapture:r2d2_500",
        global_features=(APGEM, "localvlad"),
        fusion=Fusion.MEAN,
        features_dir=gallery,
        pixel_origin=PixelOrigin.CENTER,
        sfm=SfmSettings(pairs=("distance",)),
    )
    return Localizer(open_map(build_map(settings, lambda *_: None)), None)


@pytest.fixture(scope="module")
def asked(shared_data: Path) -> Asked:
    gallery = shared_data / "virtual_gallery"
    dataset = read_dataset(gallery / "query").with_pixels_from(PixelOrigin.CENTER)
    local = open_local_features(dataset.root, "r2d2_500", gallery)
    vectors = open_features(dataset.root, "global_features", "AP-GeM-LM18", gallery)
    found = []
    for record in dataset.images:
        camera, pose = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        assert camera is not None
        assert pose is not None
        size = camera.width, camera.height
        pixels, rows = read_local(*local, record.path, size, PixelOrigin.CENTER)
        vector = vectors.read(record.path)[0]
        found.append(
            (QueryFeatures("kapture:r2d2_500", pixels, rows, {APGEM: vector}), camera, pose)
        )
    return found


def shared_landmarks(opened: Map, photo: int, camera: Camera, cam_from_world: Pose) -> int:
    """How many landmarks of a mapping photo a query with this pose sees, not twice as large."""
    row = opened.image_poses[photo]
    landmarks = opened.landmarks[np.unique(opened.observations(photo)[0])].astype(np.float64)
    points = landmarks + np.array(opened.manifest.world.origin)
    seen = cam_from_world.apply(points)
    pixels = project(camera, seen)
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(1) & (seen[:, 2] > 0)
    centers = (cam_from_world.center, Pose.from_quaternion(row[:4], row[4:]).center)
    near, far = np.sort([np.linalg.norm(points - center, axis=1) for center in centers], axis=0)
    return int(np.count_nonzero(inside & (far <= 2 * near)))


@pytest.mark.parametrize("fusion", Fusion)
def test_every_operator_finds_photos_that_see_the_same(
    localizer: Localizer, asked: Asked, fusion: Fusion
) -> None:
    options = LocalizeOptions(fusion=fusion, top_k=3)
    names = [image.name for image in localizer.map.images]
    for features, camera, pose in asked:
        answer = localizer.localize_features(features, camera, options)
        assert isinstance(answer, Localized)
        assert np.less(pose_error(answer.cam_from_world, pose), (0.03, 0.4)).all()
        first = answer.evidence.retrieved[0]
        assert list(first.similarities) == [APGEM, "localvlad"]
        assert shared_landmarks(localizer.map, names.index(first.name), camera, pose) >= 30


def test_the_map_s_default_is_what_it_was_built_with(localizer: Localizer, asked: Asked) -> None:
    features, camera, _ = asked[0]
    answer = localizer.localize_features(features, camera, LocalizeOptions())
    for image in answer.evidence.retrieved:
        assert image.score == pytest.approx(np.mean(list(image.similarities.values())))
