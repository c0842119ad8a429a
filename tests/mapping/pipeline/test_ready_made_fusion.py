"""Real AP-GeM, fused with a descriptor of our own, by every operator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.retrieval import shared_landmarks
from mapping.methods.sfm_settings import SfmSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import open_map
from visloc.evaluation import pose_error
from visloc.geometry import Camera, PixelOrigin, Pose
from visloc.kapture import open_features, open_local_features, read_dataset, read_local
from visloc.localization.localizer import Localizer
from visloc.options import Fusion, LocalizeOptions
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
        assert shared_landmarks(localizer.map, camera, pose)[names.index(first.name)] >= 30


def test_the_map_s_default_is_what_it_was_built_with(localizer: Localizer, asked: Asked) -> None:
    features, camera, _ = asked[0]
    answer = localizer.localize_features(features, camera, LocalizeOptions())
    for image in answer.evidence.retrieved:
        assert image.score == pytest.approx(np.mean(list(image.similarities.values())))
