"""Depth maps: find a photo's depth map, read it, register it to the photo, look depth up.

A depth map here is (H, W) float32: metres along the optical axis of its camera, NaN where unknown.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from visloc.errors import VislocError, refuse
from visloc.geometry import Camera, Pose, rotation_angle
from visloc.kapture import Dataset, FileRecord
from visloc.pose.reprojection import normalized_rays, project

DEFAULT_DEPTH_SCALE = 0.001  # metres per unit of a 16-bit PNG: recorders write millimetres
MAX_DEPTH_PIXELS = 16_000_000

_NO_DEPTH = 65535  # the code of 16-bit recorders for "none"
# Published float maps still hold that code as a distance; half a millimetre is for its rounding.
_NO_DEPTH_M, _ROUNDED_BY_M = 65.535, 0.0005
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER_BYTES = 33
_DEPTH_KIND = (16, 0)  # bits for each channel, and PNG's type of grey

# Poses are written with few digits; this much moves a pixel by less than a tenth.
_SAME_ROTATION_RAD = 1e-4
_SAME_POSITION_M = 1e-4
_SAME_INTRINSICS = 1e-4  # relative, 0.05 px of a focal length of 500

# Neighbouring pixels of the depth camera must fall less than a pixel apart in the view, or what
# lies behind shows through. A tenth is left for surfaces that are nearer to the photo's camera.
_MAX_SPREAD_PX = 0.9
# A point that lands further than this from where its pixel looks was folded into the picture by
# the polynomial of the lens, which holds for the picture only.
_MAX_LENS_DISAGREEMENT_PX = 5.0

# Measured on redkitchen (Kinect): neighbours on one surface differ by up to 0.8 % up to 3.5 m, by
# one or two steps of the sensor's disparity beyond (1.1 % each at 4 m); 0.3 % of all quads differ
# by 2 to 5 %, then come the silhouettes, mostly above 10 %. A floor seen at 2 degrees still passes.
_MAX_RELATIVE_STEP = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class DepthMatch:
    """The depth map of a photo.

    Attributes:
        cam_from_depth: from its frame to the frame of the photo's camera.
    """

    record: FileRecord
    camera: Camera
    cam_from_depth: Pose


class DepthMatcher:
    """Finds the depth map of each photo of a dataset; files that do not exist do not count.

    Args:
        depth_sensor: id of the only depth sensor to use; None to choose by rig, pose and size.
    """

    def __init__(self, dataset: Dataset, depth_sensor: str | None) -> None:
        self._dataset = dataset
        self._named = depth_sensor is not None
        self._cameras = {
            sensor.id: sensor.camera
            for sensor in dataset.sensors.values()
            if sensor.kind == "depth" and sensor.camera is not None
        }
        if depth_sensor is not None:
            if depth_sensor not in self._cameras:
                raise refuse(
                    "depth.sensor",
                    field="--depth-sensor",
                    expected=f"one of {', '.join(self._cameras) or 'none in this dataset'}",
                    got=depth_sensor,
                )
            self._cameras = {depth_sensor: self._cameras[depth_sensor]}
        self._by_timestamp: dict[int, list[FileRecord]] = {}
        for record in dataset.depth_maps:
            if record.sensor_id in self._cameras and dataset.has_file(record):
                self._by_timestamp.setdefault(record.timestamp, []).append(record)

    def match(self, image: FileRecord) -> DepthMatch | None:
        """Return the depth map of a photo, None if there is none of its timestamp.

        Of several, the one registered to the photo wins (same pose, same aspect), then the only
        one of the photo's rig, then the only one with a pose of its own.
        """
        of_rig: list[DepthMatch] = []
        of_world: list[DepthMatch] = []
        for record in self._by_timestamp.get(image.timestamp, ()):
            camera = self._cameras[record.sensor_id]
            if (pose := self._pose_in_rig(image, record)) is not None:
                of_rig.append(DepthMatch(record, camera, pose))
            elif (pose := self._pose_in_world(image, record)) is not None:
                of_world.append(DepthMatch(record, camera, pose))
            elif self._named:
                raise refuse(
                    "depth.pose", field=record.path, got=f"{record.sensor_id} and {image.sensor_id}"
                )
        registered = [match for match in of_rig + of_world if self._is_registered(image, match)]
        candidates = registered or of_rig or of_world
        if len(candidates) > 1:
            raise refuse(
                "depth.ambiguous",
                field=image.path,
                expected=(match.record.sensor_id for match in candidates),
                got="no choice",
            )
        return candidates[0] if candidates else None

    def _pose_in_rig(self, image: FileRecord, record: FileRecord) -> Pose | None:
        for rig_id in self._dataset.rigs_of(image.sensor_id):
            rig = self._dataset.rigs[rig_id]
            cam_from_rig, depth_from_rig = rig[image.sensor_id], rig.get(record.sensor_id)
            if cam_from_rig is not None and depth_from_rig is not None:
                return cam_from_rig @ depth_from_rig.inverse()
        return None

    def _pose_in_world(self, image: FileRecord, record: FileRecord) -> Pose | None:
        cam_from_world, depth_from_world = self._dataset.pose(image), self._dataset.pose(record)
        if cam_from_world is None or depth_from_world is None:
            return None
        return cam_from_world @ depth_from_world.inverse()

    def _is_registered(self, image: FileRecord, match: DepthMatch) -> bool:
        size = self._dataset.sensors[image.sensor_id].image_size
        return (
            size is not None
            and match.camera.has_aspect_of(*size)
            and _is_identity(match.cam_from_depth)
        )


def photo_depth(
    dataset: Dataset, match: DepthMatch, camera: Camera, depth_scale: float
) -> tuple[NDArray[np.float32], Camera]:
    """Read the depth map of a photo, and register it to the photo's camera if necessary.

    Returns:
        The depth map and the camera that sees it: the photo's, maybe of another size.
    """
    depth = read_depth(dataset.path_of(match.record), match.camera, depth_scale)
    if _is_identity(match.cam_from_depth) and _is_resized(match.camera, camera):
        return depth, match.camera
    return register_depth(depth, match.camera, camera, match.cam_from_depth)


def read_depth(path: Path, camera: Camera, depth_scale: float) -> NDArray[np.float32]:
    """Read a depth map: raw little-endian float32 metres, or a 16-bit grey PNG.

    The content decides, not the name. Invalid values are 0, negative and non-finite ones; in a PNG
    also 65535, in a raw map 65.535. A raw map has no farthest depth.

    Args:
        camera: the depth sensor's, for the size; a raw map has no header.
        depth_scale: metres per unit of a PNG.
    """
    if not (math.isfinite(depth_scale) and depth_scale > 0):
        raise refuse("depth.scale", field="--depth-scale", got=depth_scale)
    if camera.width * camera.height > MAX_DEPTH_PIXELS:
        raise refuse(
            "depth.too_many_pixels",
            field=str(path),
            expected=f"at most {MAX_DEPTH_PIXELS} pixels",
            got=f"{camera.width} x {camera.height}",
        )
    try:
        with path.open("rb") as file:
            header = file.read(_PNG_HEADER_BYTES)
        if header.startswith(_PNG_SIGNATURE):
            _check_png_header(path, header, camera)
            units = _decode_png(path)
            depth = units.astype(np.float32) * np.float32(depth_scale)
            invalid = (units == 0) | (units == _NO_DEPTH)
        else:
            depth = _read_raw(path, camera)
            with np.errstate(invalid="ignore"):  # comparing a signalling NaN
                is_code = np.abs(depth - np.float32(_NO_DEPTH_M)) < _ROUNDED_BY_M
                invalid = ~((depth > 0) & (depth < np.inf)) | is_code
    except OSError as error:
        raise refuse("depth.missing", field=str(path), got=error.strerror) from error
    depth[invalid] = np.nan
    return depth


def _read_raw(path: Path, camera: Camera) -> NDArray[np.float32]:
    expected = 4 * camera.width * camera.height
    size = path.stat().st_size
    if size != expected:
        raise refuse(
            "depth.size",
            "the depth map has the wrong size and is not a PNG",
            field=str(path),
            expected=f"{expected} bytes, float32 of {camera.width} x {camera.height}",
            got=f"{size} bytes",
        )
    values = np.frombuffer(path.read_bytes(), dtype="<f4").astype(np.float32)
    return values.reshape(camera.height, camera.width)


def is_png_of_16_bits(path: Path) -> bool:
    """Tell whether the header of a file is that of a depth map: a PNG of 16 bits and no colours."""
    with path.open("rb") as file:
        header = file.read(_PNG_HEADER_BYTES)
    is_png = header.startswith(_PNG_SIGNATURE) and len(header) == _PNG_HEADER_BYTES
    return is_png and (header[24], header[25]) == _DEPTH_KIND


def _check_png_header(path: Path, header: bytes, camera: Camera) -> None:
    if len(header) < _PNG_HEADER_BYTES or header[12:16] != b"IHDR":
        raise _damaged(path, "no header")
    width, height, bit_depth, color_type = struct.unpack_from(">IIBB", header, 16)
    if (bit_depth, color_type) != _DEPTH_KIND:
        raise refuse(
            "depth.format",
            field=str(path),
            got=f"{bit_depth} bits per channel, PNG colour type {color_type}",
        )
    if (width, height) != (camera.width, camera.height):
        raise refuse(
            "depth.size",
            field=str(path),
            expected=f"{camera.width} x {camera.height} as its sensor",
            got=f"{width} x {height}",
        )


def _decode_png(path: Path) -> NDArray[np.uint16]:
    content = path.read_bytes()
    # Pillow does not check the checksums of pixels; a flipped bit would move the map.
    position = len(_PNG_SIGNATURE)
    while position < len(content):
        length = int.from_bytes(content[position : position + 4], "big")
        end = position + 8 + length
        checksum = zlib.crc32(content[position + 4 : end]).to_bytes(4, "big")
        if content[end : end + 4] != checksum:
            raise _damaged(path, "wrong checksum, or cut short")
        position = end + 4
    try:
        with Image.open(BytesIO(content), formats=("PNG",)) as image:
            return np.array(image).astype(np.uint16, copy=False)
    except (OSError, SyntaxError, ValueError, EOFError) as error:  # what Pillow raises
        raise _damaged(path, str(error)) from error


def _damaged(path: Path, got: str) -> VislocError:
    return refuse("depth.damaged", field=str(path), got=got)


def register_depth(
    depth: NDArray[np.float32], depth_camera: Camera, camera: Camera, cam_from_depth: Pose
) -> tuple[NDArray[np.float32], Camera]:
    """Show a depth map as the photo's camera sees it; the nearest surface wins.

    Every pixel of the map becomes a point, which goes into the pixel that sees it; depth on a
    slanted surface may thus be off by half a pixel. If the photo has more pixels than the depth
    map, the result is smaller than the photo: at full size, hidden surfaces would show through
    holes.

    Args:
        depth: (H, W) float32 as seen by ``depth_camera``.
        camera: the photo's.
        cam_from_depth: from the frame of ``depth_camera`` to that of ``camera``.

    Returns:
        (H', W') float32 and the camera that sees it, ``camera`` at that size.
    """
    view = _view_without_holes(depth_camera, camera)
    valid = np.flatnonzero(np.isfinite(depth))
    distances = depth.ravel()[valid, np.newaxis].astype(np.float64)
    points = cam_from_depth.apply(_pixel_rays(depth_camera)[valid] * distances)
    points = points[points[:, 2] > 0]
    pixels = project(view, points)
    u, v = pixels.T
    inside = (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)  # false for NaN
    points, pixels = points[inside], pixels[inside]
    columns, rows = pixels.astype(np.int64).T
    targets = rows * view.width + columns

    disagreement = _lengths(_unit(points) - _unit(_pixel_rays(view)[targets]))
    true = disagreement * view.focal_length <= _MAX_LENS_DISAGREEMENT_PX  # false for NaN
    nearest = np.full(view.width * view.height, np.inf, dtype=np.float32)
    np.minimum.at(nearest, targets[true], points[true, 2].astype(np.float32))
    nearest[np.isinf(nearest)] = np.nan
    return nearest.reshape(view.height, view.width), view


def depth_at(depth: NDArray[np.float32], pixels: NDArray[np.floating]) -> NDArray[np.float32]:
    """Look up depth at sub-pixel positions.

    The inverse of depth is interpolated bilinearly between the four pixels around, which is exact
    on planes: 1 / Z is affine in the pixel.

    Args:
        depth: (H, W) float32.
        pixels: (N, 2), x and y in pixels of the depth map; the first centre is at (0.5, 0.5).

    Returns:
        (N,) float32. NaN if one of the four is missing or outside, or if they differ by more than
        3 %: at a silhouette, a point between the two surfaces would lie on neither.
    """
    height, width = depth.shape
    result = np.full(len(pixels), np.nan, dtype=np.float32)
    if height < 2 or width < 2:
        return result
    from_first = np.asarray(pixels, dtype=np.float64) - 0.5
    inside = ((from_first >= 0) & (from_first <= (width - 1, height - 1))).all(axis=1)
    x, y = from_first[inside].T
    column = np.minimum(x.astype(np.int64), width - 2)
    row = np.minimum(y.astype(np.int64), height - 2)
    right, down = x - column, y - row

    corners = np.stack(
        [
            depth[row, column],
            depth[row, column + 1],
            depth[row + 1, column],
            depth[row + 1, column + 1],
        ]
    ).astype(np.float64)
    weights = np.stack(
        [(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down]
    )
    smooth = corners.max(axis=0) <= (1 + _MAX_RELATIVE_STEP) * corners.min(axis=0)  # not for NaN
    inverse = (weights / corners).sum(axis=0)
    result[inside] = np.where(smooth, 1.0 / inverse, np.nan)
    return result


def _view_without_holes(depth_camera: Camera, camera: Camera) -> Camera:
    scale = _MAX_SPREAD_PX * depth_camera.focal_length / camera.focal_length
    if scale >= 1:
        return camera
    width = max(1, int(camera.width * scale))
    height = max(1, round(camera.height * width / camera.width))  # the same aspect
    return camera.scaled(width, height)


def _is_identity(pose: Pose) -> bool:
    return (
        rotation_angle(pose.rotation) <= _SAME_ROTATION_RAD
        and float(np.linalg.norm(pose.translation)) <= _SAME_POSITION_M
    )


def _is_resized(depth_camera: Camera, camera: Camera) -> bool:
    if depth_camera.model != camera.model:
        return False
    if not camera.has_aspect_of(depth_camera.width, depth_camera.height):
        return False
    scaled = camera.scaled(depth_camera.width, depth_camera.height)
    return np.allclose(depth_camera.params, scaled.params, rtol=_SAME_INTRINSICS, atol=1e-6)


@lru_cache(maxsize=4)
def _pixel_rays(camera: Camera) -> NDArray[np.float64]:
    """Return the rays (H * W, 3) of all pixels at depth 1; one camera serves many photos."""
    rows, columns = np.indices((camera.height, camera.width))
    centres = np.column_stack([columns.ravel(), rows.ravel()]) + 0.5
    rays = normalized_rays(camera, centres)
    rays.flags.writeable = False
    return rays


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / _lengths(vectors)[:, np.newaxis]


def _lengths(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    # Several times faster than np.linalg.norm along so short an axis.
    lengths: NDArray[np.float64] = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return lengths
