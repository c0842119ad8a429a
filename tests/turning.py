"""What a camera stores that was held turned, for tests of EXIF orientations."""

from __future__ import annotations

import io
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, Sensor, read_dataset, write_dataset
from visloc.photos.reading import read_photo_file

# Counterclockwise quarter turns from the upright picture to the stored pixels. Orientations 2, 4, 5
# and 7 ask viewers to mirror the picture as well; the stored pixels are what the camera saw.
QUARTER_TURNS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}
# One quarter turn takes pixel (u, v) to (v, width - u), and the camera's axes (x, y) to (y, -x).
_QUARTER = Pose(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


def turned_pixels(pixels: NDArray[np.generic], orientation: int) -> NDArray[np.generic]:
    """The stored pixels of an upright picture (H, W) or (H, W, 3)."""
    return np.ascontiguousarray(np.rot90(pixels, QUARTER_TURNS[orientation]))


def turned_points(
    points: NDArray[np.floating], size: tuple[int, int], orientation: int
) -> NDArray[np.floating]:
    """Move points (N, 2) of an upright picture of this width and height to the stored pixels."""
    width, height = size
    for _ in range(QUARTER_TURNS[orientation]):
        points = np.column_stack([points[:, 1], width - points[:, 0]])
        width, height = height, width
    return points


def turned_camera(camera: Camera, orientation: int) -> Camera:
    """The PINHOLE camera of the stored pixels."""
    for _ in range(QUARTER_TURNS[orientation]):
        fx, fy, cx, cy = camera.params
        camera = Camera("PINHOLE", camera.height, camera.width, (fy, fx, cy, camera.width - cx))
    return camera


def turned_pose(cam_from_world: Pose, orientation: int) -> Pose:
    """The pose of the camera of the stored pixels."""
    for _ in range(QUARTER_TURNS[orientation]):
        cam_from_world = _QUARTER @ cam_from_world
    return cam_from_world


def png(pixels: NDArray[np.generic], orientation: int = 1) -> bytes:
    """Encode stored pixels without loss, with their EXIF orientation."""
    if pixels.dtype == np.uint16:  # Pillow has no 16-bit colour
        return cv2.imencode(".png", pixels[..., ::-1])[1].tobytes()
    exif = Image.Exif()
    exif[0x0112] = orientation
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", exif=exif)
    return buffer.getvalue()


def store_photo_turned(path: Path, orientation: int) -> None:
    """Replace a photo by what a camera would have stored that was held turned."""
    path.write_bytes(png(turned_pixels(read_photo_file(path).rgb, orientation), orientation))


def store_dataset_turned(source: Path, target: Path) -> dict[str, int]:
    """Write an RGB-D dataset as cameras would have stored it that were held turned.

    The photos take turns at orientations 1 to 8, with cameras, poses and depth maps of the stored
    pixels.

    Returns:
        The orientation of each photo by name.
    """
    dataset = read_dataset(source)
    depth_of = {(d.timestamp, d.sensor_id): d for d in dataset.depth_maps}
    turned = Dataset(target, {}, {}, {}, (), (), ())
    orientations = {}
    for row, record in enumerate(dataset.images):
        orientation = row % 8 + 1
        orientations[record.path] = orientation
        depth = depth_of[record.timestamp, f"{record.sensor_id}_depth"]
        camera, pose = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        assert camera is not None
        assert pose is not None
        stored, pose = turned_camera(camera, orientation), turned_pose(pose, orientation)
        sensors, poses = dict(turned.sensors), dict(turned.trajectories)
        for kind, one in (("camera", record), ("depth", depth)):
            sensor = f"{one.sensor_id}_{orientation}"
            sensors[sensor] = Sensor.with_camera(sensor, stored, kind)
            poses[record.timestamp, sensor] = pose
        turned = replace(
            turned,
            sensors=sensors,
            trajectories=poses,
            images=(*turned.images, _of_sensor(record, orientation)),
            depth_maps=(*turned.depth_maps, _of_sensor(depth, orientation)),
        )
        photo = turned.path_of(record)
        photo.parent.mkdir(parents=True, exist_ok=True)
        photo.write_bytes(dataset.path_of(record).read_bytes())
        store_photo_turned(photo, orientation)
        values = np.fromfile(dataset.path_of(depth), np.float32)
        values = values.reshape(camera.height, camera.width)
        turned_pixels(values, orientation).tofile(turned.path_of(depth))
    write_dataset(turned)
    return orientations


def _of_sensor(record: FileRecord, orientation: int) -> FileRecord:
    return replace(record, sensor_id=f"{record.sensor_id}_{orientation}")


def turned_film(path: Path, matrix: tuple[int, int, int, int]) -> Path:
    """Write a display matrix into an MP4's track header.

    Rows of tkhd's are (a, b, u), (c, d, v), (x, y, w): p' = (a x + c y, b x + d y), y down.
    """

    def packed(a: int, b: int, c: int, d: int) -> bytes:
        one = 1 << 16
        return struct.pack(">9i", a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30)

    data = path.read_bytes()
    at = data.index(b"tkhd")
    place = data.index(packed(1, 0, 0, 1), at)
    path.write_bytes(data[:place] + packed(*matrix) + data[place + 36 :])
    return path
