"""hloc's features and matches, written here in its layout, are mapped and localized."""

from __future__ import annotations

import shutil
import tarfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from visloc.archive import Map
from visloc.errors import DatasetError, InvalidInput
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Camera, PixelOrigin, Pose
from visloc.kapture import (
    open_features,
    open_local_features,
    read_dataset,
    read_local,
    write_global_features,
    write_local_features,
)
from visloc.kapture.matches import open_matches, write_matches
from visloc.localization.localizer import Localizer
from visloc.matching.correspondences import mutual_nearest_neighbours
from visloc.matching.products import round_descriptors
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.pose.reprojection import project
from visloc.types import LocalFeatures, Localized, QueryFeatures
from visloc_extensions.research.hloc import import_features

h5py = pytest.importorskip("h5py", reason="h5py is not installed: the extra hloc")

Build = Callable[..., Map]


@dataclass(frozen=True)
class Hloc:
    """The files of an hloc run, and the same features as kapture has them."""

    features: Path
    matches: Path
    kapture: Path


def pair_name(first: str, second: str) -> str:
    return f"{first.replace('/', '-')}/{second.replace('/', '-')}"


@pytest.fixture(scope="module")
def found(walk: Path) -> Mapping[str, LocalFeatures]:
    extractor = make_local_features("sift")
    features = {}
    for folder in ("mapping", "query"):
        dataset = read_dataset(walk / folder)
        for record in dataset.images:
            rgb = read_photo_file(dataset.path_of(record)).rgb
            features[record.path] = extractor.extract(rgb, max_keypoints=500)
    return features


@pytest.fixture(scope="module")
def hloc(
    found: Mapping[str, LocalFeatures],
    sfm_walk: Map,
    tmp_path_factory: pytest.TempPathFactory,
) -> Hloc:
    folder = tmp_path_factory.mktemp("hloc")
    made = Hloc(folder / "feats-sift.h5", folder / "matches.h5", folder / "kapture")
    mapped = [image.name for image in sfm_walk.images]
    vectors = dict(zip(mapped, sfm_walk.global_descriptors["localvlad"], strict=True))
    with h5py.File(made.features, "w", libver="latest") as file:
        for name, local in found.items():
            group = file.create_group(name)
            group["keypoints"] = local.keypoints - np.float32(0.5)
            group["keypoints"].attrs["uncertainty"] = 1.0
            group["descriptors"] = local.descriptors.T
            group["scores"] = local.scores
            group["image_size"] = np.array([256, 192])
            if name in vectors:
                group["global_descriptor"] = vectors[name]
            # As kapture's own tools would have written the same numbers.
            write_local_features(
                made.kapture, "hloc", name, local.keypoints, local.descriptors, name="hloc"
            )
            if name in vectors:
                write_global_features(made.kapture, "hloc", name, vectors[name], name="hloc")
    with h5py.File(made.matches, "w", libver="latest") as file:
        for number, first in enumerate(mapped):
            for second in mapped[number + 1 :]:
                own, theirs = (
                    round_descriptors(found[name].descriptors) for name in (first, second)
                )
                i, j, _ = mutual_nearest_neighbours(own, theirs)
                partner = np.full(len(found[first].keypoints), -1, np.int16)
                partner[i] = j
                # hloc writes each pair once, in the order of its pairs file.
                pair = (second, first) if number % 2 else (first, second)
                if number % 2:
                    partner = np.full(len(found[second].keypoints), -1, np.int16)
                    partner[j] = i
                group = file.create_group(pair_name(*pair))
                group["matches0"] = partner
                group["matching_scores0"] = np.ones(len(partner), np.float16)
    return made


