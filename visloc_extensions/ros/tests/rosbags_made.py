"""Bags made of kapture datasets, for tests: what a robot's recorder would have written."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mapping.stages.depth import read_depth
from visloc.geometry import Pose
from visloc.kapture import Dataset

# REP 103: a base looks along x with z up, its camera's optical frame along z with y down.
BASE_FROM_OPTICAL = Pose(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.12, -0.03, 0.4])
)
SECOND = 1_000_000_000
WORLD, BASE = "map", "base_link"


class Made:
    """Messages of one generation of ROS."""

    def __init__(self, ros1: bool) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:  # not among the types that rosbags brings
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))

    def __call__(self, name: str, **fields: Any) -> Any:
        return self.store.types[name](**fields)

    def header(self, time_ns: int, frame: str) -> Any:
        seconds, rest = divmod(time_ns, SECOND)
        stamp = self("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        numbered = {"seq": 0} if self.ros1 else {}
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **numbered)

    def transform(self, time_ns: int, parent: str, child: str, pose: Pose) -> Any:
        w, x, y, z = map(float, pose.rotation_wxyz)
        tx, ty, tz = map(float, pose.translation)
        moved = self(
            "geometry_msgs/msg/Transform",
            translation=self("geometry_msgs/msg/Vector3", x=tx, y=ty, z=tz),
            rotation=self("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )
        return self(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time_ns, parent),
            child_frame_id=child,
            transform=moved,
        )

    def moved(self, time_ns: int, parent: str, child: str, pose: Pose) -> Any:
        """Return a message of tf with one transform."""
        transforms = [self.transform(time_ns, parent, child, pose)]
        return self("tf2_msgs/msg/TFMessage", transforms=transforms)

    def odometry(self, time_ns: int, parent: str, child: str, pose: Pose) -> Any:
        """Return odometry that stands still there."""
        w, x, y, z = map(float, pose.rotation_wxyz)
        px, py, pz = map(float, pose.translation)
        at = self(
            "geometry_msgs/msg/Pose",
            position=self("geometry_msgs/msg/Point", x=px, y=py, z=pz),
            orientation=self("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )
        still = self("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self("geometry_msgs/msg/Twist", linear=still, angular=still)
        none = np.zeros(36)
        return self(
            "nav_msgs/msg/Odometry",
            header=self.header(time_ns, parent),
            child_frame_id=child,
            pose=self("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=none),
            twist=self("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
        )

    def file(self, time_ns: int, frame: str, encoded: bytes) -> Any:
        """Return a compressed picture."""
        return self(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(time_ns, frame),
            format="jpeg",
            data=np.frombuffer(encoded, np.uint8),
        )

    def image(self, time_ns: int, frame: str, pixels: Any, encoding: str) -> Any:
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
        return self(
            "sensor_msgs/msg/Image",
            header=self.header(time_ns, frame),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=len(data) // height,
            data=data,
        )

    def info(self, time_ns: int, frame: str, camera: Any) -> Any:
        fx, fy, cx, cy = camera.params
        k = np.array([fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1])
        names = ("D", "K", "R", "P") if self.ros1 else ("d", "k", "r", "p")
        numbers = (np.zeros(5), k, np.eye(3).reshape(-1), np.zeros(12))
        region = self(
            "sensor_msgs/msg/RegionOfInterest",
            **{"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
        )
        return self(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(time_ns, frame),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=region,
            **dict(zip(names, numbers, strict=True)),
        )


def write_messages(path: Path, made: Made, messages: Iterable[tuple[str, str, int, Any]]) -> None:
    """Write messages: topic, kind, time of arrival (ns), message."""
    from rosbags import rosbag1, rosbag2

    opened: Any = rosbag1.Writer(path) if made.ros1 else rosbag2.Writer(path, version=8)
    encode = made.store.serialize_ros1 if made.ros1 else made.store.serialize_cdr
    connections: dict[str, Any] = {}
    with opened as writer:
        for topic, kind, time_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=made.store)
            writer.write(connections[topic], time_ns, encode(message, kind))


def write_bag(
    path: Path, dataset: Dataset, *, ros1: bool, compressed: bool = False, depth: bool = True
) -> None:
    """Write the photos of one camera of a dataset, a second apart, with tf and depth."""
    from rosbags import rosbag1, rosbag2

    made = Made(ros1)
    sensor = dataset.images[0].sensor_id
    images = [record for record in dataset.images if record.sensor_id == sensor]
    camera = dataset.sensors[sensor].camera
    depths = {r.timestamp: r for r in dataset.depth_maps if r.sensor_id.startswith(sensor)}
    optical = "camera_optical_frame"
    opened: Any = rosbag1.Writer(path) if ros1 else rosbag2.Writer(path, version=8)
    with opened as writer:

        def topic(name: str, kind: str) -> Any:
            connection = writer.add_connection(name, kind, typestore=made.store)
            encode = made.store.serialize_ros1 if ros1 else made.store.serialize_cdr
            return lambda time_ns, message: writer.write(connection, time_ns, encode(message, kind))

        kind = "sensor_msgs/msg/CompressedImage" if compressed else "sensor_msgs/msg/Image"
        photo = topic(f"/camera/{'image/compressed' if compressed else 'image'}", kind)
        info = topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo")
        aligned = topic("/depth/image", "sensor_msgs/msg/Image") if depth else None
        tf, static = (topic(name, "tf2_msgs/msg/TFMessage") for name in ("/tf", "/tf_static"))
        static(SECOND, made.moved(0, BASE, optical, BASE_FROM_OPTICAL))
        for number, record in enumerate(images):
            time_ns = (number + 1) * SECOND
            cam_from_world = dataset.pose(record)
            assert cam_from_world is not None
            base_in_map = cam_from_world.inverse() @ BASE_FROM_OPTICAL.inverse()
            tf(time_ns, made.moved(time_ns, WORLD, BASE, base_in_map))
            info(time_ns, made.info(time_ns, optical, camera))
            file = dataset.path_of(record)
            if compressed:
                photo(time_ns, made.file(time_ns, optical, file.read_bytes()))
            else:
                pixels = cv2.imread(str(file))
                photo(time_ns, made.image(time_ns, optical, pixels, "bgr8"))
            if aligned is not None and record.timestamp in depths:
                path_of_depth = dataset.path_of(depths[record.timestamp])
                metres = np.nan_to_num(read_depth(path_of_depth, camera, 0.001))
                distances = np.round(metres * 1000).astype(np.uint16)
                aligned(time_ns + 1000, made.image(time_ns + 1000, optical, distances, "16UC1"))
