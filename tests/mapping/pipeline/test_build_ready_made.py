from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping.methods.sfm_settings import SfmSettings
from visloc.archive import Map, MapStore
from visloc.errors import DatasetError, InvalidInput, VislocError
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Camera, PixelOrigin
from visloc.kapture import (
    open_features,
    open_local_features,
    read_dataset,
    read_local,
    write_global_features,
    write_local_features,
)
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.types import LocalFeatures, Localized, QueryFeatures

Build = Callable[..., Map]
Rewrite = Callable[..., None]
TYPE, GLOBAL = "my_SIFT.v2", "my_vlad"
KINDS = {"local_features": f"kapture:{TYPE}", "global_features": (f"kapture:{GLOBAL}",)}
FIRST = "mapping/left/0001.jpg"


@pytest.fixture(scope="module")
def found(walk: Path) -> Mapping[str, LocalFeatures]:
    """Our own features of all photos, by name."""
    extractor = make_local_features("sift")
    features = {}
    for folder in ("mapping", "query"):
        dataset = read_dataset(walk / folder)
        for record in dataset.images:
            rgb = read_photo_file(dataset.path_of(record)).rgb
            features[record.path] = extractor.extract(rgb, max_keypoints=500)
    return features


@pytest.fixture(scope="module")
def described(walk: Path, found: Mapping[str, LocalFeatures], sfm_walk: Map) -> Path:
    """The mapping dataset with features and without any photo; only to be read."""
    folder = walk / "described"
    (folder / "sensors").mkdir(parents=True)
    for path in (walk / "mapping" / "sensors").glob("*.txt"):
        shutil.copy(path, folder / "sensors")
    names = [image.name for image in sfm_walk.images]
    for name, row in zip(names, sfm_walk.global_descriptors["localvlad"], strict=True):
        # Rows of other lengths than one are compared by direction.
        write_local_features(
            folder, TYPE, name, found[name].keypoints, 3 * found[name].descriptors, name="SIFT"
        )
        write_global_features(folder, GLOBAL, name, 5 * row, name="VLAD")
    return folder


@pytest.fixture
def described_copy(described: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(described, tmp_path / "dataset"))


def file_of(dataset: Path, kind: str, name: str = "") -> Path:
    """A features file of the first photo, or the file that says of what kind they are."""
    suffix = {"keypoints": ".kpt", "descriptors": ".desc", "global_features": ".gfeat"}[kind]
    feature_type = GLOBAL if kind == "global_features" else TYPE
    return dataset / "reconstruction" / kind / feature_type / (name or FIRST + suffix)


def test_a_map_is_made_of_features_alone_and_is_that_of_the_photos(
    described: Path, tmp_path: Path, sfm_walk: Map, build_walk: Build
) -> None:
    built = build_walk(described, tmp_path, **KINDS)
    assert not (described / "sensors" / "records_data").exists()
    local = built.manifest.local_features
    assert local.fingerprint.name == f"kapture:{TYPE}"
    assert local.fingerprint.parameters["method"] == "SIFT"
    assert (local.max_keypoints, local.descriptor_dim) == (20_000, 128)
    assert list(built.global_descriptors) == [f"kapture:{GLOBAL}"]
    np.testing.assert_allclose(
        built.global_descriptors[f"kapture:{GLOBAL}"],
        sfm_walk.global_descriptors["localvlad"],
        atol=1e-6,
    )
    assert np.array_equal(built.landmarks, sfm_walk.landmarks)
    assert np.array_equal(built.observation_landmarks, sfm_walk.observation_landmarks)
    off_by = built.observation_descriptors.astype(int) - sfm_walk.observation_descriptors
    assert np.abs(off_by).max() <= 1
    assert any("16 files do not exist" in note for note in built.manifest.notes)


def query_of(
    walk: Path, found: Mapping[str, LocalFeatures], row: int
) -> tuple[QueryFeatures, Camera, object]:
    dataset = read_dataset(walk / "query")
    record = dataset.images[row]
    local, camera = found[record.path], dataset.sensors[record.sensor_id].camera
    assert camera is not None
    features = QueryFeatures(f"kapture:{TYPE}", local.keypoints, local.descriptors, {})
    return features, camera, dataset.pose(record)


def test_features_are_localized_in_a_map_of_features(
    walk: Path,
    described: Path,
    tmp_path: Path,
    found: Mapping[str, LocalFeatures],
    build_walk: Build,
) -> None:
    built = build_walk(described, tmp_path, **KINDS | {"global_features": ("localvlad",)})
    localizer = Localizer(built, None)
    localizer.warm_up()
    for row in range(5):
        features, camera, truth = query_of(walk, found, row)
        answer = localizer.localize_features(features, camera, LocalizeOptions())
        assert isinstance(answer, Localized)
        assert pose_error(answer.cam_from_world, truth)[0] < 0.01  # type: ignore[arg-type]
    photo = read_photo_file(next((walk / "query").rglob("*.jpg")))
    with pytest.raises(InvalidInput) as caught:
        localizer.localize(photo, camera, LocalizeOptions())
    assert caught.value.code == "features.required"