def poses(opened: Map, walk: Path, features_dir: Path) -> list[tuple[Pose, Pose]]:
    """(found, true) of the queries, localized by the features of a folder."""
    keypoints, descriptors = open_local_features(features_dir, "hloc")
    localizer, queries = Localizer(opened, None), read_dataset(walk / "query")
    results = []
    for record in queries.images:
        camera, truth = queries.sensors[record.sensor_id].camera, queries.pose(record)
        assert isinstance(camera, Camera)
        assert truth is not None
        size = camera.width, camera.height
        local = read_local(keypoints, descriptors, record.path, size, PixelOrigin.CORNER)
        vector = opened.global_descriptors["localvlad"]
        assert vector is not None
        asked = QueryFeatures("kapture:hloc", *(np.asarray(each, np.float32) for each in local), {})
        answer = localizer.localize_features(asked, camera, LocalizeOptions())
        assert isinstance(answer, Localized)
        results.append((answer.cam_from_world, truth))
    return results


@pytest.mark.slow
def test_hlocs_files_become_the_map_and_the_poses_of_the_same_features(
    hloc: Hloc, walk: Path, tmp_path: Path, build_walk: Build
) -> None:
    imported = tmp_path / "imported"

    written, notes = import_features([hloc.matches, hloc.features], imported, "hloc")

    assert written == {"local": 21, "global": 16, "pairs": 120}
    assert notes == ["arrays that are not read, and how often: scores (21), image_size (21)"]
    settings: dict[str, Any] = {"local_features": "kapture:hloc"}
    by_kapture = build_walk(
        *(walk / "mapping", tmp_path / "by_kapture"),
        **settings,
        features_dir=hloc.kapture,
        sfm=_sfm(pairs=("exhaustive",)),
    )
    by_hloc = build_walk(
        *(walk / "mapping", tmp_path / "by_hloc"),
        **settings,
        features_dir=imported,
        sfm=_sfm(matches_dir=imported / "reconstruction" / "matches" / "hloc"),
    )
    # The same features and matches: the same map.
    assert len(by_hloc.landmarks) == len(by_kapture.landmarks) > 500
    np.testing.assert_allclose(by_hloc.landmarks, by_kapture.landmarks, atol=1e-3)
    for (one, truth), (other, _) in zip(
        poses(by_hloc, walk, imported), poses(by_kapture, walk, hloc.kapture), strict=True
    ):
        assert pose_error(one, other)[0] < 0.005
        assert pose_error(one, truth)[0] < 0.05
    assert by_hloc.manifest.method.settings["matches"] == "given"


def test_the_numbers_come_through(
    hloc: Hloc, tmp_path: Path, found: Mapping[str, LocalFeatures], sfm_walk: Map
) -> None:
    import_features([hloc.features, hloc.matches], tmp_path, "mine")

    keypoints, descriptors = open_local_features(tmp_path, "mine")
    name = sfm_walk.images[0].name
    np.testing.assert_allclose(keypoints.read(name), found[name].keypoints, atol=1e-4)
    np.testing.assert_array_equal(descriptors.read(name), found[name].descriptors)
    vector = open_features(tmp_path, "global_features", "mine").read(name)[0]
    np.testing.assert_array_equal(vector, sfm_walk.global_descriptors["localvlad"][0])


def _sfm(**changes: Any) -> Any:
    from mapping.methods.sfm_settings import SfmSettings

    return SfmSettings(**changes)


def test_matches_need_the_keypoints_that_they_are_of(
    walk: Path, tmp_path: Path, build_walk: Build
) -> None:
    write_matches(tmp_path / "matches", "a.jpg", "b.jpg", np.array([[0, 1]]))
    with pytest.raises(InvalidInput) as caught:
        build_walk(walk / "mapping", tmp_path / "maps", sfm=_sfm(matches_dir=tmp_path / "matches"))
    assert caught.value.code == "sfm.matches"


