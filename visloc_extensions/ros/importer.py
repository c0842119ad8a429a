"""ROS 1 and ROS 2 bags: photos, cameras, depth, and poses from tf or odometry.

Photos are written to a folder, as published where they were compressed, else as PNG. The world is
the outermost frame above the cameras, such as ``map`` or ``odom`` (REP 105).
"""

from __future__ import annotations

import itertools
import re
import shutil
from bisect import bisect_left
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapping.importers.dataset import depth_sensor_id
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.photo_names import photo_size
from mapping.importers.reading.poses import has_moved
from mapping.stages.depth import DEFAULT_DEPTH_SCALE
from visloc.errors import DatasetError, refuse
from visloc.geometry import Camera, Pose
from visloc.kapture import Sensor
from visloc.kapture.dataset import UNKNOWN_CAMERA
from visloc_extensions.ros.pictures import Picture, depth_in_metres
from visloc_extensions.ros.reading import Bag, open_bag

# Without poses, a photo is taken when so long has passed since the last one.
_STEP_NS = 500_000_000
_SAME_TIME_NS = 20_000_000  # a depth picture of the same moment
_MOST_UNITS = np.iinfo(np.uint16).max


@dataclass(slots=True)
class _Topic:
    """A topic of photos, and what was taken of it.

    Attributes:
        sensor: its id in the dataset, and the folder of its photos.
        last: the photo that was taken last: its time, and ``world_from_cam``.
        camera: of photos of ``size``; None where the bag does not say.
        wrong: why its photos are left out after all; None for others.
        depth_camera: of the depth that the photos have; None without.
    """

    name: str
    sensor: str
    world: str | None = None
    last: tuple[int, Pose | None] | None = None
    seen: int = 0
    unposed: int = 0
    unreadable: int = 0
    frame: str = ""
    size: tuple[int, int] | None = None
    camera: Camera | None = None
    wrong: str | None = None
    depth_camera: Camera | None = None
    images: list[ImportedImage] = field(default_factory=list)
    times: set[int] = field(default_factory=set)


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read a bag, and write its photos; a new folder of photos is removed if this fails.

    Args:
        path: a ``.bag`` of ROS 1, or the folder of a ROS 2 bag.
        photos: the folder that the photos are written to; None makes ``<bag>_photos`` beside it.
    """
    with open_bag(path) as bag:
        bag.check_has_photos()
        path = path.resolve()  # "." has no name
        folder = path.with_name(f"{path.stem}_photos") if photos is None else photos
        is_new = not folder.exists()
        try:
            return _read(bag, folder)
        except BaseException:
            if is_new:
                shutil.rmtree(folder, ignore_errors=True)
            raise


read.makes_photos = True  # type: ignore[attr-defined]  # their folder need not exist


def _read(bag: Bag, folder: Path) -> ImportedModel:
    topics = {name: _Topic(name, sensor) for name, sensor in _sensors(bag.photos).items()}
    for picture in bag.pictures(bag.photos):
        _take(bag, topics[picture.topic], picture, folder)
    for topic in topics.values():
        topic.images.sort(key=lambda image: image.timestamp)  # bags are in order of arrival
    depth_topics = _add_depth(bag, topics.values(), folder)
    return _model(bag, list(topics.values()), depth_topics, folder)


def _sensors(topics: Iterable[str]) -> dict[str, str]:
    """Return the sensor of each topic; its id is also the name of a folder, so no path."""
    named: dict[str, str] = {}
    taken: set[str] = set()
    for topic in topics:
        base = re.sub(r"[^\w.-]+", "_", topic.strip("/")).strip(".") or "camera"
        names = itertools.chain([base], (f"{base}-{number}" for number in itertools.count(2)))
        name = next(each for each in names if not taken & {each, depth_sensor_id(each)})
        named[topic] = name
        taken |= {name, depth_sensor_id(name)}
    return named


def _take(bag: Bag, topic: _Topic, picture: Picture, folder: Path) -> None:
    """Write a photo and note it, unless the camera has hardly moved since the last."""
    topic.seen += 1
    if topic.wrong is not None:
        return
    if not topic.frame:
        topic.frame = picture.frame
        if bag.transforms.moves(picture.frame):
            topic.world = bag.transforms.root_of(picture.frame)
    world_from_cam = None
    if topic.world is not None:
        world_from_cam = bag.transforms.pose(topic.world, picture.frame, picture.time_ns)
        if world_from_cam is None:
            topic.unposed += 1
            return
    if picture.time_ns in topic.times or not _is_new(topic.last, picture.time_ns, world_from_cam):
        return
    name = f"{topic.sensor}/{picture.time_ns}{_suffix(picture)}"
    _write(folder / name, picture)
    try:
        size = photo_size(folder / name)
        if topic.size is None and size is not None:
            topic.camera, topic.size = _fitted(bag, topic.name, size), size
    except DatasetError as error:
        (folder / name).unlink()
        if error.code == "bag.camera":
            topic.wrong = f"{error.message} (expected {error.expected}, got {error.got})"
        topic.unreadable += 1  # one broken photo of an hour
        return
    topic.times.add(picture.time_ns)
    topic.last = picture.time_ns, world_from_cam
    pose = None if world_from_cam is None else world_from_cam.inverse()
    topic.images.append(ImportedImage(name, topic.sensor, picture.time_ns, pose))


def _is_new(last: tuple[int, Pose | None] | None, time_ns: int, pose: Pose | None) -> bool:
    if last is None:
        return True
    if pose is None or last[1] is None:
        return abs(time_ns - last[0]) >= _STEP_NS
    return has_moved(last[1].inverse(), pose.inverse())


def _suffix(picture: Picture) -> str:
    if picture.encoded is None or picture.encoded.startswith(b"\x89PNG"):
        return ".png"
    return ".jpg"


def _write(path: Path, picture: Picture) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(picture.file())


def _write_depth(path: Path, millimetres: NDArray[np.uint16]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, encoded = cv2.imencode(".png", millimetres)
    assert ok  # of any array of this kind
    path.write_bytes(encoded.tobytes())


def _add_depth(bag: Bag, topics: Iterable[_Topic], folder: Path) -> dict[str, str]:
    """Give photos the depth pictures of their frame and moment; return the topic of each sensor.

    Depth without intrinsics, its own or those of the photos, is left out.
    """
    found: dict[str, str] = {}
    for depth in bag.depth:
        for _, message in bag.messages([depth]):
            frame = message.header.frame_id.lstrip("/")
            stamp = message.header.stamp
            time_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
            for topic in topics:
                if topic.frame != frame or found.get(topic.sensor, depth) != depth:
                    continue
                index = _nearest(topic.images, time_ns)
                if index is None or topic.images[index].depth is not None:
                    continue
                image = topic.images[index]
                name = f"{depth_sensor_id(topic.sensor)}/{image.timestamp}.png"
                units = np.round(depth_in_metres(message, depth) / DEFAULT_DEPTH_SCALE)
                with suppress(DatasetError):
                    height, width = units.shape
                    topic.depth_camera = _fitted(bag, depth, (width, height)) or topic.camera
                if topic.depth_camera is None:
                    continue
                units[units > _MOST_UNITS] = 0  # further than a depth map can say
                _write_depth(folder / name, units.astype(np.uint16))
                topic.images[index] = replace(image, depth=name)
                found[topic.sensor] = depth
    return found


def _nearest(images: list[ImportedImage], time_ns: int) -> int | None:
    times = [image.timestamp for image in images]
    after = bisect_left(times, time_ns)
    near = [i for i in (after - 1, after) if 0 <= i < len(times)]
    best = min(near, key=lambda i: abs(times[i] - time_ns), default=None)
    return best if best is not None and abs(times[best] - time_ns) <= _SAME_TIME_NS else None


def _model(
    bag: Bag, topics: list[_Topic], depth_topics: dict[str, str], folder: Path
) -> ImportedModel:
    sensors: dict[str, Sensor] = {}
    notes = bag.notes()
    unused = [topic for topic in bag.depth if topic not in depth_topics.values()]
    notes += [f"{topic}: depth left out, of no photo's frame, time and camera" for topic in unused]
    for topic in topics:
        if topic.wrong is not None:
            notes.append(f"{topic.name}: left out, {topic.wrong}")
            continue
        taken = len(topic.images)
        notes.append(f"{topic.name}: {taken} of {topic.seen} photos taken, written to {folder}")
        if topic.unposed:
            notes.append(f"{topic.name}: {topic.unposed} photos lie outside the time of tf")
        if topic.unreadable:
            notes.append(f"{topic.name}: {topic.unreadable} photos cannot be read")
        if topic.world is None:
            notes.append(f"{topic.name}: nothing tells how its frame {topic.frame!r} moves")
        else:
            notes.append(f"{topic.name}: the world is the frame {topic.world!r}")
        if topic.size is None:
            continue
        told = bag.cameras[topic.name]
        if told is not None and topic.camera != told:
            size = f"{told.width} x {told.height}"
            notes.append(f"{topic.name}: its camera, of {size}, is scaled to its photos")
        sensors[topic.sensor] = (
            Sensor(topic.sensor, "", "camera", (UNKNOWN_CAMERA, *map(str, topic.size)), None)
            if topic.camera is None
            else Sensor.with_camera(topic.sensor, topic.camera)
        )
        if topic.depth_camera is not None:
            depth = depth_sensor_id(topic.sensor)
            sensors[depth] = Sensor.with_camera(depth, topic.depth_camera, "depth")
    worlds = {topic.world for topic in topics if topic.images}
    if len(worlds) > 1:
        raise refuse("bag.worlds", field=str(bag.path), got=sorted(map(str, worlds)))
    images = tuple(image for topic in topics for image in topic.images)
    if not images:
        message = "no photo has a pose and a camera that can be used"
        raise refuse("bag.no_photos", message, field=str(bag.path), got=notes)
    return ImportedModel(
        sensors=sensors,
        images=images,
        photos=folder,
        metric=None not in worlds,
        notes=tuple(notes),
    )


def _fitted(bag: Bag, topic: str, size: tuple[int, int]) -> Camera | None:
    """Return the camera of pictures of a size, None where the bag does not say, or refuse it."""
    camera = bag.cameras[topic]
    if camera is None or (camera.width, camera.height) == size:
        return camera
    if topic in bag.cropped or not camera.has_aspect_of(*size):
        raise refuse(
            "bag.camera",
            "the camera of a topic is of another size than its pictures",
            field=topic,
            expected=f"{camera.width} x {camera.height}",
            got=f"{size[0]} x {size[1]}",
        )
    return camera.scaled(*size)
