"""Pictures, cameras, frames and poses of ROS bags."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visloc.errors import Conflict, DatasetError
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project
from visloc_extensions.ros.cameras import camera_from_info
from visloc_extensions.ros.pictures import Picture, depth_in_metres, pixels_of
from visloc_extensions.ros.reading import open_bag
from visloc_extensions.ros.tests.rosbags_made import SECOND, Made, write_messages
from visloc_extensions.ros.transforms import Transforms
from visloc_extensions.ros.writing import PoseStamped, ros_covariance, write_poses

numbers = st.floats(-9, 9)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
poses = st.builds(Pose.from_quaternion, quaternions, st.tuples(numbers, numbers, numbers))


def assert_same(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-9)
    np.testing.assert_allclose(a.translation, b.translation, atol=1e-9)


# Frames


@settings(deadline=None)
@given(poses, poses, poses)
def test_transforms_chain_through_the_tree(a: Pose, b: Pose, c: Pose) -> None:
    tree = Transforms()
    tree.add("base", "camera", None, a)
    tree.add("map", "base", 10, b)
    tree.add("base", "lidar", None, c)

    found = tree.pose("map", "camera", 10)
    beside = tree.pose("lidar", "camera", 10)

    assert found is not None
    assert beside is not None
    assert_same(found, b @ a)
    assert_same(beside, c.inverse() @ a)
    assert tree.root_of("camera") == "map"
    assert tree.moves("camera")
    assert not tree.moves("map")


def test_poses_between_two_times_are_interpolated_and_none_is_guessed_outside() -> None:
    tree = Transforms()
    turned = Pose.from_quaternion((np.cos(0.3), 0, 0, np.sin(0.3)), (2, 0, 0))
    tree.add("map", "base", 20, turned)  # not in order, as topics may interleave
    tree.add("map", "base", 10, Pose.identity())

    middle = tree.pose("map", "base", 15)

    assert middle is not None
    np.testing.assert_allclose(middle.translation, [1, 0, 0], atol=1e-12)
    half = Pose.from_quaternion((np.cos(0.15), 0, 0, np.sin(0.15)), (1, 0, 0))
    np.testing.assert_allclose(middle.rotation, half.rotation, atol=1e-12)
    assert tree.pose("map", "base", 9) is None
    assert tree.pose("map", "base", 21) is None
    assert tree.pose("odom", "base", 15) is None


def test_over_a_long_gap_nothing_is_interpolated() -> None:
    tree = Transforms()
    for second in (10, 20, 31):
        tree.add("map", "base", second * SECOND, Pose.identity())

    assert tree.pose("map", "base", 15 * SECOND) is not None
    assert tree.pose("map", "base", 25 * SECOND) is None
    assert tree.pose("map", "base", 31 * SECOND) is not None


def test_a_circle_of_frames_ends() -> None:
    tree = Transforms()
    tree.add("a", "b", None, Pose.identity())
    tree.add("b", "a", None, Pose.identity())

    assert tree.pose("elsewhere", "a", 0) is None


# Cameras


def info(
    model: str,
    d: list[float],
    width: int = 640,
    height: int = 480,
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
    binning: tuple[int, int] = (0, 0),
) -> Any:
    k = np.array([500.0, 0, 319.5, 0, 510, 239.5, 0, 0, 1])
    p = np.array([450.0, 0, 310.5, -40, 0, 460, 229.5, 0, 0, 0, 1, 0])
    names = "x_offset", "y_offset", "width", "height"
    return SimpleNamespace(
        **{"width": width, "height": height, "distortion_model": model},
        **{"k": k, "d": np.array(d), "p": p, "binning_x": binning[0], "binning_y": binning[1]},
        roi=SimpleNamespace(**dict(zip(names, roi, strict=True))),
    )


def test_cameras_count_pixels_from_the_corner() -> None:
    assert camera_from_info(info("plumb_bob", [0.0] * 5), "/c") == Camera(
        "PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0)
    )


@pytest.mark.parametrize(
    ("model", "d", "ours"),
    [
        ("plumb_bob", [0.1, -0.05, 0.001, 0.002, 0.0], "OPENCV"),
        ("plumb_bob", [0.1, -0.05, 0.001, 0.002, 0.01], "FULL_OPENCV"),
        (
            "rational_polynomial",
            [0.1, -0.05, 0.001, 0.002, 0.01, 0.02, 0.003, 0.004],
            "FULL_OPENCV",
        ),
        ("equidistant", [0.1, -0.05, 0.001, 0.002], "OPENCV_FISHEYE"),
        # Zeros at the end, or too few numbers.
        ("plumb_bob", [0.1, -0.05, 0.001, 0.002], "OPENCV"),
        ("plumb_bob", [0.1, -0.05], "OPENCV"),
        ("plumb_bob", [0.1, -0.05, 0.001, 0.002, 0.01, 0.0, 0.0, 0.0], "FULL_OPENCV"),
        ("plumb_bob", [0.1, -0.05, 0.001, 0.002, 0.0, 0.0, 0.0, 0.0], "OPENCV"),
        ("plumb_bob", [0.1, -0.05, 0.001, 0.002, 0.01, 0.02, 0.003, 0.004], "FULL_OPENCV"),
        ("rational_polynomial", [0.1, -0.05, 0.001, 0.002], "OPENCV"),
        ("rational_polynomial", [0.1, -0.05, 0.001, 0.002, 0.0], "OPENCV"),
        ("rational_polynomial", [0.1, -0.05, 0.001, 0.002, 0.01], "FULL_OPENCV"),
        ("rational_polynomial", [0.1, -0.05, 0.001, 0.002, *[0.0] * 4], "OPENCV"),
        (
            "rational_polynomial",
            [4.6, 1.3, 1e-4, -2e-4, 0.5, 4.5, 1.2, 0.4, *[0.0] * 4],
            "FULL_OPENCV",
        ),
        (
            "rational_polynomial",
            [4.6, 1.3, 1e-4, -2e-4, 0.5, 4.5, 1.2, 0.4, *[0.0] * 6],
            "FULL_OPENCV",
        ),
        ("equidistant", [-0.0022, 0.0376, -0.0364, 0.0059, 0.0], "OPENCV_FISHEYE"),
        ("equidistant", [0.1, -0.05, 0.0, 0.0], "OPENCV_FISHEYE"),
        ("equidistant", [0.0, 0.0, 0.0, 0.0], "OPENCV_FISHEYE"),
        ("fisheye", [0.1, -0.05, *[0.0] * 6], "OPENCV_FISHEYE"),
    ],
)
def test_distortion_is_that_of_opencv(model: str, d: list[float], ours: str) -> None:
    import cv2

    camera = camera_from_info(info(model, d), "/c")
    assert camera is not None
    assert camera.model == ours
    points = np.array([[0.3, -0.2, 1.0], [-0.1, 0.25, 1.2]])
    k = info(model, d).k.reshape(3, 3)
    if ours == "OPENCV_FISHEYE":
        d = [*d, 0.0, 0.0][:4]
        expected, _ = cv2.fisheye.projectPoints(
            points[:, None], np.zeros(3), np.zeros(3), k, np.array(d)
        )
    elif len(d) == 2:
        expected, _ = cv2.projectPoints(
            points, np.zeros(3), np.zeros(3), k, np.array([*d, 0.0, 0.0])
        )
    else:
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), k, np.array(d))
    np.testing.assert_allclose(project(camera, points), expected.reshape(-1, 2) + 0.5, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "got"),
    [
        ({"model": "fov", "d": [0.9]}, "'fov' with 1 numbers"),
        ({"model": "", "d": [0.1, 0.1, 0.0, 0.0, 0.0]}, "'' with 2 numbers"),
        ({"model": "omni", "d": [1.0, 2.0, 3.0, 4.0, 5.0]}, "'omni' with 5 numbers"),
        ({"model": "equidistant", "d": [0.1, 0.1, 0.1, 0.1, 0.1]}, "with 5 numbers"),
        # A thin prism, a tilted sensor.
        ({"model": "rational_polynomial", "d": [0.1] * 9}, "with 9 numbers"),
        ({"model": "rational_polynomial", "d": [*[0.0] * 13, 0.01]}, "with 14 numbers"),
        ({"roi": (400, 0, 320, 240)}, "320 x 240 at 400, 0"),
        ({"roi": (0, 300, 0, 240)}, "640 x 240 at 0, 300"),
    ],
)
def test_a_camera_that_we_lack_is_named(changes: dict[str, Any], got: str) -> None:
    with pytest.raises(DatasetError) as caught:
        camera_from_info(info(**{"model": "plumb_bob", "d": [0.0] * 5, **changes}), "/c")
    assert (caught.value.code, caught.value.field) == ("bag.camera", "/c")
    assert got in str(caught.value.got)


@pytest.mark.parametrize(
    ("roi", "binning", "size", "k"),
    [
        ((0, 0, 0, 0), (1, 1), (640, 480), (500, 510, 320, 240)),
        ((0, 0, 640, 480), (0, 0), (640, 480), (500, 510, 320, 240)),
        ((0, 0, 0, 0), (2, 2), (320, 240), (250, 255, 160, 120)),
        ((0, 0, 0, 0), (2, 1), (320, 480), (250, 510, 160, 240)),
        ((160, 120, 320, 240), (1, 1), (320, 240), (500, 510, 160, 120)),
        ((100, 20, 400, 300), (2, 2), (200, 150), (250, 255, 110, 110)),
    ],
)
def test_a_camera_is_of_the_region_that_is_read_and_binned(
    roi: tuple[int, int, int, int],
    binning: tuple[int, int],
    size: tuple[int, int],
    k: tuple[float, ...],
) -> None:
    for rectified in (False, True):
        given = info("plumb_bob", [0.0] * 5, roi=roi, binning=binning)
        given.p = np.column_stack([given.k.reshape(3, 3), np.zeros(3)]).reshape(-1)
        assert camera_from_info(given, "/c", rectified=rectified) == Camera("PINHOLE", *size, k)


def test_no_calibration_is_no_camera() -> None:
    uncalibrated = info("plumb_bob", [])
    uncalibrated.k = np.zeros(9)
    assert camera_from_info(uncalibrated, "/c") is None


def test_rectified_pictures_have_the_camera_that_they_were_rectified_to() -> None:
    given = info("plumb_bob", [0.1, -0.05, 0.001, 0.002, 0.0])

    camera = camera_from_info(given, "/c", rectified=True)
    assert camera == Camera("PINHOLE", 640, 480, (450.0, 460.0, 311.0, 230.0))
    given.p[:] = 0  # of drivers that calibrate but do not rectify
    unknown = camera_from_info(given, "/c", rectified=True)
    assert unknown is not None
    assert unknown.model == "OPENCV"


# Pictures


def image(pixels: Any, encoding: str, padding: int = 0, big: bool = False) -> Any:
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    height, width = pixels.shape[:2]
    return SimpleNamespace(
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(big),
        step=padded.shape[1],
        data=padded.reshape(-1),
    )


@pytest.mark.parametrize("padding", [0, 5])
def test_pixels_come_in_the_order_red_green_blue(padding: int) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (4, 6, 3), np.uint8)
    alpha = np.full((4, 6, 1), 9, np.uint8)

    for pixels, encoding in (
        (rgb, "rgb8"),
        (rgb[..., ::-1], "bgr8"),
        (np.concatenate([rgb, alpha], 2), "rgba8"),
        (np.concatenate([rgb[..., ::-1], alpha], 2), "bgra8"),
    ):
        np.testing.assert_array_equal(pixels_of(image(pixels, encoding, padding), "/c"), rgb)
    np.testing.assert_array_equal(
        pixels_of(image(rgb[..., 0], "mono8", padding), "/c"), rgb[..., 0]
    )


@pytest.mark.parametrize("shape", [(5, 7, 3), (5, 7)])
def test_raw_pictures_become_files_without_loss(shape: tuple[int, ...]) -> None:
    import cv2

    pixels = np.random.default_rng(0).integers(0, 256, shape, np.uint8)

    file = np.frombuffer(Picture("/c", 0, "f", None, pixels).file(), np.uint8)

    read = cv2.imdecode(file, cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read[..., ::-1] if len(shape) == 3 else read, pixels)


@pytest.mark.parametrize("big", [False, True])
def test_depth_is_in_metres(big: bool) -> None:
    millimetres = np.array([[0, 1500], [65000, 1]], ">u2" if big else "<u2")
    metres = np.array([[np.nan, 1.5], [-1.0, np.inf]], ">f4" if big else "<f4")

    from_millimetres = depth_in_metres(image(millimetres, "16UC1", big=big), "/d")
    from_metres = depth_in_metres(image(metres, "32FC1", big=big), "/d")

    np.testing.assert_allclose(from_millimetres, [[0, 1.5], [65, 0.001]], rtol=1e-6)
    np.testing.assert_array_equal(from_metres, [[0, 1.5], [0, 0]])


@pytest.mark.parametrize(
    "wrong", [{"encoding": "bayer_rggb8"}, {"step": 3}, {"height": 400}, {"width": 0}]
)
def test_a_picture_whose_bytes_do_not_fit_is_refused(wrong: dict[str, Any]) -> None:
    message = image(np.zeros((4, 6, 3), np.uint8), "rgb8")
    for name, value in wrong.items():
        setattr(message, name, value)

    with pytest.raises(DatasetError) as error:
        pixels_of(message, "/c")
    assert error.value.code == "bag.picture"


# Poses


@settings(deadline=None)
@given(poses, st.integers(0, 2**32 - 1))
def test_the_covariance_is_that_of_position_and_turn_in_the_world(pose: Pose, seed: int) -> None:
    factor = np.random.default_rng(seed).normal(size=(6, 6)) * 1e-3
    covariance = factor @ factor.T

    stated = ros_covariance(pose, covariance)

    # Each column of the factor is one deviation; move the pose by it and look at the device.
    moved = []
    for w, dt in zip(factor.T[:, :3] * 1e-3, factor.T[:, 3:] * 1e-3, strict=True):
        angle = np.linalg.norm(w)
        turned = Pose.from_quaternion(
            (np.cos(angle / 2), *np.sin(angle / 2) * w / angle), (0, 0, 0)
        )
        other = Pose(turned.rotation @ pose.rotation, pose.translation + dt).inverse()
        spin = other.rotation @ pose.rotation
        axis = np.array([spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]])
        moved.append(np.concatenate([other.translation - pose.center, axis / 2]) * 1e3)
    deviations = np.array(moved).T
    np.testing.assert_allclose(stated, deviations @ deviations.T, rtol=1e-2, atol=1e-9)


@pytest.mark.parametrize("ros1", [True, False])
def test_what_is_written_is_read_again(tmp_path: Path, ros1: bool) -> None:
    path = tmp_path / ("poses.bag" if ros1 else "poses")
    pose = Pose.from_quaternion((0.5, 0.5, -0.5, 0.5), (1, 2, 3))
    covariance = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03])

    write_poses(path, "/pose", "map", [PoseStamped(12_000_000_034, pose, covariance)], ros1=ros1)

    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    if not ros1:  # nothing hidden, which a copy of poses/* would leave behind
        assert {each.name for each in path.iterdir()} == {"metadata.yaml", "poses.db3"}
    with open_bag(path) as bag:
        assert bag.photos == ()
        ((topic, message),) = bag.messages(["/pose"])
    assert topic == "/pose"
    assert message.header.frame_id == "map"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 34)
    at = message.pose.pose
    np.testing.assert_allclose([at.position.x, at.position.y, at.position.z], pose.center)
    q = at.orientation
    read = Pose.from_quaternion((q.w, q.x, q.y, q.z), (0, 0, 0))
    np.testing.assert_allclose(read.rotation, pose.rotation.T, atol=1e-12)
    np.testing.assert_allclose(
        np.reshape(message.pose.covariance, (6, 6)), ros_covariance(pose, covariance)
    )
    with pytest.raises(Conflict):
        write_poses(path, "/pose", "map", [], ros1=ros1)


@pytest.mark.parametrize("content", [b"", b"#ROSBAG V2.0\n", b"#ROSBAG V2.0\n" + bytes(5000)])
def test_a_file_that_is_no_bag_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.bag"
    path.write_bytes(content)

    with pytest.raises(DatasetError) as error, open_bag(path):
        pass
    assert error.value.code == "bag.unreadable"
    with pytest.raises(DatasetError, match="nothing there"), open_bag(tmp_path / "none.bag"):
        pass


# Bags


@pytest.fixture(params=[True, False], ids=["ros1", "ros2"])
def made(request: pytest.FixtureRequest) -> Made:
    return Made(request.param)


_PIXELS = np.zeros((4, 6, 3), np.uint8)


def photo_of(made: Made, topic: str, encoding: str = "rgb8") -> tuple[str, str, int, Any]:
    pixels = _PIXELS[..., 0] if encoding.startswith("bayer") else _PIXELS
    return topic, "sensor_msgs/msg/Image", 1, made.image(SECOND, "camera", pixels, encoding)


def copy_of(made: Made, topic: str) -> tuple[str, str, int, Any]:
    message = made.file(SECOND, "camera", b"\xff\xd8")
    return f"{topic}/compressed", "sensor_msgs/msg/CompressedImage", 1, message


def test_each_photo_comes_once_and_an_encoding_that_we_lack_is_told(
    made: Made, tmp_path: Path
) -> None:
    write_messages(
        tmp_path / "x.bag" if made.ros1 else tmp_path / "x",
        made,
        [
            photo_of(made, "/left/image_raw"),
            copy_of(made, "/left/image_raw"),
            photo_of(made, "/right/image_raw", "bayer_rggb8"),
            copy_of(made, "/right/image_raw"),
        ],
    )

    with open_bag(tmp_path / "x.bag" if made.ros1 else tmp_path / "x") as bag:
        assert bag.photos == ("/left/image_raw", "/right/image_raw/compressed")
        assert bag.left_out == {"/right/image_raw": "its encoding 'bayer_rggb8' is not supported"}
        assert [picture.topic for picture in bag.pictures(bag.photos)] == list(bag.photos)


def test_a_transform_that_is_none_is_passed_over(made: Made, tmp_path: Path) -> None:
    path = tmp_path / ("x.bag" if made.ros1 else "x")
    unset = made.moved(SECOND, "base", "gripper", Pose.identity())
    unset.transforms[0].transform.rotation.w = 0.0
    lost = made.moved(SECOND, "base", "lidar", Pose.identity())
    lost.transforms[0].transform.translation.x = float("nan")
    good = made.moved(SECOND, "base", "camera", Pose.identity())
    kind = "tf2_msgs/msg/TFMessage"
    write_messages(path, made, [("/tf", kind, 1, each) for each in (unset, lost, good)])

    with open_bag(path) as bag:
        assert bag.transforms.pose("base", "camera", SECOND) is not None
        assert not bag.transforms.knows("gripper")
        assert not bag.transforms.knows("lidar")


def test_of_two_odometries_one_counts(made: Made, tmp_path: Path) -> None:
    path = tmp_path / ("x.bag" if made.ros1 else "x")
    kind = "nav_msgs/msg/Odometry"
    messages = []
    for second in (1, 2, 3):
        for topic, x in (("/wheels", second), ("/filtered", 10.0 * second)):
            time_ns = second * SECOND + (topic == "/filtered") * SECOND // 2
            pose = Pose(np.eye(3), np.array([x, 0, 0]))
            message = made.odometry(time_ns, "odom", "base", pose)
            messages.append((topic, kind, time_ns, message))
    write_messages(path, made, messages)

    with open_bag(path) as bag:
        found = bag.transforms.pose("odom", "base", 2 * SECOND)
        beside = bag.transforms.pose("odom", "base", 5 * SECOND // 2)
    assert found is not None
    assert beside is not None
    np.testing.assert_allclose([found.translation[0], beside.translation[0]], [2, 2.5])


@pytest.mark.parametrize("name", ["x/x.db3", "x/metadata.yaml", "x.active", "x"])
def test_a_bag_that_was_cut_off_says_how_to_repair_it(tmp_path: Path, name: str) -> None:
    (tmp_path / "x").mkdir()
    for each in ("x/x.db3", "x.active", *[name] * (name != "x")):
        (tmp_path / each).write_bytes(b"SQLite format 3\0")

    with pytest.raises(DatasetError) as caught, open_bag(tmp_path / name):
        pass
    assert caught.value.code == "bag.unreadable"
    assert caught.value.field == str(tmp_path / name)
    assert "ros2 bag reindex" in str(caught.value.expected)
    assert "is no .bag" in str(caught.value.got) or "without metadata.yaml" in str(caught.value.got)


def test_ros_1_bags_may_be_compressed(tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer

    made = Made(True)
    for way in Writer.CompressionFormat:
        path = tmp_path / f"{way.name}.bag"
        topic, kind, time_ns, message = photo_of(made, "/image")
        writer = Writer(path)
        writer.set_compression(way)
        with writer:
            connection = writer.add_connection(topic, kind, typestore=made.store)
            writer.write(connection, time_ns, made.store.serialize_ros1(message, kind))

        with open_bag(path) as bag:
            (picture,) = bag.pictures(bag.photos)
        assert picture.pixels is not None
        np.testing.assert_array_equal(picture.pixels, _PIXELS)


def test_damage_anywhere_is_a_refusal(made: Made, tmp_path: Path) -> None:
    path = tmp_path / ("x.bag" if made.ros1 else "x")
    moved = made.moved(SECOND, "map", "camera", Pose.identity())
    tf = ("/tf", "tf2_msgs/msg/TFMessage", 1, moved)
    write_messages(path, made, [tf, photo_of(made, "/image"), copy_of(made, "/other")])
    file = path if made.ros1 else next(path.glob("*.db3"))
    good = file.read_bytes()
    random = np.random.default_rng(0)
    refused = []
    for _ in range(60):
        data = bytearray(good)
        for start in random.integers(0, len(data) - 8, 3):
            data[start : start + 8] = random.bytes(8) if random.random() < 0.5 else b"\xff" * 8
        file.write_bytes(data[: random.integers(len(data))] if random.random() < 0.2 else data)
        try:
            with open_bag(path) as bag:
                list(bag.pictures(bag.photos))
        except DatasetError as error:
            refused.append(error.code)
    assert len(refused) > 10
    assert set(refused) <= {"bag.unreadable", "bag.picture", "bag.camera"}
