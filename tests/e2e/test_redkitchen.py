"""Real photos: a Kinect in a kitchen, and a courtyard that is not in it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import open_map
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.kapture import Dataset, read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo, read_photo_file
from visloc.types import Localized, NotLocalized

OPTIONS = LocalizeOptions()


@pytest.fixture(scope="module")
def localizer(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Localizer:
    """The map of the kitchen with the default features."""
    maps = tmp_path_factory.mktemp("maps")
    settings = BuildSettings(shared_data / "redkitchen" / "mapping", "redkitchen", maps)
    folder = build_map(settings, lambda *_: None)
    return Localizer(open_map(folder), make_local_features(settings.local_features))


@pytest.fixture(scope="module")
def kitchen(shared_data: Path) -> Dataset:
    return read_dataset(shared_data / "redkitchen" / "query")


@pytest.fixture(scope="module")
def castle(shared_data: Path) -> Dataset:
    return read_dataset(shared_data / "castle" / "query")


def shrunk(rgb: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    size = (width, round(rgb.shape[0] * width / rgb.shape[1]))
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def test_the_kitchen_is_localized_to_centimetres(localizer: Localizer, kitchen: Dataset) -> None:
    # The true poses are themselves good to a few centimetres and about a degree.
    errors = []
    for record in kitchen.images:
        camera = kitchen.sensors[record.sensor_id].camera
        truth = kitchen.pose(record)
        assert truth is not None
        answer = localizer.localize(read_photo_file(kitchen.path_of(record)), camera, OPTIONS)
        if isinstance(answer, Localized):
            errors.append(pose_error(answer.cam_from_world, truth))
    position_m, orientation_deg = np.array(errors).T
    assert len(kitchen.images) == 39
    assert len(errors) >= 38
    assert ((position_m < 0.05) & (orientation_deg < 5)).sum() >= 30
    assert np.median(position_m) < 0.027
    assert np.median(orientation_deg) < 1.1


@pytest.mark.parametrize(
    "width",
    [pytest.param(None, marks=pytest.mark.slow, id="as it is"), pytest.param(256, id="256 px")],
)
def test_the_courtyard_is_refused(localizer: Localizer, castle: Dataset, width: int | None) -> None:
    inliers = []
    for record in castle.images:
        photo = read_photo_file(castle.path_of(record))
        camera = castle.sensors[record.sensor_id].camera
        if width is not None:
            photo = Photo(shrunk(photo.rgb, width))
        answer = localizer.localize(photo, camera, OPTIONS)
        assert isinstance(answer, NotLocalized), answer
        assert answer.stage in ("matching", "gate")
        inliers.append(answer.evidence.inlier_ratio)
    # The gate asks for 5 %.
    assert max(inliers) < 0.045


def test_a_small_photo_of_the_kitchen_is_still_localized(
    localizer: Localizer, kitchen: Dataset
) -> None:
    for record in kitchen.images[::8]:
        small = Photo(shrunk(read_photo_file(kitchen.path_of(record)).rgb, 320))
        answer = localizer.localize(small, kitchen.sensors[record.sensor_id].camera, OPTIONS)
        truth = kitchen.pose(record)
        assert truth is not None
        assert isinstance(answer, Localized)
        assert pose_error(answer.cam_from_world, truth)[0] < 0.1
