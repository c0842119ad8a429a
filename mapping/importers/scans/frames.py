"""What all scans have in common: frames with poses become one model, in metres with y up.

Photos and depth go to a folder of their own: photos as links or files, depth maps as 16-bit PNGs in
millimetres without the pixels of low confidence. A frame of a film counts if the camera has moved.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.importers.dataset import depth_sensor_id
from mapping.importers.left_out import notes_on
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.json_fields import JsonValue
from mapping.importers.reading.photo_names import photo_size
from mapping.importers.reading.steps import has_moved
from mapping.importers.reading.tracks import pose_from_center, rotation_from_matrix
from mapping.stages.depth import DEFAULT_DEPTH_SCALE, MAX_DEPTH_PIXELS, read_depth
from visloc.errors import DatasetError, InvalidInput, VislocError, refuse
from visloc.geometry import Camera, Pose
from visloc.images import read_photo_file
from visloc.kapture import Sensor

# ARKit's camera looks along -z with y up.
OURS_FROM_ARKIT = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
# A principal point further from the middle, in sides of the picture, belongs to another size.
_OFF_CENTRE = 0.2

ReadDepth = Callable[[Path, Camera], NDArray[np.float32]]
"""Returns a depth map (H, W) of a file and the camera that sees it: metres, NaN where unknown."""


@dataclass(frozen=True, slots=True)
class ScanFrame:
    """One photo of a scan.

    Attributes:
        name: below the folder of photos.
        camera: of the photo.
        cam_from_world: pose.
        depth: file of the depth map, as the app wrote it; it may be missing.
        confidence: file of its confidence, 0 where it is low; it may be missing.
        depth_camera: sees the depth map from the photo's pose, in any size; None for ``camera``.
    """

    name: str
    camera: Camera
    cam_from_world: Pose
    depth: Path | None = None
    confidence: Path | None = None
    depth_camera: Camera | None = None


def arkit_pose(values: ArrayLike, where: str) -> Pose:
    """Return ``cam_from_world`` of a matrix camera to world (3 or 4 rows of 4) of ARKit.

    Raises:
        DatasetError: ``import.scan_pose``.
    """
    matrix = np.asarray(values, np.float64).reshape(-1, 4)
    rotation = rotation_from_matrix(matrix[:3, :3])
    if rotation is None:
        raise refuse("import.scan_pose", field=where, got=matrix[:3, :3].round(6).tolist())
    return OURS_FROM_ARKIT @ pose_from_center(rotation.T, matrix[:3, 3])


def quaternion_pose(xyzw: Sequence[float], center: ArrayLike, where: str) -> Pose:
    """Return ``cam_from_world`` of the camera's rotation, to the world, and its position there.

    Raises:
        DatasetError: ``pose.rotation``.
    """
    try:
        return Pose.from_quaternion([xyzw[3], *xyzw[:3]], center).inverse()
    except InvalidInput as error:
        raise error.about(where, DatasetError) from error


def pinhole(params: Sequence[float], size: tuple[int, int], where: str) -> Camera:
    """Return the camera of fx, fy, cx, cy in pixels of a picture.

    Raises:
        DatasetError: ``import.scan_camera`` for the intrinsics of another size; ``camera.*``.
    """
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
    return starts if frames else []


def link(file: Path, target: Path) -> None:
    """Make ``target`` a link to a photo, which stays where it is."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    target.symlink_to(file.resolve())


def unused_fields(seen: Sequence[JsonValue] | Sequence[str], used: Sequence[str]) -> list[str]:
    """Return a note on the fields of objects, or on columns, that are not read."""
    names: set[str] = set()
    for each in seen:
        names |= {each} if isinstance(each, str) else {key for key, _ in each.fields()}
    unused = sorted(names - set(used))
    return [f"fields that are not used: {', '.join(unused)}"] if unused else []


@contextmanager
def photos_folder(scan: Path, photos: Path | None) -> Iterator[tuple[Path, list[str]]]:
    """Have the folder for photos and depth of a scan; a new one is removed on failure.

    Args:
        photos: the folder; None makes ``<scan>_photos`` beside the scan.

    Yields:
        The folder, and a note on one that nobody named.
    """
    scan = scan.resolve()
    stem = scan.name if scan.is_dir() else scan.stem
    folder = scan.with_name(f"{stem}_photos") if photos is None else photos
    is_new = not folder.exists()
    folder.mkdir(exist_ok=True)
    try:
        yield folder, [f"photos and depth maps are in {folder}"] if photos is None else []
    except BaseException:
        if is_new:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def scan_model(
    frames: Sequence[ScanFrame],
    folder: Path,
    notes: list[str],
    read: ReadDepth | None = None,
    *,
    metric: bool = True,
) -> ImportedModel:
    """Write the depth maps of frames below the folder of photos, and make the model.

    Args:
        frames: in the order in which they were taken.
        read: reads depth; None for 16-bit PNGs in millimetres.
    """
    sensors: dict[str, Sensor] = {}
    ids: dict[tuple[Camera, Camera | None], str] = {}
    images = []
    amiss: dict[str, list[str]] = {}
    for rank, frame in enumerate(frames):
        depth_camera = depth = None
        try:
            if frame.depth is not None:
                metres, depth_camera = _depth(frame, read)
                depth = f"depth/{rank:06d}.png"
                _write_depth(folder / depth, metres)
        except VislocError as error:
            depth_camera = depth = None
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
    notes = [*notes, *notes_on(amiss)]
    return ImportedModel(sensors, tuple(images), folder, metric=metric, notes=tuple(notes))


def _depth(frame: ScanFrame, read: ReadDepth | None) -> tuple[NDArray[np.float32], Camera]:
    """Return the depth of a frame in metres, NaN where it is unknown or of low confidence."""
    assert frame.depth is not None
    size = photo_size(frame.depth)
    if size is None:
        raise refuse("depth.missing")
    camera = frame.depth_camera or frame.camera
    if size[0] * size[1] > MAX_DEPTH_PIXELS or not camera.has_aspect_of(*size):
        raise refuse("depth.size", got=f"{size[0]} x {size[1]}")
    camera = camera.scaled(*size)
    if read is None:
        metres = read_depth(frame.depth, camera, DEFAULT_DEPTH_SCALE)
    else:
        metres = read(frame.depth, camera)
    if frame.confidence is not None and frame.confidence.is_file():
        levels = read_photo_file(frame.confidence).rgb[..., 0]
        if levels.shape != metres.shape:
            raise refuse("depth.size", "its confidence has another size")
        metres[levels == 0] = np.nan
    return metres, camera


def _write_depth(path: Path, metres: NDArray[np.float32]) -> None:
    units = np.nan_to_num(np.round(metres / DEFAULT_DEPTH_SCALE))
    units[units >= np.iinfo(np.uint16).max] = 0  # further than a depth map can say
    _, encoded = cv2.imencode(".png", units.astype(np.uint16))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded.tobytes())
