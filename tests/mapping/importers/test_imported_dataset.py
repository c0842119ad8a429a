from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image

from mapping.importers import IMPORTERS, ImportedImage, ImportedModel, import_dataset, read_model
from mapping.importers.dataset import write_imported
from visloc.errors import Conflict, DatasetError, InvalidInput
from visloc.geometry import Camera, Pose
from visloc.kapture import (
    FileRecord,
    GnssRecord,
    Sensor,
    open_features,
    read_dataset,
    read_reconstruction,
)

CAMERA = Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))
POSE = Pose.from_quaternion((0.5, -0.5, 0.5, 0.5), (1.5, -2.0, 3.25))
SENSORS = {
    "cam": Sensor.with_camera("cam", CAMERA),
    "cam_depth": Sensor.with_camera("cam_depth", CAMERA.scaled(32, 24), "depth"),
    "gnss": Sensor("gnss", "", "gnss", ("EPSG:4326",), None),
}


def image(name: str, timestamp: int, **changes: Any) -> ImportedImage:
    fields: dict[str, Any] = {
        "cam_from_world": POSE,
        "keypoints": np.array([[1.5, 2.5], [3.5, 4.5]], np.float32),
        "descriptors": np.arange(8, dtype=np.uint8).reshape(2, 4),
    }
    return ImportedImage(name, "cam", timestamp, **(fields | changes))


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    (folder / "b").mkdir(parents=True)
    for name in ("a.jpg", "b/c.jpg", "a.png"):
        Image.new("RGB", (64, 48)).save(folder / name)
    return folder


@pytest.fixture
def model(photos: Path) -> ImportedModel:
    return ImportedModel(
        sensors=SENSORS,
        images=(
            image("b/c.jpg", 20),
            image("a.jpg", 10, depth="a.png"),
        ),
        photos=photos,
        points=np.array([[1.0, 2.0, 1 / 3], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]),
        colors=np.array([[1, 2, 3], [4, 5, 6], [255, 0, 9]], np.uint8),
        observations=np.array([[0, 1, 1], [2, 0, 0], [2, 1, 0]]),
        keypoints_type="sift",
        gnss=(GnssRecord(10, "gnss", 5.5, 45.25, 300.0, 0.0, 0.0),),
        notes=("A note.",),
    )


def test_a_model_comes_back_from_its_dataset(
    model: ImportedModel, photos: Path, tmp_path: Path
) -> None:
    output = tmp_path / "made" / "dataset"
    assert write_imported(model, output) == ("A note.",)
    dataset = read_dataset(output)
    assert dataset.notes == ()
    assert dataset.sensors == SENSORS
    assert dataset.images == (FileRecord(10, "cam", "a.jpg"), FileRecord(20, "cam", "b/c.jpg"))
    assert dataset.depth_maps == (FileRecord(10, "cam_depth", "a.png"),)
    assert dataset.gnss == model.gnss
    for record in (*dataset.images, *dataset.depth_maps):
        assert dataset.has_file(record)
        pose = dataset.pose(record)
        assert pose is not None
        np.testing.assert_allclose(pose.rotation, POSE.rotation, atol=1e-15)
        assert pose.translation.tolist() == POSE.translation.tolist()
    assert (output / "sensors" / "records_data").is_symlink()
    assert (output / "sensors" / "records_data").resolve() == photos
    keypoints = open_features(output, "keypoints", "sift").read("a.jpg")
    descriptors = open_features(output, "descriptors", "sift").read("a.jpg")
    assert np.array_equal(keypoints, [[1.5, 2.5], [3.5, 4.5]])
    assert np.array_equal(descriptors, np.arange(8).reshape(2, 4))
    known = read_reconstruction(output)
    assert known is not None
    assert np.array_equal(known.points, model.points)
    assert known.colors is not None
    assert np.array_equal(known.colors, model.colors)
    assert {(p, known.images[i], k) for p, i, k in known.observations.tolist()} == {
        (0, "a.jpg", 1),
        (2, "b/c.jpg", 0),
        (2, "a.jpg", 0),
    }


