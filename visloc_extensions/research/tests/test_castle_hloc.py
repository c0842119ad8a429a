"""castle through hloc's files: the poses of the same features through kapture's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clients.evaluation.queries import Query
from clients.evaluation.readers import FeatureReader
from clients.evaluation.sent_matches import PhotoMatches
from mapping.methods.sfm_settings import SfmSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import open_map
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import PixelOrigin, Pose
from visloc.kapture import Dataset, open_local_features, read_dataset
from visloc.kapture import write_local_features as write_kapture
from visloc.kapture.matches import open_matches
from visloc.localization.localizer import Localizer
from visloc.matching.correspondences import mutual_nearest_neighbours
from visloc.matching.products import round_descriptors
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.types import Localized
from visloc_extensions.research.hloc import import_features

h5py = pytest.importorskip("h5py", reason="h5py is not installed: the extra hloc")


def write_hloc(folder: Path, mapping: Dataset, query: Dataset) -> tuple[list[Path], Path]:
    """Features and matches in hloc's layout, and the same features in kapture's."""
    extractor, rounded = make_local_features("xfeat"), {}
    features, matches = folder / "feats-xfeat.h5", folder / "matches-NN-mutual.h5"
    with h5py.File(features, "w", libver="latest") as file:
        for dataset in (mapping, query):
            for record in dataset.images:
                photo = read_photo_file(dataset.path_of(record))
                local = extractor.extract(photo.rgb, max_keypoints=2000)
                group = file.create_group(record.path)
                group["keypoints"] = local.keypoints - np.float32(0.5)
                group["descriptors"] = local.descriptors.T
                group["scores"] = local.scores
                group["image_size"] = np.array([photo.width, photo.height])
                write_kapture(
                    folder / "kapture",
                    "xf",
                    record.path,
                    local.keypoints,
                    local.descriptors,
                    name="xf",
                )
                rounded[record.path] = round_descriptors(local.descriptors)
    names = [record.path for record in mapping.images]
    with h5py.File(matches, "w", libver="latest") as file:
        for number, first in enumerate(names):
            for second in [*names[number + 1 :], *(record.path for record in query.images)]:
                i, j, _ = mutual_nearest_neighbours(rounded[first], rounded[second])
                partner = np.full(len(rounded[first]), -1, np.int16)
                partner[i] = j
                file[f"{first.replace('/', '-')}/{second.replace('/', '-')}/matches0"] = partner
    return [features, matches], folder / "kapture"


def localized(
    map_folder: Path, features_dir: Path, query: Dataset, matches: Path | None = None
) -> list[Pose]:
    """Localize queries; with matches, by those of all mapping photos, as a client sends them."""
    keypoints, descriptors = open_local_features(features_dir, "xf")
    localizer, poses = Localizer(open_map(map_folder), None), []
    photos = tuple(image.name for image in localizer.map.images)
    options = LocalizeOptions() if matches is None else LocalizeOptions(photos=photos)
    reader = FeatureReader("kapture:xf", keypoints, descriptors, {}, PixelOrigin.CORNER)
    if matches is not None:
        pairs = {record.path: photos for record in query.images}
        reader = replace(reader, matches=PhotoMatches(open_matches(matches), pairs))
    for record in query.images:
        camera = query.sensors[record.sensor_id].camera
        assert camera is not None
        asked = reader(Query(record.path, Path(), camera, None))
        answer = localizer.localize_features(asked, camera, options)
        assert isinstance(answer, Localized)
        poses.append(answer.cam_from_world)
    return poses


def test_castle_is_mapped_and_localized_from_hlocs_files(shared_data: Path, tmp_path: Path) -> None:
    mapping, query = (read_dataset(shared_data / "castle" / name) for name in ("mapping", "query"))
    files, by_kapture = write_hloc(tmp_path, mapping, query)
    imported = tmp_path / "imported"

    assert import_features(files, imported, "xf")[0] == {"local": 30, "pairs": 399}
    matches = imported / "reconstruction" / "matches" / "xf"
    poses = {}
    for name, folder, sfm in (
        ("hloc", imported, SfmSettings(matches_dir=matches)),
        ("kapture", by_kapture, SfmSettings(pairs=("exhaustive",))),
    ):
        settings = BuildSettings(
            *(shared_data / "castle" / "mapping", name, tmp_path / "maps"),
            method="sfm",
            local_features="kapture:xf",
            global_features=("localvlad",),
            features_dir=folder,
            sfm=sfm,
            workers=2,
            force=True,
        )
        built = build_map(settings, lambda stage, done, total: None)  # noqa: ARG005
        poses[name] = localized(built, folder, query)
        if name == "hloc":
            built_by_hloc = built

    by_matches = localized(built_by_hloc, imported, query, matches)
    truth = [query.pose(record) for record in query.images]
    apart = [pose_error(*pair)[0] for pair in zip(*poses.values(), strict=True)]
    errors = {
        name: [pose_error(pose, true)[0] for pose, true in zip(found, truth, strict=True) if true]
        for name, found in poses.items()
    }
    sent = [pose_error(pose, true)[0] for pose, true in zip(by_matches, truth, strict=True) if true]
    assert len(sent) == 9
    assert np.median(sent) < 0.04
    assert len(apart) == 9
    assert max(apart) < 0.01
    assert np.median(errors["hloc"]) < 0.04
    assert np.median(errors["hloc"]) == pytest.approx(np.median(errors["kapture"]), abs=0.005)