def test_depth_and_features_make_a_map_without_photos(
    walk: Path, described_copy: Path, tmp_path: Path, rgbd_walk: Map, build_walk: Build
) -> None:
    for path in (walk / "mapping" / "sensors" / "records_data").rglob("*.depth"):
        name = path.relative_to(walk / "mapping")
        (described_copy / name).parent.mkdir(parents=True, exist_ok=True)
        (described_copy / name).symlink_to(path)
    built = build_walk(described_copy, tmp_path / "maps", method="rgbd", **KINDS)
    assert np.array_equal(built.landmarks, rgbd_walk.landmarks)


@pytest.mark.slow
def test_features_can_lie_elsewhere(
    described_copy: Path, tmp_path: Path, build_walk: Build
) -> None:
    inside = build_walk(described_copy, tmp_path / "maps", **KINDS)
    features = tmp_path / "features"
    for kind in ("keypoints", "descriptors"):
        shutil.move(
            described_copy / "reconstruction" / kind / TYPE,
            features / "local_features" / TYPE / kind,
        )
    shutil.move(
        described_copy / "reconstruction" / "global_features" / GLOBAL,
        features / "global_features" / GLOBAL / "global_features",
    )
    with pytest.raises(DatasetError) as caught:
        build_walk(described_copy, tmp_path / "maps", **KINDS)
    assert caught.value.code == "kapture.no_features"
    outside = build_walk(described_copy, tmp_path / "maps", features_dir=features, **KINDS)
    assert outside.manifest.content_hash == inside.manifest.content_hash


def test_pixels_that_count_from_the_centre_make_the_same_map(
    described_copy: Path, tmp_path: Path, build_walk: Build, rewrite: Rewrite
) -> None:
    corner = build_walk(described_copy, tmp_path / "maps", **KINDS)
    dataset = read_dataset(described_copy)
    sensors = {}
    for name, sensor in dataset.sensors.items():
        camera = sensor.camera
        if camera is not None:
            fx, fy, cx, cy = camera.params
            camera = replace(camera, params=(fx, fy, cx - 0.5, cy - 0.5))
            sensor = type(sensor).with_camera(name, camera, sensor.kind)
        sensors[name] = sensor
    rewrite(described_copy, sensors=sensors)
    for path in file_of(described_copy, "keypoints", "x").parent.rglob("*.kpt"):
        (np.fromfile(path, "<f4") - np.float32(0.5)).tofile(path)
    center = build_walk(described_copy, tmp_path / "maps", pixel_origin=PixelOrigin.CENTER, **KINDS)
    # float32 loses a bit of a keypoint near the edge when half a pixel is taken away, which may
    # round it to the next step
    np.testing.assert_allclose(center.observation_keypoints, corner.observation_keypoints, atol=1)
    np.testing.assert_allclose(center.landmarks, corner.landmarks, atol=1e-4)
    assert [c.params for c in center.cameras.values()] == [
        pytest.approx(c.params, abs=1e-12) for c in corner.cameras.values()
    ]


Damage = Callable[[Path], None]


def drop_a_descriptor(dataset: Path) -> None:
    path = file_of(dataset, "descriptors")
    path.write_bytes(path.read_bytes()[: -128 * 4])


def cut_descriptors(dataset: Path) -> None:
    path = file_of(dataset, "descriptors")
    path.write_bytes(path.read_bytes()[:-1])


def say(kind: str, before: str, after: str) -> Damage:
    def change(dataset: Path) -> None:
        path = file_of(dataset, kind, f"{kind}.txt")
        text = path.read_text()
        assert before in text
        path.write_text(text.replace(before, after))

    return change


def store_doubles(dataset: Path) -> None:
    for path in file_of(dataset, "keypoints", "x").parent.rglob("*.kpt"):
        np.fromfile(path, "<f4").astype("<f8").tofile(path)


def blank_a_descriptor(dataset: Path) -> None:
    rows = np.fromfile(file_of(dataset, "descriptors"), "<f4")
    rows[128:256] = 0
    rows.tofile(file_of(dataset, "descriptors"))


def not_a_number(dataset: Path) -> None:
    rows = np.fromfile(file_of(dataset, "keypoints"), "<f4")
    rows[3] = np.nan
    rows.tofile(file_of(dataset, "keypoints"))