def test_a_model_without_features_points_and_poses_is_a_dataset_of_photos(
    model: ImportedModel, tmp_path: Path
) -> None:
    bare = image("a.jpg", 1, cam_from_world=None, keypoints=None, descriptors=None)
    none = np.empty((0, 3))
    write_imported(
        replace(
            model,
            images=(bare,),
            points=none,
            colors=none.astype(np.uint8),
            observations=none.astype(np.int64),
            gnss=(),
        ),
        tmp_path / "dataset",
    )
    dataset = read_dataset(tmp_path / "dataset")
    assert dataset.pose(dataset.images[0]) is None
    assert not (tmp_path / "dataset" / "reconstruction").exists()


def test_keypoints_without_descriptors_are_kept(model: ImportedModel, tmp_path: Path) -> None:
    images = tuple(replace(i, descriptors=None) for i in model.images)
    write_imported(replace(model, images=images), tmp_path / "dataset")
    assert open_features(tmp_path / "dataset", "keypoints", "sift").read("b/c.jpg") is not None
    assert not (tmp_path / "dataset" / "reconstruction" / "descriptors").exists()


def test_an_existing_output_is_left_alone(model: ImportedModel, tmp_path: Path) -> None:
    output = tmp_path / "dataset"
    output.mkdir()
    with pytest.raises(Conflict) as caught:
        write_imported(model, output)
    assert caught.value.code == "import.exists"
    assert list(output.iterdir()) == []


def change(model: ImportedModel, index: int, **changes: Any) -> ImportedModel:
    images = list(model.images)
    images[index] = replace(images[index], **changes)
    return replace(model, images=tuple(images))


@pytest.mark.parametrize(
    ("changes", "code", "named"),
    [
        ({"name": "a.jpg"}, "import.duplicate_image", "'a.jpg'"),
        ({"timestamp": 10}, "import.duplicate_record", "'a.jpg'"),
        ({"name": "b,c.jpg"}, "import.name", "'b,c.jpg'"),
        ({"name": "../c.jpg"}, "import.name", "'../c.jpg'"),
        ({"name": "/c.jpg"}, "import.name", "'/c.jpg'"),
        ({"name": "b\nc.jpg"}, "import.name", "c.jpg"),
        ({"depth": "/etc/passwd"}, "import.name", "'b/c.jpg'"),
        ({"sensor": "other"}, "import.sensor", "'b/c.jpg'"),
        ({"sensor": "gnss"}, "import.sensor", "'b/c.jpg'"),
        ({"descriptors": np.zeros((3, 4), np.uint8)}, "import.features", "'b/c.jpg'"),
        ({"keypoints": None}, "import.features", "'b/c.jpg'"),
        ({"keypoints": np.full((2, 2), np.nan, np.float32)}, "import.features", "'b/c.jpg'"),
        ({"keypoints": np.zeros((2, 3), np.float32)}, "import.features", "'a.jpg'"),
        ({"descriptors": np.zeros((2, 4), np.float32)}, "import.features", "'a.jpg'"),
        (
            {"keypoints": np.zeros((0, 2), np.float32), "descriptors": np.zeros((0, 4), np.uint8)},
            "import.observations",
            "'b/c.jpg'",
        ),
    ],
)
def test_a_photo_that_cannot_be_kept_is_named_and_nothing_is_left(
    model: ImportedModel, tmp_path: Path, changes: dict[str, Any], code: str, named: str
) -> None:
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DatasetError) as caught:
        write_imported(change(model, 0, **changes), tmp_path / "dataset")
    assert caught.value.code == code
    assert named in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "row", [[3, 0, 0], [-1, 0, 0], [0, 2, 0], [0, -1, 0], [0, 0, 2], [0, 0, -1]]
)
def test_an_observation_of_nothing_is_refused(
    model: ImportedModel, tmp_path: Path, row: list[int]
) -> None:
    with pytest.raises(DatasetError) as caught:
        write_imported(replace(model, observations=np.array([[0, 0, 0], row])), tmp_path / "d")
    assert caught.value.code == "import.observations"


def test_points_that_are_nowhere_or_have_no_colour_are_refused(
    model: ImportedModel, tmp_path: Path
) -> None:
    points = model.points.copy()
    points[1, 2] = np.inf
    with pytest.raises(DatasetError, match="point 1"):
        write_imported(replace(model, points=points), tmp_path / "d")
    with pytest.raises(DatasetError, match="colours differ"):
        write_imported(replace(model, colors=model.colors[:1]), tmp_path / "d")


