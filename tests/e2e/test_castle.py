"""Triangulated landmarks on real photos: castle-P30, ground truth to about a centimetre."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapping.methods.sfm_settings import SfmSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import open_map
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.types import Answer, Localized


@pytest.fixture(scope="module")
def localizer(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Localizer:
    settings = BuildSettings(
        shared_data / "castle" / "mapping",
        "castle",
        tmp_path_factory.mktemp("maps"),
        method="sfm",
        sfm=SfmSettings(pairs=("distance",)),
        workers=2,
    )
    folder = build_map(settings, lambda stage, done, total: None)  # noqa: ARG005
    return Localizer(open_map(folder), make_local_features("xfeat"))


def answers(localizer: Localizer, dataset: Path, every: int) -> list[tuple[Answer, float]]:
    """Answers and, where localized, position errors in metres."""
    queries, found = read_dataset(dataset), []
    for record in queries.images[::every]:
        photo = read_photo_file(queries.path_of(record))
        answer = localizer.localize(
            photo, queries.sensors[record.sensor_id].camera, LocalizeOptions()
        )
        truth = queries.pose(record)
        assert truth is not None
        error = np.nan
        if isinstance(answer, Localized):
            error = pose_error(answer.cam_from_world, truth)[0]
        found.append((answer, error))
    return found


def test_all_queries_are_localized_to_centimetres(localizer: Localizer, shared_data: Path) -> None:
    errors = [error for _, error in answers(localizer, shared_data / "castle" / "query", 1)]
    assert np.median(errors) < 0.04
    assert max(errors) < 0.25


def test_photos_of_another_place_get_no_pose(localizer: Localizer, shared_data: Path) -> None:
    for answer, _ in answers(localizer, shared_data / "redkitchen" / "query", 8):
        assert not isinstance(answer, Localized)
        assert answer.evidence.inlier_ratio < 0.03
