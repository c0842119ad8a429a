"""Turns the frames of a scan, which have poses, into one model, in metres with y up.

Photos and depth go to a folder of their own: photos as links or files, depth maps as 16-bit PNGs in
millimetres without the pixels of low confidence. A frame of a film counts if the camera has moved.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.importers.dataset import depth_sensor_id
from mapping.importers.left_out import notes_on
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.photo_names import photo_size
from mapping.importers.reading.poses import has_moved, pose_from_center, rotation_from_matrix
from mapping.stages.depth import DEFAULT_DEPTH_SCALE, MAX_DEPTH_PIXELS, read_depth
from visloc.errors import DatasetError, InvalidInput, VislocError, refuse
from visloc.geometry import Camera, Pose
from visloc.kapture import Sensor
from visloc.photos.reading import read_photo_file

# ARKit's camera looks along -z with y up.
OURS_FROM_ARKIT = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
# A principal point further from the middle, in sides of the picture, belongs to another size.
_OFF_CENTRE = 0.2
_IN_MILLIMETRES = partial(read_depth, depth_scale=DEFAULT_DEPTH_SCALE)


@dataclass(frozen=True, slots=True)
class ScanFrame:
    """One photo of a scan.

    Attributes:
        name: below the folder of photos, where the photo is already.
        depth: file of the depth map, as the app wrote it; it may be missing.
        confidence: file of its confidence, 0 where it is low; it may be missing.
        depth_camera: sees the depth map from the photo's pose, in any size; None for ``camera``.
        read: returns the depth (H, W) of a file and that camera: metres, NaN where unknown.
    """

    name: str
    camera: Camera
    cam_from_world: Pose
    depth: Path | None = None
    confidence: Path | None = None
    depth_camera: Camera | None = None
    read: Callable[[Path, Camera], NDArray[np.float32]] = _IN_MILLIMETRES


def arkit_pose(values: ArrayLike, where: str) -> Pose:
    """Return ``cam_from_world`` of a matrix camera to world (3 or 4 rows of 4) of ARKit."""
    matrix = np.asarray(values, np.float64).reshape(-1, 4)
    rotation = rotation_from_matrix(matrix[:3, :3])
    if rotation is None:
        raise refuse("import.scan_pose", field=where, got=matrix[:3, :3].round(6).tolist())
    return OURS_FROM_ARKIT @ pose_from_center(rotation.T, matrix[:3, 3])


def quaternion_pose(values: Sequence[float], where: str) -> Pose:
    """Return ``cam_from_world`` of x y z w of the rotation camera to world, and the position."""
    try:
        return Pose.from_quaternion([values[3], *values[:3]], values[4:]).inverse()
    except InvalidInput as error:
        raise error.about(where, DatasetError) from error


def pinhole(params: Sequence[float], size: tuple[int, int], where: str) -> Camera:
    """Return the camera of fx, fy, cx, cy in pixels of a picture."""
    try:
        camera = Camera("PINHOLE", *size, tuple(params))
    except InvalidInput as error:
        raise error.about(where, DatasetError) from error
    if np.abs(np.array(params[2:]) / size - 0.5).max() > _OFF_CENTRE:
        got = f"cx {params[2]:g}, cy {params[3]:g} of {size[0]} x {size[1]} pixels"
        raise refuse("import.scan_camera", field=where, got=got)
    return camera


def starts_of_stretches(frames: Sequence[ScanFrame]) -> list[int]:
    """Return the rows of a film's frames from which on the camera hardly moves until the next."""
    starts = [0]
    for row, frame in enumerate(frames):
        if has_moved(frames[starts[-1]].cam_from_world, frame.cam_from_world):
            starts.append(row)
    return starts


def link(file: Path, target: Path) -> None:
    """Make ``target`` a link to a photo, which stays where it is."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    target.symlink_to(file.resolve())


def unused(names: Iterable[str], used: Iterable[str]) -> list[str]:
    """Return a note on fields that are not read."""
    others = sorted(set(names) - set(used))
    return [f"fields that are not used: {', '.join(others)}"] if others else []


def scan_model(
    read: Callable[[Path, Path], tuple[Sequence[ScanFrame], Sequence[str]]],
    scan: Path,
    photos: Path | None = None,
) -> ImportedModel:
    """Make the model of a scan.

    Args:
        read: given the scan and the folder of photos, returns frames as they were taken, and notes.
        photos: a folder; None makes ``<scan>_photos`` beside the scan, and removes it on failure.
    """
    whole = scan.resolve()  # "." has no name
    stem = whole.name if whole.is_dir() else whole.stem
    folder = whole.with_name(f"{stem}_photos") if photos is None else photos
    is_new = not folder.exists()
    folder.mkdir(exist_ok=True)
    try:
        frames, notes = read(scan, folder)
        told = [f"photos and depth maps are in {folder}"] if photos is None else []
        return _model(frames, folder, [*told, *notes])
    except BaseException:
        if is_new:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def _model(frames: Sequence[ScanFrame], folder: Path, notes: Sequence[str]) -> ImportedModel:
    sensors: dict[str, Sensor] = {}
    ids: dict[tuple[Camera, Camera | None], str] = {}
    images = []
    amiss: dict[str, list[str]] = {}
    for rank, frame in enumerate(frames):
        depth_camera = depth = None
        try:
            if frame.depth is not None:
                metres, depth_camera = _depth(frame, frame.depth)
                depth = f"depth/{rank:06d}.png"
                _write_depth(folder / depth, metres)
        except VislocError as error:
            amiss.setdefault(f"depth, {error.message}", []).append(frame.name)
        key = frame.camera, depth_camera
        if key not in ids:
            ids[key] = sensor = f"camera{len(ids) + 1}"
            sensors[sensor] = Sensor.with_camera(sensor, frame.camera)
            if depth_camera is not None:
                of_depth = depth_sensor_id(sensor)
                sensors[of_depth] = Sensor.with_camera(of_depth, depth_camera, "depth")
        pose = frame.cam_from_world
        images.append(ImportedImage(frame.name, ids[key], rank, pose, depth=depth))
    notes = (*notes, *notes_on(amiss))
    return ImportedModel(sensors, tuple(images), folder, metric=True, notes=notes)


def _depth(frame: ScanFrame, file: Path) -> tuple[NDArray[np.float32], Camera]:
    """Return the depth of a frame in metres, NaN where it is unknown or of low confidence."""
    size, camera = photo_size(file), frame.depth_camera or frame.camera
    if size is None:
        raise refuse("depth.missing")
    if size[0] * size[1] > MAX_DEPTH_PIXELS or not camera.has_aspect_of(*size):
        raise refuse("depth.size", got=f"{size[0]} x {size[1]}")
    camera = camera.scaled(*size)
    metres = frame.read(file, camera)
    if frame.confidence is not None and frame.confidence.is_file():
        levels = read_photo_file(frame.confidence).rgb[..., 0]
        if levels.shape != metres.shape:
            raise refuse("depth.size", "its confidence has another size")
        metres[levels == 0] = np.nan
    return metres, camera


def _write_depth(path: Path, metres: NDArray[np.float32]) -> None:
    units = np.nan_to_num(np.round(metres / DEFAULT_DEPTH_SCALE))
    units[units >= np.iinfo(np.uint16).max] = 0  # further than a depth map can say
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", units.astype(np.uint16))[1].tobytes())