@pytest.mark.slow
def test_landmarks_of_matches_keep_their_keypoints_where_something_is_fixed_to_the_picture(
    walk: Path, tmp_path: Path, build_walk: Build
) -> None:
    folder, made = tmp_path / "walk", tmp_path / "features"
    shutil.copytree(walk / "mapping", folder)
    dataset, extractor = read_dataset(folder), make_local_features("sift")
    logo = (
        np.random.default_rng(0).integers(0, 256, (10, 16, 3), np.uint8).repeat(5, 0).repeat(5, 1)
    )
    found = {}
    for record in dataset.images:
        picture = read_photo_file(dataset.path_of(record)).rgb.copy()
        picture[:50, :80] = logo
        cv2.imwrite(str(dataset.path_of(record)), picture[..., ::-1])
        found[record.path] = local = extractor.extract(picture, max_keypoints=800)
        write_local_features(
            made, "mine", record.path, local.keypoints, local.descriptors, name="mine"
        )
    for first, second in combinations(sorted(found), 2):
        looks = (round_descriptors(found[name].descriptors) for name in (first, second))
        i, j, _ = mutual_nearest_neighbours(*looks)
        write_matches(made / "matches", first, second, np.column_stack([i, j]))

    opened = build_walk(
        *(folder, tmp_path / "maps"),
        local_features="kapture:mine",
        features_dir=made,
        sfm=_sfm(matches_dir=made / "matches"),
    )

    assert any("keeps its pixels" in note for note in opened.manifest.notes)
    assert len(opened.landmarks) > 500
    for row, image in enumerate(opened.images):
        pose = Pose.from_quaternion(opened.image_poses[row][:4], opened.image_poses[row][4:])
        seen = opened.landmarks[opened.observations(row)[0]] + opened.manifest.world.origin
        pixels = project(opened.cameras[image.camera], pose.apply(seen))
        keypoints = opened.keypoints(row)
        assert np.linalg.norm(pixels - keypoints, axis=1).max() < 6
        assert not ((keypoints < (80, 50)).all(axis=1)).any()


def test_matches_are_found_in_either_order_and_in_a_tar(tmp_path: Path) -> None:
    rows = np.array([[5, 7], [2, 9]])
    write_matches(tmp_path / "loose", "z/b.jpg", "a c.jpg", rows)
    (path,) = (tmp_path / "loose").rglob("*.matches")
    assert path.relative_to(tmp_path / "loose").as_posix() == "a c.jpg.overlapping/z/b.jpg.matches"
    (tmp_path / "tarred").mkdir()
    with tarfile.open(tmp_path / "tarred" / "matches.tar", "w") as tar:
        tar.add(path, "./a c.jpg.overlapping/z/b.jpg.matches")
    for folder in ("loose", "tarred"):
        matches = open_matches(tmp_path / folder)
        assert list(matches.pairs()) == [("a c.jpg", "z/b.jpg")]
        assert sorted(matches.read("z/b.jpg", "a c.jpg").tolist()) == [[2, 9], [5, 7]]
        assert matches.read("a c.jpg", "z/b.jpg").tolist() == [[7, 5], [9, 2]]
        assert matches.read("a c.jpg", "other.jpg") is None


@pytest.mark.parametrize(
    ("row", "code"),
    [
        ([-1.0, 0.0, 1.0], "kapture.match_values"),
        ([0.5, 0.0, 1.0], "kapture.match_values"),
        ([np.nan, 0.0, 1.0], "kapture.match_values"),
        ([1e30, 0.0, 1.0], "kapture.match_values"),
        ([1.0, 0.0], "kapture.feature_size"),
    ],
)
def test_bad_matches_are_refused_with_their_file(
    tmp_path: Path, row: list[float], code: str
) -> None:
    path = tmp_path / "a.jpg.overlapping" / "b.jpg.matches"
    path.parent.mkdir()
    path.write_bytes(np.array(row, "<f8").tobytes())
    with pytest.raises(DatasetError) as caught:
        open_matches(tmp_path).read("a.jpg", "b.jpg")
    assert caught.value.code == code
    assert caught.value.field == str(path)


def test_a_folder_without_matches_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        open_matches(tmp_path)
    assert caught.value.code == "kapture.no_matches"


def _photo(file: Any, name: str, **changes: Any) -> None:
    values = {"keypoints": np.ones((3, 2)), "descriptors": np.eye(4)[:, :3]} | changes
    for key, value in values.items():
        file[f"{name}/{key}"] = value


