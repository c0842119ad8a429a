from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap
import pycolmap
import pytest

from mapping.importers import import_dataset
from mapping.importers.colmap import read
from visloc.errors import DatasetError, NotFound
from visloc.kapture import open_features, read_dataset, read_reconstruction


@pytest.fixture
def lund(shared_data: Path) -> Path:
    return shared_data / "import_samples" / "lund_door"


@pytest.fixture
def maupertuis(shared_data: Path) -> Path:
    return shared_data / "import_samples" / "colmap_maupertuis"


CAMERAS = "1 PINHOLE 640 480 500 510 320 240\n2 SIMPLE_RADIAL 320 240 250 160 120 0.01\n"
IMAGES = """1 1 0 0 0 0 0 0 1 b/two.jpg
10.5 20.5 7 30.5 40.5 -1
2 0.5 0.5 0.5 0.5 1 2 3 2 a/0.jpg

3 0 1 0 0 -1 0 2 1 a/one.jpg
11.5 21.5 7 12.5 22.5 9
"""
POINTS = "9 1 2 3 10 20 30 0.5 3 1\n7 0 0 5 1 2 3 0.25 1 0 3 0\n"


def write_text(folder: Path, **changes: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    texts = {"cameras": CAMERAS, "images": IMAGES, "points3D": POINTS} | changes
    for name, text in texts.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


def write_binary(folder: Path) -> Path:
    text = write_text(folder.with_name("as_text"))
    folder.mkdir()
    pycolmap.Reconstruction(text).write_binary(folder)
    return folder


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_a_model_is_read_as_it_was_written(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    model = read(write(tmp_path / "model"))
    assert [(image.name, image.sensor, image.timestamp) for image in model.images] == [
        ("a/0.jpg", "camera2", 0),
        ("a/one.jpg", "camera1", 1),
        ("b/two.jpg", "camera1", 2),
    ]
    assert model.sensors["camera1"].params == (
        *("PINHOLE", "640", "480"),
        *("500", "510", "320", "240"),
    )
    pose = model.images[0].cam_from_world
    assert pose is not None
    np.testing.assert_allclose(pose.rotation, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(pose.translation, [1, 2, 3], atol=1e-15)
    assert model.points.tolist() == [[0, 0, 5], [1, 2, 3]]  # in the order of their ids, 7 and 9
    assert model.colors.tolist() == [[1, 2, 3], [10, 20, 30]]
    assert sorted(model.observations.tolist()) == [[0, 1, 0], [0, 2, 0], [1, 1, 1]]
    keypoints = model.images[1].keypoints
    assert keypoints is not None
    assert keypoints.tolist() == [[11.5, 21.5], [12.5, 22.5]]
    assert model.photos is None
    assert not model.metric


BARE = "".join(line for line in IMAGES.splitlines(keepends=True) if ".jpg" in line)


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({}, ["a/0.jpg", "a/one.jpg", "b/two.jpg"]),
        ({"images": IMAGES.replace("b/two", "b/two (2)  x")}, ["b/two (2)  x.jpg"]),
        ({"images": IMAGES.replace("b/two", "#2"), "points3D": "# none\n"}, ["#2.jpg"]),
        ({"images": IMAGES.replace("b/two", "b\\two")}, ["b/two.jpg"]),
        ({"images": IMAGES.replace("b/two", "C:\\photos\\two")}, ["two.jpg"]),
        ({"images": IMAGES.replace("b/two", "/gone/two")}, ["two.jpg"]),
        ({"images": BARE.replace(".jpg\n", ".jpg\n\n"), "points3D": ""}, ["b/two.jpg"]),
        ({"images": BARE.replace(".jpg\n", ".jpg\n\n").rstrip(), "points3D": ""}, ["a/one.jpg"]),
        (
            {"images": BARE.replace(".jpg\n", ".jpg\r\n\r\n").rstrip(), "points3D": ""},
            ["a/one.jpg"],
        ),
        (
            {"cameras": f"\ufeff# 2\n{CAMERAS}", "images": f"\ufeff{IMAGES}"},
            ["b/two.jpg"],
        ),
        ({"cameras": f"\ufeff{CAMERAS}", "points3D": f"\ufeff# 2\n{POINTS}"}, ["b/two.jpg"]),
    ],
)
def test_every_image_of_a_text_keeps_its_name(
    tmp_path: Path, changes: dict[str, str], names: list[str]
) -> None:
    model = read(write_text(tmp_path, **changes))
    assert len(model.images) == 3
    assert set(names) <= {image.name for image in model.images}
    assert len(model.points) == (2 if changes.get("points3D", POINTS).endswith(POINTS) else 0)


def test_a_camera_that_no_photo_has_is_left_out_where_kapture_lacks_its_model(
    tmp_path: Path,
) -> None:
    model = read(
        write_text(tmp_path, cameras=f"{CAMERAS}7 SIMPLE_DIVISION 640 480 500 320 240 0\n")
    )
    assert list(model.sensors) == ["camera1", "camera2"]
    assert any("left out" in note and "SIMPLE_DIVISION" in note for note in model.notes)


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_names_of_windows_are_paths_below_the_photos(
    tmp_path: Path, write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {"b/two.jpg": r"C:\scan\two.jpg", "a/0.jpg": r"a\0.jpg", "a/one.jpg": r".\a\one.jpg"}
    images = IMAGES
    for name, windows in names.items():
        images = images.replace(name, windows)
    monkeypatch.setattr("tests.mapping.importers.test_colmap.IMAGES", images)
    model = read(write(tmp_path / "model"))
    assert {image.name for image in model.images} == {"two.jpg", "a/0.jpg", "a/one.jpg"}
    assert any(r"their end was taken: C:\scan\two.jpg" in note for note in model.notes)
    (tmp_path / "images" / "scan").mkdir(parents=True)
    (tmp_path / "images" / "scan" / "two.jpg").touch()  # the folder was moved as a whole
    model = read(tmp_path / "model", tmp_path / "images")
    assert {image.name for image in model.images} == {"scan/two.jpg", "a/0.jpg", "a/one.jpg"}


def test_ranks_count_numbers_in_names_as_numbers(tmp_path: Path) -> None:
    images = IMAGES.replace("b/two", "f_10").replace("a/0", "f_9").replace("a/one", "f_100")
    model = read(write_text(tmp_path, images=images))
    assert [image.name for image in model.images] == ["f_9.jpg", "f_10.jpg", "f_100.jpg"]
    assert [image.timestamp for image in model.images] == [0, 1, 2]


def test_a_real_model_becomes_a_dataset_with_the_same_cameras_poses_and_points(
    lund: Path, tmp_path: Path
) -> None:
    output = tmp_path / "dataset"
    summary = import_dataset("colmap", lund / "colmap", output)
    assert (summary.images, summary.posed, summary.points) == (12, 12, 11384)
    assert (summary.observations, summary.notes) == (73327, ())
    theirs = pycolmap.Reconstruction(lund / "colmap")
    dataset, known = read_dataset(output), read_reconstruction(output)
    assert known is not None
    assert known.keypoints_type == summary.keypoints_type == "colmap"
    (camera,) = (sensor.camera for sensor in dataset.sensors.values())
    assert camera is not None
    assert camera.params == tuple(theirs.cameras[1].params)
    images = {image.name: image for image in theirs.images.values()}
    keypoints = open_features(output, "keypoints", "colmap")
    for record in dataset.images:
        assert dataset.has_file(record)
        pose = dataset.pose(record)
        assert pose is not None
        theirs_pose = images[record.path].cam_from_world()
        quaternion = theirs_pose.rotation.quat[[3, 0, 1, 2]]
        quaternion /= np.linalg.norm(quaternion)  # six digits in the file, off by 2e-7
        np.testing.assert_allclose(pose.rotation_wxyz, quaternion, rtol=0, atol=1e-15)
        assert pose.translation.tolist() == theirs_pose.translation.tolist()
        xy = np.array([point.xy for point in images[record.path].points2D], np.float32)
        rows = keypoints.read(record.path)
        assert rows is not None
        assert np.array_equal(rows, xy)
    ids = sorted(theirs.points3D)
    assert np.array_equal(known.points, [theirs.points3D[i].xyz for i in ids])
    assert known.colors is not None
    assert np.array_equal(known.colors, [theirs.points3D[i].color for i in ids])
    expected = {
        (row, theirs.images[element.image_id].name, element.point2D_idx)
        for row, i in enumerate(ids)
        for element in theirs.points3D[i].track.elements
    }
    found = {(p, known.images[image], k) for p, image, k in known.observations.tolist()}
    assert found == expected


def test_features_come_from_the_database_that_the_model_was_made_of(maupertuis: Path) -> None:
    before = (maupertuis / "colmap.db").read_bytes()
    model = read(maupertuis / "reconstruction")
    assert model.keypoints_type == "sift"
    assert (len(model.points), len(model.observations)) == (1039, 3355)
    for image in model.images:
        assert image.keypoints is not None
        assert image.descriptors is not None
        assert image.keypoints.shape[1] == 6
        assert image.descriptors.shape == (len(image.keypoints), 128)
        assert image.descriptors.dtype == np.uint8
    assert (maupertuis / "colmap.db").read_bytes() == before


def test_a_database_of_other_keypoints_is_not_used(maupertuis: Path, tmp_path: Path) -> None:
    folder = write_text(tmp_path / "model")
    shutil.copyfile(maupertuis / "colmap.db", folder / "database.db")
    model = read(folder)
    assert model.keypoints_type == "colmap"
    assert any("was not used" in note for note in model.notes)


def test_a_database_alone_gives_features_and_no_poses(maupertuis: Path) -> None:
    model = read(maupertuis / "colmap.db")
    assert [image.name for image in model.images] == ["00.jpg", "01.jpg", "02.jpg", "03.jpg"]
    assert all(image.cam_from_world is None for image in model.images)
    assert [len(i.keypoints) for i in model.images if i.keypoints is not None] == [
        *(6424, 5920),
        *(5576, 6090),
    ]
    assert model.sensors["camera1"].camera is None  # its focal length was a guess of COLMAP's
    assert model.sensors["camera1"].image_size == (1919, 1079)
    assert model.photos == maupertuis / "images"


def write_database(path: Path) -> None:
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera(
            model="PINHOLE", width=640, height=480, params=[500, 510, 320, 240]
        )
        camera.has_prior_focal_length = True
        camera_id = database.write_camera(camera)
        for number, name in enumerate(("b.jpg", "a.jpg")):
            image = pycolmap.Image(name=name, camera_id=camera_id)
            image_id = database.write_image(image)
            prior = pycolmap.PosePrior()
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
            prior.corr_data_id = pycolmap.data_t(sensor, image_id)
            prior.position = np.array([45.5, 5.25 + number, 300.0])
            prior.coordinate_system = (
                pycolmap.PosePriorCoordinateSystem.WGS84
                if number
                else pycolmap.PosePriorCoordinateSystem.CARTESIAN
            )
            database.write_pose_prior(prior)


def test_position_priors_on_earth_become_gnss_fixes(tmp_path: Path) -> None:
    write_database(tmp_path / "database.db")
    model = read(tmp_path)
    (fix,) = model.gnss
    assert (fix.timestamp, fix.x, fix.y, fix.z) == (0, 6.25, 45.5, 300.0)  # of a.jpg
    assert model.sensors[fix.sensor_id].params == ("EPSG:4326",)
    assert model.sensors["camera1"].camera is not None
    assert any("1 pose priors" in note for note in model.notes)


def test_photos_of_a_rig_frame_share_a_timestamp_and_have_their_own_poses(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=20
    )
    theirs = pycolmap.synthesize_dataset(options)
    theirs.write_binary(tmp_path)
    model = read(tmp_path)
    assert [image.timestamp for image in sorted(model.images, key=lambda i: i.timestamp)] == [
        *(0, 0, 1),
        *(1, 2, 2),
    ]
    assert any("1 rigs" in note for note in model.notes)
    by_name = {image.name: image for image in theirs.images.values()}
    for image in model.images:
        assert image.cam_from_world is not None
        matrix = by_name[image.name].cam_from_world().matrix()
        np.testing.assert_allclose(image.cam_from_world.rotation, matrix[:, :3], atol=1e-14)
        np.testing.assert_allclose(image.cam_from_world.translation, matrix[:, 3], atol=1e-14)


ONE_IMAGE = "1 1 0 0 0 0 0 0 1 c/alone.jpg\n10.5 20.5 5\n"
ONE_POINT = "5 1 2 3 10 20 30 0.5 1 0\n"


@pytest.mark.parametrize("inside", ["sparse", "."])
def test_of_several_models_the_one_with_most_photos_is_taken_and_the_others_told(
    tmp_path: Path, inside: str
) -> None:
    small = {"images": ONE_IMAGE, "points3D": ONE_POINT}
    write_text(tmp_path / inside / "0", **small)
    write_text(tmp_path / inside / "1")
    write_text(tmp_path / inside / "2", **small)
    model = read(tmp_path)
    assert len(model.images) == 3
    (note,) = (note for note in model.notes if "largest" in note)
    assert "holds 3 models" in note
    assert "1 with 3 photos and 2 points, not: 0 with 1 photos and 1 points, 2 with" in note
    (image,) = read(tmp_path / inside / "0").images
    assert image.name == "c/alone.jpg"


def test_a_damaged_model_beside_a_whole_one_is_left_out_with_a_note(tmp_path: Path) -> None:
    write_text(tmp_path / "sparse" / "0")
    damaged = write_binary(tmp_path / "sparse" / "1") / "points3D.bin"
    damaged.write_bytes(damaged.read_bytes()[:10])
    model = read(tmp_path)
    assert len(model.images) == 3
    assert any("left out" in note and str(damaged) in note for note in model.notes)


def test_a_single_model_needs_no_note(tmp_path: Path) -> None:
    write_text(tmp_path / "sparse" / "1")
    assert not any("largest" in note for note in read(tmp_path).notes)


def test_photos_beside_the_model_are_found(tmp_path: Path) -> None:
    write_text(tmp_path / "project" / "sparse" / "0")
    (tmp_path / "project" / "images").mkdir()
    expected = tmp_path / "project" / "images"
    for path in ("project", "project/sparse/0"):
        found = read(tmp_path / path).photos
        assert found is not None
        assert found.resolve() == expected


def test_a_folder_without_a_model_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match=r"points3D .* or a database"):
        read(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_binary_file_cut_short_is_named(tmp_path: Path, name: str, share: float) -> None:
    path = write_binary(tmp_path / "model") / f"{name}.bin"
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DatasetError) as caught:
        read(tmp_path / "model")
    assert caught.value.code == "import.colmap"
    assert caught.value.field == str(path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_a_huge_count_ends_at_once(tmp_path: Path, name: str) -> None:
    path = write_binary(tmp_path / "model") / f"{name}.bin"
    content = path.read_bytes()
    path.write_bytes(b"\xff" * 8 + content[8:])
    with pytest.raises(DatasetError) as caught:
        read(tmp_path / "model")
    assert caught.value.field == str(path)


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    folder = write_binary(tmp_path / "model")
    (folder / "cameras.bin").write_bytes(bytes(8))  # no camera
    with pytest.raises(DatasetError) as caught:
        read(folder)
    assert caught.value.code == "import.colmap"
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "old", "new", "line", "code"),
    [
        ("cameras", "PINHOLE", "PINHOLES", 1, "camera.model"),
        ("cameras", " 240\n", "\n", 1, "camera.param_count"),
        ("cameras", "250", "nan", 2, "import.line"),
        ("cameras", "2 SIMPLE", "1 SIMPLE", 2, "import.colmap"),
        ("images", " 2 a/0", " 7 a/0", 3, "import.colmap"),
        ("images", "0.5 0.5", "0.5 x", 3, "import.line"),
        ("images", "30.5 40.5 -1", "30.5 40.5", 2, "import.colmap"),
        ("images", "b/two.jpg", "a/one.jpg", 5, "import.duplicate_image"),
        ("points3D", "1 2 3 10", "1 inf 3 10", 1, "import.line"),
        ("points3D", "3 1\n", "3 2\n", 1, "import.colmap"),
        ("points3D", "3 0\n", "3\n", 2, "import.colmap"),
        ("points3D", "10 20 30", "10 20 300", 1, "import.line"),
    ],
)
def test_a_bad_line_of_a_text_is_named(
    tmp_path: Path, name: str, old: str, new: str, line: int, code: str
) -> None:
    good = {"cameras": CAMERAS, "images": IMAGES, "points3D": POINTS}[name]
    assert old in good
    folder = write_text(tmp_path / "model", **{name: good.replace(old, new, 1)})
    with pytest.raises(DatasetError) as caught:
        read(folder)
    assert caught.value.code == code
    assert caught.value.field == f"{folder / name}.txt:{line}"


def test_a_camera_that_kapture_cannot_hold_is_named_with_its_image(tmp_path: Path) -> None:
    cameras = CAMERAS.replace("SIMPLE_RADIAL 320 240 250 160 120 0.01", "EUCM 320 240 1 1 1 1 1 1")
    with pytest.raises(DatasetError, match=r"camera 2 of 'a/0.jpg'.*EUCM") as caught:
        read(write_text(tmp_path / "model", cameras=cameras))
    assert caught.value.code == "camera.model"


@pytest.mark.parametrize("content", [b"", b"not a database" * 100])
def test_what_is_no_database_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "database.db").write_bytes(content)
    with pytest.raises(DatasetError, match="not a COLMAP database"):
        read(tmp_path)


def test_a_database_cut_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    write_database(path)
    path.write_bytes(path.read_bytes()[:8192])
    with pytest.raises(DatasetError) as caught:
        read(tmp_path)
    assert caught.value.field == str(path)
