"""A bag: which topics hold photos, their cameras, and the frames they were taken in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from visloc.errors import InvalidInput, VislocError, refuse
from visloc.geometry import Camera, Pose
from visloc.rosbag.cameras import camera_from_info
from visloc.rosbag.pictures import Picture, has_known_colors, is_depth, pixels_of
from visloc.rosbag.transforms import Transforms

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
_OLD_TF = "tf/msg/tfMessage"  # of ROS 1 before tf2
_ODOMETRY = "nav_msgs/msg/Odometry"
_PER_SECOND = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Bag:
    """An open bag.

    Attributes:
        path: the file or folder.
        photos: topics of photos; without compressed copies of others.
        depth: topics of depth pictures.
        left_out: topics of pictures whose encoding we lack, such as Bayer patterns, and the
            encoding.
        cameras: intrinsics by topic of photos or depth; None where the bag does not say.
        transforms: the frames of the bag.
    """

    path: Path
    photos: tuple[str, ...]
    depth: tuple[str, ...]
    left_out: Mapping[str, str]
    cameras: Mapping[str, Camera | None]
    transforms: Transforms
    _reader: Any

    def pictures(self, topics: Sequence[str]) -> Iterator[Picture]:
        """Read the photos of some topics, in the order of the bag.

        Raises:
            DatasetError: ``bag.picture``; ``bag.unreadable``: a message cannot be decoded.
        """
        with _reading(self.path):
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
            with _reading(self.path):
                yield from _decoded(self._reader, chosen)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a ROS 1 bag (a file) or a ROS 2 bag (a folder; SQLite or MCAP).

    The whole bag is read once for transforms, but no photo is kept.

    Raises:
        DatasetError: ``bag.unreadable``, ``bag.camera``.
        Unavailable: ``bag.no_rosbags``.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise refuse("bag.no_rosbags") from None
    if not path.exists():
        raise refuse("bag.unreadable", field=str(path), got="nothing there")
    with ExitStack() as opened:
        with _reading(path):
            types = get_typestore(Stores.LATEST)
            reader = opened.enter_context(AnyReader([path], default_typestore=types))
            bag = _described(reader, path)
        yield bag


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Refuse a bag that cannot be read.

    Its bytes go through databases, decompressors and decoders that are made of the types that the
    bag itself describes. Each has exceptions of its own.

    Raises:
        DatasetError: ``bag.unreadable``.
    """
    try:
        yield
    except VislocError:
        raise
    except Exception as error:
        got = f"{type(error).__name__}: {error}"[:300]
        raise refuse("bag.unreadable", field=str(path), got=got) from error


def _described(reader: Any, path: Path) -> Bag:
    of_kind = {
        kind: [each for each in reader.connections if each.msgtype == kind]
        for kind in (_IMAGE, _COMPRESSED, _INFO, _TF, _OLD_TF, _ODOMETRY)
    }
    transforms = _transforms(reader, of_kind[_TF] + of_kind[_OLD_TF], of_kind[_ODOMETRY])
    depth: set[str] = set()
    photos: set[str] = set()
    left_out: dict[str, str] = {}
    for topic, first in _firsts(reader, of_kind[_IMAGE]):
        if is_depth(first):
            depth.add(topic)
        elif has_known_colors(first):
            photos.add(topic)
        else:
            left_out[topic] = first.encoding
    # What is compressed as depth has a header of its own before the file.
    compressed = {each.topic for each in of_kind[_COMPRESSED] if "depth" not in each.topic.lower()}
    photos |= {topic for topic in compressed if _base_topic(topic) not in photos}
    infos = dict(_firsts(reader, of_kind[_INFO]))
    cameras = {topic: _camera(infos, topic) for topic in photos | depth}
    names = tuple(sorted(photos)), tuple(sorted(depth))
    tables = MappingProxyType(left_out), MappingProxyType(cameras)
    return Bag(path, *names, *tables, transforms, reader)


def _base_topic(topic: str) -> str:
    """Return the topic that a transport of ``image_transport`` publishes, such as compressed."""
    base, _, transport = topic.rpartition("/")
    return base if transport in ("compressed", "compressedDepth") else topic


def _camera(infos: Mapping[str, Any], topic: str) -> Camera | None:
    """Return the camera of a topic, which is published beside it by the transports' convention."""
    parent, _, name = _base_topic(topic).rpartition("/")
    info_topic = f"{parent}/camera_info"
    if info_topic not in infos:
        return None
    rectified = name.startswith("image_rect")
    return camera_from_info(infos[info_topic], info_topic, rectified=rectified)


def _transforms(reader: Any, tf: Sequence[Any], odometry: Sequence[Any]) -> Transforms:
    found = Transforms()
    for topic, message in _decoded(reader, tf) if tf else ():
        for each in message.transforms:
            moved = each.transform
            time_ns = None if topic.endswith("tf_static") else _stamp(each)
            parent, child = _frame(each.header.frame_id), _frame(each.child_frame_id)
            _add(found, parent, child, time_ns, moved.rotation, moved.translation)
    # Where several topics tell how one frame moves, such as wheels and a filter, one is taken:
    # their drifts differ.
    told_by: dict[str, str] = {}
    for topic, message in _firsts(reader, odometry):
        child = _frame(message.child_frame_id)
        if not found.knows(child):
            told_by.setdefault(child, topic)
    for topic, message in _decoded(reader, odometry) if told_by else ():
        child = _frame(message.child_frame_id)
        if told_by.get(child) == topic:
            at, parent = message.pose.pose, _frame(message.header.frame_id)
            _add(found, parent, child, _stamp(message), at.orientation, at.position)
    return found


def _add(
    found: Transforms, parent: str, child: str, time_ns: int | None, rotation: Any, position: Any
) -> None:
    """Add a transform; one that is none, such as an unset quaternion of zeros, is passed over."""
    try:
        pose = Pose.from_quaternion(
            (rotation.w, rotation.x, rotation.y, rotation.z), (position.x, position.y, position.z)
        )
    except InvalidInput:
        return
    found.add(parent, child, time_ns, pose)


def _firsts(reader: Any, connections: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    for connection in connections:
        first = next(_decoded(reader, [connection]), None)
        if first is not None:
            yield first


def _decoded(reader: Any, connections: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    for connection, _, raw in reader.messages(connections):
        yield connection.topic, reader.deserialize(raw, connection.msgtype)


def _frame(name: str) -> str:
    return name.lstrip("/")  # tf of ROS 1 wrote one


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * _PER_SECOND + int(stamp.nanosec)