BAD: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"keypoints": np.ones((3, 3))}, {}, "hloc.group"),
    ({"keypoints": np.ones(3)}, {}, "hloc.group"),
    ({"keypoints": np.full((3, 2), np.nan)}, {}, "hloc.group"),
    ({"keypoints": np.array([[b"a", b"b"]] * 3)}, {}, "hloc.group"),
    ({"keypoints": np.full((3, 2), 1e300)}, {}, "hloc.group"),
    ({"keypoints": h5py.Empty("f4")}, {}, "hloc.group"),
    ({"descriptors": np.eye(4)}, {}, "hloc.group"),
    ({}, {"a.jpg/b-1.jpg/matches0": np.array([0, 1])}, "hloc.group"),
    ({}, {"a.jpg/b-1.jpg/matches0": np.array([0.0, 1, 2])}, "hloc.group"),
    ({}, {"a.jpg/b-1.jpg/matches0": np.array([0, 1, 3])}, "hloc.group"),
    ({}, {"a.jpg/b-1.jpg/matches0": np.array([0, 1, -2])}, "hloc.group"),
    ({}, {"a.jpg/c.jpg/matches0": np.array([0, 1, 2])}, "hloc.pair"),
    ({}, {"a.jpg_b-1.jpg/matches0": np.array([0, 1, 2])}, "hloc.pair"),
    (
        {},
        {"b-1.jpg/keypoints": np.ones((1, 2)), "a.jpg/b-1.jpg/matches0": np.array([0, 1, 2])},
        "hloc.pair",
    ),
]


def test_features_alone_need_no_names_of_pairs(tmp_path: Path) -> None:
    path = tmp_path / "features.h5"
    with h5py.File(path, "w") as file:
        _photo(file, "db/1.jpg", scores=np.ones(3))
        _photo(file, "db-1.jpg", own=np.ones(1), scores=np.ones(3))
        file["c.jpg/descriptors"] = np.ones((4, 3))
    written, notes = import_features([path], tmp_path / "out", "hloc")
    assert written == {"local": 2}
    assert notes == [
        "arrays that are not read, and how often: scores (2), descriptors (1), own (1)"
    ]
    assert import_features([path, path], tmp_path / "out2", "hloc")[0] == {"local": 2}


@pytest.mark.parametrize(("photo", "more", "code"), BAD)
def test_bad_groups_are_refused_by_name(
    tmp_path: Path, photo: dict[str, Any], more: dict[str, Any], code: str
) -> None:
    path = tmp_path / "bad.h5"
    with h5py.File(path, "w") as file:
        _photo(file, "a.jpg", **photo)
        _photo(file, "b/1.jpg")
        for key, value in more.items():
            file[key] = value
    with pytest.raises(DatasetError) as caught:
        import_features([path], tmp_path / "out", "hloc")
    assert caught.value.code == code


def test_arrays_of_other_files_are_not_read(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(np.ones((3, 2)).tobytes())
    path = tmp_path / "bad.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("a.jpg")
        group.create_dataset("keypoints", (3, 2), "f8", external=[(str(secret), 0, 48)])
        file["link.jpg"] = h5py.ExternalLink("other.h5", "/a.jpg")
    linked = tmp_path / "linked.h5"
    with h5py.File(tmp_path / "other.h5", "w") as file:
        _photo(file, "b.jpg")
    with h5py.File(linked, "w") as file:
        group = file.create_group("a.jpg")
        group["scores"] = np.ones(3)
        group["keypoints"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/b.jpg/keypoints")
    for each in (path, linked):
        with pytest.raises(DatasetError) as caught:
            import_features([each], tmp_path / "out", "hloc")
        assert caught.value.code == "hloc.group"


def test_a_group_in_the_place_of_an_array_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.h5"
    with h5py.File(path, "w") as file:
        file["a.jpg/keypoints/inner"] = 1
        file["a.jpg/scores"] = np.ones(3)
    with pytest.raises(DatasetError) as caught:
        import_features([path], tmp_path / "out", "hloc")
    assert caught.value.code == "hloc.group"


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("no HDF5")
    with h5py.File(tmp_path / "empty.h5", "w") as file:
        file["a/unknown"] = 1
    for name, code in (("text.h5", "unreadable"), ("no.h5", "unreadable"), ("empty.h5", "nothing")):
        with pytest.raises(DatasetError) as caught:
            import_features([tmp_path / name], tmp_path / "out", "hloc")
        assert caught.value.code == f"hloc.{code}"
