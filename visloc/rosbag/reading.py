"""A bag: which topics hold photos, their cameras, and the frames they were taken in."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.rosbag.cameras import camera_from_info
from visloc.rosbag.pictures import Picture, is_depth, pixels_of
from visloc.rosbag.transforms import Transforms

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
_OLD_TF = "tf/msg/tfMessage"  # of ROS 1 before tf2
_ODOMETRY = "nav_msgs/msg/Odometry"
_PER_SECOND = 1_000_000_000
# What the reader and the decoders of messages raise for bytes that are not as they should be.
_DAMAGED = (AssertionError, EOFError, IndexError, KeyError, OSError, ValueError, struct.error)


@dataclass(frozen=True, slots=True, eq=False)
class Bag:
    """An open bag.

    Attributes:
        path: the file or folder.
        photos: topics of photos.
        depth: topics of depth pictures.
        cameras: intrinsics by topic of photos or depth; None where the bag does not say.
        transforms: the frames of the bag.
    """

    path: Path
    photos: tuple[str, ...]
    depth: tuple[str, ...]
    cameras: Mapping[str, Camera | None]
    transforms: Transforms
    _reader: Any

    def pictures(self, topics: Sequence[str]) -> Iterator[Picture]:
        """Read the photos of some topics, in the order of the bag.

        Raises:
            DatasetError: ``bag.picture``.
        """
        for topic, message in self.messages(topics):
            time_ns, frame = _stamp(message), _frame(message.header.frame_id)
            if hasattr(message, "format"):
                yield Picture(topic, time_ns, frame, bytes(message.data), None)
            else:
                yield Picture(topic, time_ns, frame, None, pixels_of(message, topic))

    def count(self, topics: Sequence[str]) -> int:
        """Return the number of messages of some topics."""
        return sum(each.msgcount for each in self._reader.connections if each.topic in topics)

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, Any]]:
        """Read the messages of some topics, in the order of the bag.

        Raises:
            DatasetError: ``bag.unreadable``: a message cannot be decoded.
        """
        chosen = [each for each in self._reader.connections if each.topic in topics]
        if chosen:
            yield from _decoded(self._reader, chosen, self.path)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a ROS 1 bag (a file) or a ROS 2 bag (a folder; SQLite or MCAP).

    The whole bag is read once for transforms, but no photo is kept.

    Raises:
        DatasetError: ``bag.unreadable``, ``bag.camera``, ``pose.*``.
        Unavailable: ``bag.no_rosbags``.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise refuse("bag.no_rosbags") from None
    if not path.exists():
        raise refuse("bag.unreadable", field=str(path), got="nothing there")
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    except (AnyReaderError, OSError, ValueError, KeyError) as error:
        raise refuse("bag.unreadable", field=str(path), got=str(error)) from error
    try:
        yield _described(reader, path)
    finally:
        reader.close()


def _described(reader: Any, path: Path) -> Bag:
    of_kind = {
        kind: [each for each in reader.connections if each.msgtype == kind]
        for kind in (_IMAGE, _COMPRESSED, _INFO, _TF, _OLD_TF, _ODOMETRY)
    }
    transforms = _transforms(reader, of_kind[_TF] + of_kind[_OLD_TF], of_kind[_ODOMETRY], path)
    depth: set[str] = set()
    photos: set[str] = set()
    for connection in of_kind[_IMAGE]:
        first = next(_decoded(reader, [connection], path), None)
        if first is not None:
            (depth if is_depth(first[1]) else photos).add(connection.topic)
    # What is compressed as depth has a header of its own before the file.
    photos |= {each.topic for each in of_kind[_COMPRESSED] if "depth" not in each.topic.lower()}
    infos = {each.topic: each for each in of_kind[_INFO]}
    cameras = {
        topic: _camera(reader, infos.get(_info_topic(topic)), path) for topic in photos | depth
    }
    names = tuple(sorted(photos)), tuple(sorted(depth))
    return Bag(path, *names, MappingProxyType(cameras), transforms, reader)


def _info_topic(topic: str) -> str:
    """Return where the camera of a topic is published: beside it, by the transports' convention."""
    parent = topic.rpartition("/")[0]
    if topic.endswith(("/compressed", "/compressedDepth")):
        parent = parent.rpartition("/")[0]
    return f"{parent}/camera_info"


def _camera(reader: Any, connection: Any, path: Path) -> Camera | None:
    if connection is None:
        return None
    first = next(_decoded(reader, [connection], path), None)
    return None if first is None else camera_from_info(first[1], connection.topic)


def _transforms(reader: Any, tf: Sequence[Any], odometry: Sequence[Any], path: Path) -> Transforms:
    found = Transforms()
    for topic, message in _decoded(reader, tf, path) if tf else ():
        for each in message.transforms:
            moved = each.transform
            found.add(
                _frame(each.header.frame_id),
                _frame(each.child_frame_id),
                None if topic.endswith("tf_static") else _stamp(each),
                _pose(moved.rotation, moved.translation),
            )
    children = {each.child_frame_id for _, each in _firsts(reader, odometry, path)}
    from_odometry = {_frame(child) for child in children if not found.knows(_frame(child))}
    for _, message in _decoded(reader, odometry, path) if from_odometry else ():
        child = _frame(message.child_frame_id)
        if child in from_odometry:
            at = message.pose.pose
            pose = _pose(at.orientation, at.position)
            found.add(_frame(message.header.frame_id), child, _stamp(message), pose)
    return found


def _firsts(reader: Any, connections: Sequence[Any], path: Path) -> Iterator[tuple[str, Any]]:
    for connection in connections:
        first = next(_decoded(reader, [connection], path), None)
        if first is not None:
            yield first


def _decoded(reader: Any, connections: Sequence[Any], path: Path) -> Iterator[tuple[str, Any]]:
    from rosbags import rosbag1, rosbag2
    from rosbags.serde import SerdeError

    try:
        for connection, _, raw in reader.messages(connections):
            yield connection.topic, reader.deserialize(raw, connection.msgtype)
    except (*_DAMAGED, rosbag1.ReaderError, rosbag2.ReaderError, SerdeError) as error:
        raise refuse("bag.unreadable", field=str(path), got=str(error)) from error


def _pose(rotation: Any, translation: Any) -> Pose:
    return Pose.from_quaternion(
        (rotation.w, rotation.x, rotation.y, rotation.z),
        (translation.x, translation.y, translation.z),
    )


def _frame(name: str) -> str:
    return name.lstrip("/")  # tf of ROS 1 wrote one


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * _PER_SECOND + int(stamp.nanosec)
