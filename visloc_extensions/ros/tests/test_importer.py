"""A robot's recording becomes a dataset, for both generations of ROS."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapping.importers import import_dataset, read_model
from mapping.stages.depth import read_depth
from visloc.errors import DatasetError, InvalidInput
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, read_dataset
from visloc_extensions.ros.tests.rosbags_made import SECOND, Made, write_bag, write_messages


def of_first_camera(dataset: Dataset) -> list[FileRecord]:
    first = dataset.images[0].sensor_id
    return [record for record in dataset.images if record.sensor_id == first]


@pytest.mark.parametrize(("ros1", "compressed"), [(True, False), (False, True), (False, False)])
def test_photos_poses_cameras_and_depth_come_along(
    sample: Path, tmp_path: Path, ros1: bool, compressed: bool
) -> None:
    truth = read_dataset(sample / "mapping")
    bag = tmp_path / ("walk.bag" if ros1 else "walk")
    write_bag(bag, truth, ros1=ros1, compressed=compressed)

    summary = import_dataset("rosbag", bag, tmp_path / "dataset")

    known = of_first_camera(truth)
    read = read_dataset(tmp_path / "dataset")
    assert (summary.images, summary.posed, summary.depth_maps) == (len(known),) * 3
    assert summary.metric
    camera = truth.sensors[known[0].sensor_id].camera
    assert camera is not None
    for number, (record, expected) in enumerate(zip(read.images, known, strict=True)):
        assert record.timestamp == (number + 1) * SECOND
        pose, true = read.pose(record), truth.pose(expected)
        assert pose is not None
        assert true is not None
        np.testing.assert_allclose(pose.rotation, true.rotation, atol=1e-9)
        np.testing.assert_allclose(pose.translation, true.translation, atol=1e-9)
        sensor = read.sensors[record.sensor_id].camera
        assert sensor is not None
        np.testing.assert_allclose(sensor.params, camera.params)
        if compressed:  # as published, byte for byte
            assert read.path_of(record).read_bytes() == truth.path_of(expected).read_bytes()
    depth, expected = (
        read.depth_maps[0],
        next(r for r in truth.depth_maps if r.sensor_id.startswith(known[0].sensor_id)),
    )
    ours, theirs = (
        np.nan_to_num(read_depth(dataset.path_of(r), camera, 0.001))
        for dataset, r in ((read, depth), (truth, expected))
    )
    np.testing.assert_allclose(ours, theirs, atol=6e-4)


def test_photos_of_a_camera_that_stands_are_taken_once(sample: Path, tmp_path: Path) -> None:
    truth = read_dataset(sample / "mapping")
    first = truth.images[0]
    pose = truth.pose(first)
    still = {(record.timestamp, first.sensor_id): pose for record in of_first_camera(truth)}
    standing = Dataset(
        root=truth.root,
        sensors=truth.sensors,
        rigs={},
        trajectories={key: value for key, value in still.items() if value is not None},
        images=tuple(of_first_camera(truth)),
        depth_maps=(),
        gnss=(),
    )
    write_bag(tmp_path / "bag", standing, ros1=False, depth=False)

    summary = import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")

    assert summary.images == 1
    assert f"1 of {len(of_first_camera(truth))} photos taken" in summary.notes[0]


def test_a_damaged_bag_leaves_no_dataset(sample: Path, tmp_path: Path) -> None:
    bag = tmp_path / "walk.bag"
    write_bag(bag, read_dataset(sample / "mapping"), ros1=True)
    data = bag.read_bytes()
    bag.write_bytes(data[: len(data) // 2])

    with pytest.raises(DatasetError) as error:
        import_dataset("rosbag", bag, tmp_path / "dataset")
    assert error.value.code == "bag.unreadable"
    assert not (tmp_path / "dataset").exists()
    assert not (tmp_path / "walk_photos").exists()


IMAGE = "sensor_msgs/msg/Image"
PIXELS = np.zeros((48, 64, 3), np.uint8)


def test_photos_that_were_written_go_if_the_import_fails(tmp_path: Path) -> None:
    made = Made(False)
    torn = made.image(2 * SECOND, "camera", PIXELS, "rgb8")
    torn.data = torn.data[:50]
    good = made.image(SECOND, "camera", PIXELS, "rgb8")
    write_messages(tmp_path / "bag", made, [("/c", IMAGE, 1, good), ("/c", IMAGE, 2, torn)])

    with pytest.raises(DatasetError) as error:
        import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")
    assert error.value.code == "bag.picture"
    assert not (tmp_path / "bag_photos").exists()

    (tmp_path / "bag_photos").mkdir()  # of somebody else
    with pytest.raises(DatasetError):
        import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")
    assert (tmp_path / "bag_photos").exists()


def test_topics_name_folders_but_no_paths_and_never_the_same(tmp_path: Path) -> None:
    made = Made(True)
    topics = ["/a/b", "/a_b", "/..", "/", "/a_b_depth"]
    photo = made.image(SECOND, "camera", PIXELS, "rgb8")
    bag = tmp_path / "in" / "x.bag"
    bag.parent.mkdir()
    write_messages(bag, made, [(topic, IMAGE, 1, photo) for topic in topics])

    summary = import_dataset("rosbag", bag, tmp_path / "dataset")

    assert summary.images == len(topics)
    photos = bag.parent / "x_photos"
    names = sorted(str(path.relative_to(photos).parent) for path in photos.rglob("*.png"))
    assert names == ["a_b", "a_b-2", "a_b_depth-2", "camera", "camera-2"]
    assert sorted(path.name for path in bag.parent.iterdir()) == ["x.bag", "x_photos"]


def test_a_broken_photo_and_one_of_the_same_time_are_left_out(tmp_path: Path) -> None:
    made = Made(False)
    jpeg = cv2.imencode(".jpg", PIXELS)[1].tobytes()
    kind = "sensor_msgs/msg/CompressedImage"
    files = [(1, jpeg), (2, b"no photo"), (3, jpeg), (3, jpeg), (2, jpeg), (9, jpeg)]
    write_messages(
        tmp_path / "bag",
        made,
        [
            ("/c/compressed", kind, number, made.file(second * SECOND, "camera", file))
            for number, (second, file) in enumerate(files)
        ],
    )

    summary = import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")

    dataset = read_dataset(tmp_path / "dataset")
    assert [record.timestamp for record in dataset.images] == [s * SECOND for s in (1, 2, 3, 9)]
    assert "/c/compressed: 1 photos cannot be read" in summary.notes


def test_depth_beyond_what_a_depth_map_can_say_is_unknown(tmp_path: Path) -> None:
    made = Made(False)
    metres = np.full((48, 64), 2.0, np.float32)
    metres[0] = 100.0
    camera = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
    info = "sensor_msgs/msg/CameraInfo"
    write_messages(
        tmp_path / "bag",
        made,
        [
            ("/c/image", IMAGE, 1, made.image(SECOND, "camera", PIXELS, "rgb8")),
            ("/c/camera_info", info, 1, made.info(SECOND, "camera", camera)),
            ("/d/image", IMAGE, 1, made.image(SECOND, "camera", metres, "32FC1")),
        ],
    )

    import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")

    dataset = read_dataset(tmp_path / "dataset")
    units = cv2.imread(str(dataset.path_of(dataset.depth_maps[0])), cv2.IMREAD_UNCHANGED)
    assert (units[0] == 0).all()
    assert (units[1:] == 2000).all()


def test_depth_without_intrinsics_is_left_out(tmp_path: Path) -> None:
    made = Made(False)
    depth = np.full((48, 64), 1500, np.uint16)
    write_messages(
        tmp_path / "bag",
        made,
        [
            ("/c/image", IMAGE, 1, made.image(SECOND, "camera", PIXELS, "rgb8")),
            ("/d/image", IMAGE, 1, made.image(SECOND, "camera", depth, "16UC1")),
        ],
    )

    summary = import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")

    assert (summary.images, summary.depth_maps) == (1, 0)
    assert "/d/image: depth left out, of no photo's frame, time and camera" in summary.notes


OPTICAL, INFO = "camera_optical", "sensor_msgs/msg/CameraInfo"
COMPRESSED, TF = "sensor_msgs/msg/CompressedImage", "tf2_msgs/msg/TFMessage"
CAMERA = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
JPEG = cv2.imencode(".jpg", PIXELS)[1].tobytes()
Message = tuple[str, str, int, Any]


def recorded(
    made: Made,
    info: dict[str, Any] | None = None,
    *,
    info_topic: str = "/c/camera_info",
    stamped: bool = True,
    photo: str = "/c/image/compressed",
) -> list[Message]:
    """Three photos of a camera that moves 1 m a second, with tf and ``camera_info``."""
    messages: list[Message] = []
    for second in (1, 2, 3):
        arrival, stamp = second * SECOND, second * SECOND * stamped
        told = replace(made.info(stamp, OPTICAL, CAMERA), **(info or {}))
        moved = made.moved(stamp, "map", OPTICAL, Pose(np.eye(3), np.array([second, 0.0, 0.0])))
        messages += [
            ("/tf", TF, arrival, moved),
            (info_topic, INFO, arrival, told),
            (photo, COMPRESSED, arrival, made.file(stamp, OPTICAL, JPEG)),
        ]
    return messages


def of_size(width: int, height: int, **changes: Any) -> dict[str, Any]:
    """``camera_info`` of the same camera, on a sensor of another size."""
    x, y = width / 64, height / 48
    k = [60.0 * x, 0, 32 * x - 0.5, 0, 60 * y, 24 * y - 0.5, 0, 0, 1]
    return {"width": width, "height": height, "k": np.array(k), **changes}


def region(*values: int) -> Any:
    names = ("x_offset", "y_offset", "width", "height")
    fields = dict(zip(names, values, strict=True))
    return Made(False)("sensor_msgs/msg/RegionOfInterest", do_rectify=False, **fields)


def imported(
    tmp_path: Path, messages: list[Message], made: Made | None = None
) -> tuple[Dataset, tuple[str, ...]]:
    made = made or Made(False)
    bag = tmp_path / ("bag.bag" if made.ros1 else "bag")
    write_messages(bag, made, sorted(messages, key=lambda each: each[2]))
    summary = import_dataset("rosbag", bag, tmp_path / "dataset", tmp_path / "new" / "photos")
    return read_dataset(tmp_path / "dataset"), summary.notes


def camera_of(dataset: Dataset, topic: str = "c_image_compressed") -> Camera | None:
    return dataset.sensors[topic].camera


BESIDE = "of the same frame"


@pytest.mark.parametrize(
    ("info", "info_topic", "camera", "note"),
    [
        ({}, "/c/camera_info", CAMERA, None),
        ({}, "/c/image/camera_info", CAMERA, None),
        ({}, "/camera_info", CAMERA, f"its camera is that of /camera_info, which is {BESIDE}"),
        ({}, "/robot/left/camera_info", CAMERA, BESIDE),
        (of_size(128, 96), "/c/camera_info", CAMERA, "its camera, of 128 x 96, is scaled"),
        (of_size(32, 24), "/c/camera_info", CAMERA, "its camera, of 32 x 24, is scaled"),
        (of_size(128, 96, binning_x=2, binning_y=2), "/c/camera_info", CAMERA, None),
        (of_size(128, 48, binning_x=2), "/c/camera_info", CAMERA, None),
        (of_size(64, 48, binning_x=2, binning_y=2), "/c/camera_info", CAMERA, "scaled"),
        (
            {"width": 100, "height": 80, "roi": region(20, 10, 64, 48)},
            "/c/camera_info",
            replace(CAMERA, params=(60.0, 60.0, 12.0, 14.0)),
            None,
        ),
        ({"k": np.zeros(9)}, "/c/camera_info", None, None),
    ],
)
def test_a_camera_fits_its_photos(
    tmp_path: Path, info: dict[str, Any], info_topic: str, camera: Camera | None, note: str | None
) -> None:
    messages = recorded(Made(False), info, info_topic=info_topic)
    dataset, notes = imported(tmp_path, messages)
    found = camera_of(dataset)
    assert (found is None) == (camera is None)
    if camera is not None:
        assert found is not None
        assert found.params == pytest.approx(camera.params)
        assert (found.width, found.height) == (64, 48)
    about = [each for each in notes if "its camera" in each]
    assert (note is None and not about) or (note is not None and note in about[0])
    assert len(dataset.trajectories) == 3
    assert len(list((tmp_path / "new" / "photos").rglob("*.jpg"))) == 3


@pytest.mark.parametrize(
    ("info", "why"),
    [
        ({"distortion_model": "omni", "d": np.ones(5)}, "'omni' with 5 numbers"),
        ({"distortion_model": "rational_polynomial", "d": np.ones(14)}, "with 14 numbers"),
        ({"d": np.full(5, np.nan)}, "nan"),
        ({"width": 0, "height": 0}, "0"),
        (of_size(128, 72), "another size"),
        ({"roi": region(50, 0, 64, 48)}, "region of interest"),
        # Twice as large as the region is: no picture of it.
        ({"roi": region(16, 12, 32, 24)}, "another size"),
    ],
)
@pytest.mark.parametrize("alone", [False, True])
def test_photos_of_a_camera_that_cannot_be_used_are_left_out(
    tmp_path: Path, info: dict[str, Any], why: str, alone: bool
) -> None:
    made = Made(False)
    bad = recorded(made, info, info_topic="/bad/camera_info", photo="/bad/image/compressed")
    if alone:
        with pytest.raises(DatasetError) as caught:
            imported(tmp_path, bad)
        assert caught.value.code == "bag.no_photos"
        assert "/bad/image/compressed: " in str(caught.value.got)
        assert why in str(caught.value.got)
        assert not (tmp_path / "new" / "photos").exists()
        return
    dataset, notes = imported(tmp_path, recorded(made) + bad)
    assert {record.sensor_id for record in dataset.images} == {"c_image_compressed"}
    assert camera_of(dataset) == CAMERA
    (note,) = [each for each in notes if each.startswith("/bad/image/compressed: left out")]
    assert why in note
    assert not list((tmp_path / "new" / "photos").rglob("bad*/*"))


def test_a_camera_of_one_frame_among_several_is_not_guessed(tmp_path: Path) -> None:
    made = Made(False)
    messages = recorded(made, info_topic="/left/camera_info")
    messages.append(("/right/camera_info", INFO, 1, made.info(SECOND, OPTICAL, CAMERA)))
    messages.append(("/lidar/camera_info", INFO, 1, made.info(SECOND, "lidar", CAMERA)))
    dataset, notes = imported(tmp_path, messages)
    assert camera_of(dataset) is None
    unused = [note.split(":")[0] for note in notes if "not used" in note]
    assert unused == ["/left/camera_info", "/lidar/camera_info", "/right/camera_info"]


@pytest.mark.parametrize("ros1", [True, False])
def test_messages_without_stamps_have_their_time_of_arrival(tmp_path: Path, ros1: bool) -> None:
    made = Made(ros1)
    dataset, notes = imported(tmp_path, recorded(made, stamped=False), made)
    assert [record.timestamp for record in dataset.images] == [SECOND, 2 * SECOND, 3 * SECOND]
    for record in dataset.images:
        pose = dataset.pose(record)
        assert pose is not None
        assert pose.center[0] == pytest.approx(record.timestamp / SECOND)
    told = [note.split(":")[0] for note in notes if "time of arrival" in note]
    assert told == ["/c/image/compressed", "/tf"]


@pytest.mark.parametrize(
    ("topic", "depth_maps", "note"),
    [
        ("/depth/image", 1, None),
        ("/thermal/image", 0, "/thermal/image: left out, its encoding 'mono16' is not supported"),
    ],
)
def test_grey_of_16_bits_is_depth_where_the_topic_says_so(
    tmp_path: Path, topic: str, depth_maps: int, note: str | None
) -> None:
    made = Made(False)
    grey = made.image(SECOND, OPTICAL, np.full((48, 64), 1500, np.uint16), "mono16")
    dataset, notes = imported(tmp_path, [*recorded(made), (topic, IMAGE, SECOND, grey)])
    assert len(dataset.depth_maps) == depth_maps
    assert note is None or any(each.startswith(note) for each in notes)


@pytest.mark.parametrize(
    ("topic", "encoding", "got"),
    [
        ("/thermal/image", "mono16", "/thermal/image: its encoding 'mono16' is not supported"),
        ("/d/depth", "mono16", "/d/depth: depth"),
        ("/d/image", "16UC1", "/d/image: depth"),
    ],
)
def test_a_bag_without_photos_says_what_its_pictures_are(
    tmp_path: Path, topic: str, encoding: str, got: str
) -> None:
    made = Made(False)
    picture = made.image(SECOND, OPTICAL, np.full((48, 64), 1500, np.uint16), encoding)
    with pytest.raises(DatasetError) as caught:
        imported(tmp_path, [(topic, IMAGE, 1, picture)])
    assert caught.value.code == "bag.no_photos"
    assert got in str(caught.value.got)


def test_depth_has_the_camera_of_its_own_size(tmp_path: Path) -> None:
    made = Made(False)
    depth = made.image(SECOND, OPTICAL, np.full((24, 32), 1500, np.uint16), "16UC1")
    messages = [
        *recorded(made),
        ("/d/image", IMAGE, SECOND, depth),
        ("/d/camera_info", INFO, SECOND, made.info(SECOND, OPTICAL, CAMERA)),
    ]
    dataset, _ = imported(tmp_path, messages)
    camera = dataset.sensors[dataset.depth_maps[0].sensor_id].camera
    assert camera == CAMERA.scaled(32, 24)


def test_the_folder_of_photos_is_made_but_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "new").write_text("a file")
    with pytest.raises(InvalidInput) as caught:
        read_model("rosbag", tmp_path / "bag", tmp_path / "new")
    assert caught.value.code == "import.photos"