def test_two_fixes_of_one_time_are_refused(model: ImportedModel, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="same sensor and timestamp"):
        write_imported(replace(model, gnss=model.gnss * 2), tmp_path / "d")


def test_a_failure_while_writing_leaves_nothing(model: ImportedModel, tmp_path: Path) -> None:
    sensors = {**SENSORS, "x": Sensor("x", "a, b", "gnss", (), None)}
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DatasetError, match="kapture cannot store"):
        write_imported(replace(model, sensors=sensors), tmp_path / "dataset")
    assert sorted(tmp_path.rglob("*")) == before


def test_some_missing_photos_are_noted(model: ImportedModel, photos: Path, tmp_path: Path) -> None:
    (photos / "a.jpg").unlink()
    notes = write_imported(model, tmp_path / "dataset")
    assert notes[1:] == ("1 of 2 photos are missing: a.jpg",)


@pytest.mark.parametrize("folder", [None, "elsewhere"])
def test_without_any_photo_descriptors_are_needed(
    model: ImportedModel, tmp_path: Path, folder: str | None
) -> None:
    model = replace(model, photos=None if folder is None else tmp_path / folder)
    assert len(write_imported(model, tmp_path / "with_descriptors")) == 2
    with pytest.raises(DatasetError, match="--photos") as caught:
        write_imported(change(model, 0, descriptors=None), tmp_path / "without")
    assert caught.value.code == "import.photos_missing"
    assert not (tmp_path / "without").exists()


def test_a_model_without_photos_is_refused(model: ImportedModel, tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        write_imported(replace(model, images=()), tmp_path / "d")
    assert caught.value.code == "import.empty"


def test_an_unknown_format_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput) as caught:
        read_model("meshroom", tmp_path)
    assert all(name in str(caught.value) for name in IMPORTERS)


def test_a_folder_of_photos_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="--photos"):
        read_model("colmap", tmp_path, tmp_path / "nowhere")


def test_an_existing_output_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    with pytest.raises(Conflict):
        import_dataset("colmap", tmp_path / "nowhere", tmp_path)


def turned(path: Path, orientation: int) -> None:
    """Write a photo of 48 x 64 pixels with an EXIF orientation."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.new("RGB", (48, 64)).save(path, exif=exif)


@pytest.mark.parametrize("name", ["a.jpg", "b/c.jpg"])
def test_a_photo_of_another_size_than_its_camera_is_refused(
    model: ImportedModel, photos: Path, tmp_path: Path, name: str
) -> None:
    turned(photos / name, 1)
    with pytest.raises(DatasetError, match="1 of 2 photos") as caught:
        write_imported(model, tmp_path / "dataset")
    error = caught.value
    assert (error.code, error.field) == ("import.photo_size", str(photos / name))
    assert error.expected == "64 x 48 pixels, as its camera cam"
    assert error.got == "48 x 64 pixels"
    assert not (tmp_path / "dataset").exists()


def test_the_camera_of_the_photo_that_has_another_size_is_named(
    model: ImportedModel, photos: Path, tmp_path: Path
) -> None:
    turned(photos / "a.jpg", 1)
    a, b = sorted(model.images, key=lambda each: each.name)
    two = replace(
        model,
        sensors={**model.sensors, "other": replace(model.sensors["cam"], id="other")},
        images=(a, replace(b, sensor="other", depth=None)),
    )
    with pytest.raises(DatasetError) as caught:
        write_imported(two, tmp_path / "dataset")
    assert caught.value.expected == "64 x 48 pixels, as its camera cam"


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_a_photo_that_is_stored_turned_may_have_the_upright_size(
    model: ImportedModel, photos: Path, tmp_path: Path, orientation: int, suffix: str
) -> None:
    turned(photos / f"turned.{suffix}", orientation)
    own = replace(model, images=(*model.images, image(f"turned.{suffix}", 30)))
    write_imported(own, tmp_path / "dataset")


def test_a_photo_of_a_kind_that_is_not_read_is_refused_with_advice(
    model: ImportedModel, photos: Path, tmp_path: Path
) -> None:
    (photos / "a.jpg").write_bytes(b"\0\0\0\x0cJXL \r\n\x87\n")
    with pytest.raises(DatasetError, match="JPEG XL photos are not read here; convert") as caught:
        write_imported(model, tmp_path / "dataset")
    assert (caught.value.code, caught.value.field) == ("import.photo", str(photos / "a.jpg"))