def blank_a_global_descriptor(dataset: Path) -> None:
    path = file_of(dataset, "global_features")
    path.write_bytes(bytes(path.stat().st_size))


def remove(kind: str) -> Damage:
    return lambda dataset: file_of(dataset, kind).unlink()


@pytest.mark.parametrize(
    ("damage", "code", "named"),
    [
        (drop_a_descriptor, "kapture.feature_count", FIRST),
        (cut_descriptors, "kapture.feature_size", f"{FIRST}.desc"),
        (say("keypoints", "float32", "float64"), "kapture.feature_count", f"{FIRST}.kpt"),
        (store_doubles, "kapture.feature_count", f"{FIRST}.kpt"),
        (say("descriptors", "float32", "float16"), "kapture.dtype", "descriptors.txt:3"),
        (say("descriptors", "L2", "hamming"), "features.metric", "descriptors.txt"),
        (say("keypoints", ", 2", ", 0"), "kapture.dsize", "keypoints.txt:3"),
        (not_a_number, "kapture.feature_values", f"{FIRST}.kpt"),
        (blank_a_descriptor, "features.descriptor", FIRST),
        (blank_a_global_descriptor, "features.descriptor", FIRST),
        (remove("global_features"), "kapture.feature_missing", f"{FIRST}.gfeat"),
    ],
)
def test_wrong_features_are_refused_by_name_and_the_map_before_still_serves(
    described_copy: Path,
    tmp_path: Path,
    sfm_walk: Map,
    build_walk: Build,
    damage: Damage,
    code: str,
    named: str,
) -> None:
    maps_dir = tmp_path / "maps"
    shutil.copytree(sfm_walk.path.parent, maps_dir / "walk")
    damage(described_copy)
    with pytest.raises(VislocError) as caught:
        build_walk(described_copy, maps_dir, **KINDS)
    assert caught.value.code == code
    assert named in str(caught.value)
    assert sorted(path.name for path in (maps_dir / "walk").iterdir()) == sorted(
        ["current", sfm_walk.path.name]
    )
    assert MapStore(maps_dir).open("walk").manifest == sfm_walk.manifest


def test_photos_without_features_are_left_out_and_told(
    described_copy: Path, tmp_path: Path, build_walk: Build
) -> None:
    file_of(described_copy, "keypoints").unlink()
    built = build_walk(described_copy, tmp_path / "maps", **KINDS)
    assert built.manifest.counts.images == 15
    assert f"1 of 16 photos have no ready-made features: {FIRST}" in built.manifest.notes


def test_a_descriptor_of_photos_is_refused_with_ready_made_local_features(
    described: Path, tmp_path: Path, build_walk: Build
) -> None:
    with pytest.raises(InvalidInput, match="densevlad is computed from the photo") as caught:
        build_walk(described, tmp_path, **KINDS | {"global_features": ("densevlad",)})
    assert caught.value.field == "--global-features"


def test_a_published_dataset_is_mapped_and_queried_by_its_own_features(
    shared_data: Path, tmp_path: Path, build_walk: Build
) -> None:
    gallery = shared_data / "virtual_gallery"
    kinds = {
        "local_features": "kapture:r2d2_500",
        "global_features": ("kapture:AP-GeM-LM18",),
    }
    built = build_walk(
        gallery / "mapping",
        tmp_path,
        features_dir=gallery,
        pixel_origin=PixelOrigin.CENTER,
        sfm=SfmSettings(pairs=("distance",)),
        **kinds,
    )
    localizer = Localizer(built, None)
    dataset = read_dataset(gallery / "query").with_pixels_from(PixelOrigin.CENTER)
    keypoints, descriptors = open_local_features(dataset.root, "r2d2_500", gallery)
    vectors = open_features(dataset.root, "global_features", "AP-GeM-LM18", gallery)
    errors = []
    for record in dataset.images:
        camera, truth = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        assert camera is not None
        assert truth is not None
        pixels, rows = read_local(
            keypoints, descriptors, record.path, (camera.width, camera.height), PixelOrigin.CENTER
        )
        vector = vectors.read(record.path)[0]
        features = QueryFeatures("kapture:r2d2_500", pixels, rows, {"kapture:AP-GeM-LM18": vector})
        answer = localizer.localize_features(features, camera, LocalizeOptions())
        assert isinstance(answer, Localized)
        errors.append(pose_error(answer.cam_from_world, truth))
    assert len(errors) == 4
    # 4 to 9 mm and 0.04 to 0.18 degrees, in a hall of 500 keypoints per photo
    assert np.max(errors, axis=0)[0] < 0.03
    assert np.max(errors, axis=0)[1] < 0.4
