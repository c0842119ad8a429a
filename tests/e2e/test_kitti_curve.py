"""A stereo rig on real photos: kitti_curve, a bend, ground truth to centimetres."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import open_map
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.solving import SeenImage
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file

pytestmark = pytest.mark.slow  # building and looking take minutes


@pytest.fixture(scope="module")
def errors(
    shared_data: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, list[tuple[float, float]]]:
    """Of every photo: alone, and by the pose of the whole rig; metres and degrees."""
    kitti = shared_data / "kitti_curve"
    settings = BuildSettings(
        kitti / "mapping", "kitti", tmp_path_factory.mktemp("maps"), method="sfm", workers=2
    )
    folder = build_map(settings, lambda stage, done, total: None)  # noqa: ARG005
    localizer = Localizer(open_map(folder), make_local_features("xfeat"))
    queries = read_dataset(kitti / "query")
    rig = localizer.map.rigs["rig"]
    instants = defaultdict(list)
    for record in queries.images:
        camera = queries.sensors[record.sensor_id].camera
        look = localizer.look(read_photo_file(queries.path_of(record)), camera, LocalizeOptions())
        instants[record.timestamp].append((record, look))
    found: dict[str, list[tuple[float, float]]] = {"single": [], "gp3p": []}
    for seen in instants.values():
        images = [SeenImage(r.sensor_id, rig[r.sensor_id], look) for r, look in seen]
        together = localizer.solve(images, LocalizeOptions()).answer.pose
        for record, look in seen:
            truth = queries.pose(record)
            assert truth is not None
            alone = [SeenImage(record.sensor_id, Pose.identity(), look)]
            pose = localizer.solve(alone, LocalizeOptions()).answer.pose
            if pose is not None:
                found["single"].append(pose_error(pose.rig_from_world, truth))
            if together is not None:
                by_rig = rig[record.sensor_id] @ together.rig_from_world
                found["gp3p"].append(pose_error(by_rig, truth))
    return found


def test_every_photo_is_localized_to_centimetres(
    errors: dict[str, list[tuple[float, float]]],
) -> None:
    assert len(errors["single"]) == len(errors["gp3p"]) == 50
    assert (np.median(errors["single"], axis=0) < [0.015, 0.09]).all()
    assert (np.median(errors["gp3p"], axis=0) < [0.009, 0.04]).all()


@pytest.mark.parametrize("percent", [50, 75, 90, 100])
def test_a_rig_is_never_worse_than_its_cameras(
    errors: dict[str, list[tuple[float, float]]], percent: int
) -> None:
    single, gp3p = (np.percentile(errors[mode], percent, axis=0) for mode in ("single", "gp3p"))
    assert (gp3p <= single).all()
