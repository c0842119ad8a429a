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
from visloc_extensions.ros.cameras import camera_from_info, is_cropped
from visloc_extensions.ros.pictures import Picture, has_known_colors, is_depth, pixels_of
from visloc_extensions.ros.transforms import Transforms

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
_OLD_TF = "tf/msg/tfMessage"  # of ROS 1 before tf2
_ODOMETRY = "nav_msgs/msg/Odometry"
_PER_SECOND = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Bag:
    """An open bag.

    Attributes:
        photos: topics of photos; without compressed copies of others.
        left_out: other topics of pictures, and why: their encoding, such as Bayer patterns, or
            their camera.
        cameras: intrinsics by topic of photos or depth; None where the bag does not say.
        cropped: topics whose camera is of a part of the sensor, and of no other size of picture.
        on_cameras: what was assumed of cameras, and which ``camera_info`` was not used.
        unstamped: topics of messages without a stamp, which have their time of arrival; grows
            while the bag is read.
        transforms: the frames of the bag.
    """

    path: Path
    photos: tuple[str, ...]
    depth: tuple[str, ...]
    left_out: Mapping[str, str]
    cameras: Mapping[str, Camera | None]
    cropped: frozenset[str]
    on_cameras: tuple[str, ...]
    unstamped: set[str]
    transforms: Transforms
    _reader: Any

    def check_has_photos(self) -> None:
        """Raise ``bag.no_photos``, which says what the pictures are, if no topic holds photos."""
        if not self.photos:
            others = dict.fromkeys(self.depth, "depth") | dict(self.left_out)
            got = "; ".join(f"{topic}: {why}" for topic, why in sorted(others.items()))
            raise refuse("bag.no_photos", field=str(self.path), got=got or None)

    def notes(self) -> list[str]:
        """Return what was left out or assumed, as far as the bag was read."""
        timed = "messages without a stamp (0) have their time of arrival, which is later"
        return [
            *(f"{topic}: left out, {why}" for topic, why in sorted(self.left_out.items())),
            *self.on_cameras,
            *(f"{each}: {timed}" for each in sorted(self.unstamped) if "tf_static" not in each),
        ]

    def pictures(self, topics: Sequence[str]) -> Iterator[Picture]:
        """Read the photos of some topics, in the order of the bag."""
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
        """Read the messages of some topics, in the order of the bag."""
        chosen = [each for each in self._reader.connections if each.topic in topics]
        if chosen:
            with _reading(self.path):
                yield from _decoded(self._reader, chosen, self.unstamped)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a ROS 1 bag (a file) or a ROS 2 bag (a folder; SQLite or MCAP).

    The whole bag is read once for transforms, but no photo is kept.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise refuse("bag.no_rosbags") from None
    if not path.exists():
        raise refuse("bag.unreadable", field=str(path), got="nothing there")
    if path.suffix != ".bag" and not (path / "metadata.yaml").is_file():
        got = "a folder without metadata.yaml" if path.is_dir() else "a file that is no .bag"
        raise refuse("bag.unreadable", field=str(path), got=got)
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
    unstamped: set[str] = set()
    tf = of_kind[_TF] + of_kind[_OLD_TF]
    transforms = _transforms(reader, tf, of_kind[_ODOMETRY], unstamped)
    firsts = dict(_firsts(reader, of_kind[_IMAGE] + of_kind[_COMPRESSED]))
    compressed = {topic for topic, first in firsts.items() if hasattr(first, "format")}
    depth = {t for t in firsts.keys() - compressed if is_depth(firsts[t], t)}
    photos = {t for t in firsts.keys() - compressed - depth if has_known_colors(firsts[t])}
    left_out = {
        topic: f"its encoding {firsts[topic].encoding!r} is not supported"
        + " unless its name says depth" * (firsts[topic].encoding == "mono16")
        for topic in firsts.keys() - compressed - depth - photos
    }
    # What is compressed as depth has a header of its own before the file.
    packed = {topic for topic in compressed if "depth" in topic.lower()}
    left_out |= dict.fromkeys(packed, "compressed depth is not read")
    photos |= {topic for topic in compressed - packed if _base_topic(topic) not in photos}
    infos = dict(_firsts(reader, of_kind[_INFO]))
    frames = {topic: _frame(firsts[topic].header.frame_id) for topic in sorted(photos | depth)}
    info_of, notes = _infos_of(infos, frames)
    cameras: dict[str, Camera | None] = {}
    for topic in frames:
        try:
            cameras[topic] = _camera(infos, info_of.get(topic), topic)
        except VislocError as error:
            left_out[topic] = f"{error.message} ({error.got})"
    names = tuple(t for t in cameras if t in photos), tuple(t for t in cameras if t in depth)
    tables = MappingProxyType(left_out), MappingProxyType(cameras)
    cropped = frozenset(each for each, info in info_of.items() if is_cropped(infos[info]))
    return Bag(path, *names, *tables, cropped, notes, unstamped, transforms, reader)


def _base_topic(topic: str) -> str:
    """Return the topic that a transport of ``image_transport`` publishes, such as compressed."""
    base, _, transport = topic.rpartition("/")
    return base if transport in ("compressed", "compressedDepth") else topic


def _infos_of(
    infos: Mapping[str, Any], frames: Mapping[str, str]
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the ``camera_info`` of topics of pictures, whose frames are given, and notes.

    It is published beside the pictures by the transports' convention, or under them; else it is
    the only one of their frame that no other pictures have.
    """
    found: dict[str, str] = {}
    for topic in frames:
        base = _base_topic(topic)
        for beside in (f"{base.rpartition('/')[0]}/camera_info", f"{base}/camera_info"):
            if beside in infos:
                found.setdefault(topic, beside)
    free = {name: _frame(infos[name].header.frame_id) for name in infos.keys() - found.values()}
    notes = []
    for topic, frame in frames.items():
        alike = [name for name, of_info in free.items() if frame and of_info == frame]
        if topic not in found and len(alike) == 1:
            found[topic] = alike[0]
            notes.append(f"{topic}: its camera is that of {alike[0]}, which is of the same frame")
    unused = sorted(infos.keys() - found.values())
    notes += [f"{name}: not used, no topic of pictures is clearly of its camera" for name in unused]
    return found, tuple(notes)


def _camera(infos: Mapping[str, Any], info_topic: str | None, topic: str) -> Camera | None:
    if info_topic is None:
        return None
    rectified = _base_topic(topic).rpartition("/")[2].startswith("image_rect")
    return camera_from_info(infos[info_topic], info_topic, rectified=rectified)


def _transforms(
    reader: Any, tf: Sequence[Any], odometry: Sequence[Any], unstamped: set[str]
) -> Transforms:
    found = Transforms()
    for topic, message in _decoded(reader, tf, unstamped) if tf else ():
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
    for topic, message in _decoded(reader, odometry, unstamped) if told_by else ():
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
        first = next(_decoded(reader, [connection], set()), None)
        if first is not None:
            yield first


def _decoded(
    reader: Any, connections: Sequence[Any], unstamped: set[str]
) -> Iterator[tuple[str, Any]]:
    """Decode messages; those without a stamp get that of their arrival, and are told of."""
    for connection, arrival, raw in reader.messages(connections):
        message = reader.deserialize(raw, connection.msgtype)
        for each in getattr(message, "transforms", (message,)):
            if _stamp(each) == 0:  # as simulators without a clock write
                unstamped.add(connection.topic)
                each.header.stamp.sec, each.header.stamp.nanosec = divmod(arrival, _PER_SECOND)
        yield connection.topic, message


def _frame(name: str) -> str:
    return name.lstrip("/")  # tf of ROS 1 wrote one


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * _PER_SECOND + int(stamp.nanosec)
