"""The scans of each app.

3D Scanner App ("All data"): ``frame_00000.json`` with photo, depth and confidence beside it, as its
readers agree (PSegs); matrices are row by row. NeRFCapture, SplaTAM: nerfstudio's format but for
depth (nerfcapture_dataset.py of jc211/NeRFCapture). Polycam: raw data (README of PolyCam/polyform).
Record3D: an ``.r3d`` file, which is a ZIP, or a folder; K is column by column, depth LZFSE or EXR.
Stray Scanner: docs/format.md and OdometryEncoder.swift of strayrobots/scanner.

Poses are camera to world, with ARKit's axes of the camera, Stray Scanner's with ours; all are of
photos as stored. Depth is in millimetres.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mapping.importers import nerfstudio
from mapping.importers.reading.json_fields import JsonValue, parse_json, read_json
from mapping.importers.reading.photo_names import natural_order, photo_names, photo_size
from mapping.importers.reading.text_lines import TextLines
from mapping.stages.depth import read_depth
from visloc.errors import refuse
from visloc.geometry import MAX_IMAGE_SIDE, Camera
from visloc.photos.formats import MALFORMED, png_samples
from visloc.photos.reading import FILE_LIMITS
from visloc_extensions.films.video import (
    SHARPNESS_SIDE,
    Frame,
    frames_of,
    sharpness,
    video_facts,
    write_jpeg,
)
from visloc_extensions.scans.frames import (
    OURS_FROM_ARKIT,
    ScanFrame,
    arkit_pose,
    link,
    pinhole,
    quaternion_pose,
    scan_model,
    starts_of_stretches,
    unused,
)

_INTRINSICS, _SIZE = ("fx", "fy", "cx", "cy"), ("width", "height")

_3D_POSE, _3D_INTRINSICS = "cameraPoseARFrame", "intrinsics"

_NERF_DEPTH, _NERF_UNIT = "depth_path", "integer_depth_scale"
_RGBA, _FARTHEST_M, _LEAST_KNOWN = (8, 6), 100.0, 0.5  # bits and colour type of PNG

_POLYCAM_POSE = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))

_R3D_FIELDS = ("K", "w", "h", "poses", "perFrameIntrinsicCoeffs")
_R3D_PHOTOS = ("rgbd", "rgb")  # folders
_NUMBER = re.compile(r"[0-9]{1,9}")
# What zipfile raises on damaged files; those that are encrypted are a RuntimeError.
_DAMAGED_ZIP = (zipfile.BadZipFile, RuntimeError, ValueError, EOFError, zlib.error)

_STRAY_FRAME, _STRAY_POSE = "frame", ("qx", "qy", "qz", "qw", "x", "y", "z")
_STRAY_MOST_FRAMES = 10**6

Frames = tuple[Sequence[ScanFrame], Sequence[str]]


def _of_3d_scanner_app(path: Path, folder: Path) -> Frames:
    files = sorted(path.glob("frame_*.json"), key=lambda file: natural_order(file.name))
    frames, fields = [], set[str]()
    for file in files:
        photo = file.with_suffix(".jpg")
        if (size := photo_size(photo)) is None:
            continue
        top = read_json(file)
        values = top[_3D_INTRINSICS].numbers(9)
        fields |= dict(top.fields()).keys()
        link(photo, folder / photo.name)
        number = file.stem.removeprefix("frame_")
        frames.append(
            ScanFrame(
                photo.name,
                pinhole([values[i] for i in (0, 4, 2, 5)], size, top.where),
                arkit_pose(top[_3D_POSE].numbers(16), top.where),
                path / f"depth_{number}.png",
                path / f"conf_{number}.png",
            )
        )
    if not frames:
        raise refuse("import.empty", field=str(path), expected="frame_00000.jpg and others")
    notes = [f"{len(files) - len(frames)} of {len(files)} frames have no photo"]
    return frames, notes[len(files) == len(frames) :] + unused(fields, [_3D_POSE, _3D_INTRINSICS])


def _of_nerfcapture(path: Path, folder: Path) -> Frames:
    top = read_json(path / "transforms.json")
    rows = top["frames"].elements()
    unit, applied = top.get(_NERF_UNIT), top.get("applied_scale")
    if applied is not None and applied.number() != 1:
        raise applied.error("positions were scaled, and depth was not", expected="1")
    cameras: Mapping[str, object] = {
        **{key: value.value for key, value in top.fields() if key != _NERF_UNIT},
        "frames": [{k: v.value for k, v in row.fields() if k != _NERF_DEPTH} for row in rows],
    }
    model = nerfstudio.read_recording(JsonValue(cameras, top.file), path)
    read = partial(_nerf_metres, unit=None if unit is None else unit.number())
    frames = []
    for row, image in zip(rows, model.images, strict=True):
        link(path / image.name, folder / image.name)
        depth, camera = row.get(_NERF_DEPTH), model.sensors[image.sensor].camera
        assert camera is not None  # of every photo there
        assert image.cam_from_world is not None
        file = None
        if depth is not None and depth.value is not None:
            (name,), _ = photo_names([(depth.text(), depth.where)], path, path)
            file = path / name
        frames.append(ScanFrame(image.name, camera, image.cam_from_world, file, read=read))
    return frames, [note for note in model.notes if note != nerfstudio.UNKNOWN_UNIT]


def _nerf_metres(file: Path, camera: Camera, unit: float | None) -> NDArray[np.float32]:
    """Read a 16-bit PNG in a unit of so many metres, or four bytes of each pixel as a float32."""
    data = file.read_bytes()
    if png_samples(data) != _RGBA:
        if unit is None:
            raise refuse("depth.scale", "nothing gives its unit", field=_NERF_UNIT)
        return read_depth(file, camera, unit)
    try:
        pixels = np.asarray(Image.open(BytesIO(data), formats=("PNG",)), np.uint8)
    except MALFORMED as error:
        raise refuse("depth.damaged", field=str(file), got=str(error)) from error
    metres = np.ascontiguousarray(pixels).view("<f4")[..., 0].copy()
    metres[~((metres > 0) & (metres < _FARTHEST_M))] = np.nan  # also of NaN
    if np.isfinite(metres).mean() < _LEAST_KNOWN:
        raise refuse("depth.format", "its colours are not the bytes of metres", field=str(file))
    return metres


def _of_polycam(path: Path, folder: Path) -> Frames:
    scan = path / "keyframes" if (path / "keyframes").is_dir() else path
    corrected = (scan / "corrected_images", scan / "corrected_cameras")
    kind = "corrected_" if all(each.is_dir() for each in corrected) else ""
    files = sorted((scan / f"{kind}images").glob("*.jpg"), key=lambda f: natural_order(f.name))
    frames, fields = [], set[str]()
    for photo in files:
        described, original = (
            scan / each / f"{photo.stem}.json" for each in (f"{kind}cameras", "cameras")
        )
        if not described.is_file():
            continue
        top = read_json(described)
        fields |= dict(top.fields()).keys()
        link(photo, folder / photo.name)
        frames.append(
            ScanFrame(
                photo.name,
                _polycam_camera(top),
                arkit_pose([top[key].number() for key in _POLYCAM_POSE], top.where),
                scan / "depth" / f"{photo.stem}.png",
                scan / "confidence" / f"{photo.stem}.png",
                _polycam_camera(read_json(original)) if original.is_file() else None,
            )
        )
    if not frames:
        raise refuse("import.empty", field=str(scan), expected=f"{kind}images and {kind}cameras")
    notes = unused(fields, [*_POLYCAM_POSE, *_INTRINSICS, *_SIZE])
    if not kind:
        notes.append("there are no corrected images: those with distortion are used")
    if len(frames) < len(files):
        notes.append(f"{len(files) - len(frames)} of {len(files)} photos have no camera")
    return frames, notes


def _polycam_camera(top: JsonValue) -> Camera:
    width, height = (top[key].integer(MAX_IMAGE_SIDE) for key in _SIZE)
    return pinhole([top[key].number() for key in _INTRINSICS], (width, height), top.where)


def _of_record3d(path: Path, folder: Path) -> Frames:
    if path.is_dir():
        path = path / "EXR_RGBD" if (path / "EXR_RGBD").is_dir() else path
        return _of_record3d_files(path, path, folder)
    try:
        with zipfile.ZipFile(path) as archive:
            largest = max((info.file_size for info in archive.infolist()), default=0)
            if largest > FILE_LIMITS.max_bytes:
                raise refuse("import.unreadable", field=str(path), got=f"a file of {largest} bytes")
            return _of_record3d_files(path, zipfile.Path(archive), folder)
    except _DAMAGED_ZIP as error:
        raise refuse("import.unreadable", field=str(path), got=str(error)) from error


def _of_record3d_files(path: Path, scan: Path | zipfile.Path, folder: Path) -> Frames:
    name = "metadata" if (scan / "metadata").is_file() else "metadata.json"
    if not (scan / name).is_file():
        raise refuse("import.missing", field=str(path / name))
    top = parse_json((scan / name).read_bytes(), path / name)
    photos = {
        int(file.stem): file
        for place in _R3D_PHOTOS
        if (scan / place).is_dir()
        for file in (scan / place).iterdir()
        if file.suffix in (".jpg", ".png") and _NUMBER.fullmatch(file.stem)
    }
    poses = top["poses"].elements()
    recorded, files = [], []
    for row, values in enumerate(poses):
        if row in photos:
            pose = OURS_FROM_ARKIT @ quaternion_pose(values.numbers(7), values.where)
            recorded.append(ScanFrame(f"{row:06d}.jpg", _record3d_camera(top, row), pose))
            files.append(photos[row])
    if not recorded:
        raise refuse("import.empty", field=str(path), expected="photos such as rgbd/0.jpg")
    frames = []
    for start in starts_of_stretches(recorded):
        frame, file = recorded[start], files[start]
        (folder / frame.name).write_bytes(file.read_bytes())
        size = photo_size(folder / frame.name)  # it may be larger than the camera's
        if size is None or not frame.camera.has_aspect_of(*size):
            raise refuse("import.scan_camera", field=str(path / file.name), got=size)
        frames.append(replace(frame, camera=frame.camera.scaled(*size)))
    return frames, [
        f"{len(frames)} of {len(poses)} frames are used, where the camera has moved",
        "depth of Record3D (LZFSE or EXR) is not read",
        *unused(dict(top.fields()), _R3D_FIELDS),
    ]


def _record3d_camera(top: JsonValue, row: int) -> Camera:
    each = top.get("perFrameIntrinsicCoeffs")
    if each is not None and each.value:
        of_frames = each.elements()
        if row >= len(of_frames):
            raise each.error("frames are missing", expected=f"at least {row + 1}")
        params = of_frames[row].numbers(4)
    else:
        values = top["K"].numbers(9)
        params = [values[i] for i in (0, 4, 6, 7)]
    width, height = (top[key].integer(MAX_IMAGE_SIDE) for key in ("w", "h"))
    return pinhole(params, (width, height), top.where)


def _of_stray_scanner(path: Path, folder: Path) -> Frames:
    film, matrix = path / "rgb.mp4", path / "camera_matrix.csv"
    with TextLines(matrix) as lines:
        rows = [_stray_fields(lines, lines.next("three numbers"), 3) for _ in range(3)]
        (fx, _, cx), (_, fy, cy), _ = ([lines.to_number(field) for field in row] for row in rows)
    if not film.is_file():
        raise refuse("import.missing", field=str(film))
    facts = video_facts(film)
    camera = pinhole([fx, fy, cx, cy], (facts.width, facts.height), str(matrix))
    recorded, notes = _stray_odometry(path, camera)
    frames = list(_stray_photos(film, recorded, folder))
    used = f"{len(frames)} of {len(recorded)} frames are used, where the camera has moved"
    return frames, [used, *notes]


def _stray_fields(lines: TextLines, line: str, count: int) -> list[str]:
    fields = [field.strip() for field in line.split(",")]
    if len(fields) != count:
        raise lines.error("the line is not whole", expected=f"{count} fields", got=len(fields))
    return fields


def _stray_odometry(path: Path, shared: Camera) -> Frames:
    """Read the lines by the names of columns; newer versions have the intrinsics of each frame."""
    frames = []
    with TextLines(path / "odometry.csv") as lines:
        names = [name.strip() for name in lines.next("names of columns").split(",")]
        if missing := [name for name in (_STRAY_FRAME, *_STRAY_POSE) if name not in names]:
            raise lines.error("a column is missing", expected=", ".join(missing), got=str(names))
        while (line := lines.next_or_none()) is not None:
            values = dict(zip(names, _stray_fields(lines, line, len(names)), strict=True))
            where = f"{lines.path}:{lines.number}"
            camera = shared
            if all(values.get(name) for name in _INTRINSICS):
                own = [lines.to_number(values[name]) for name in _INTRINSICS]
                camera = pinhole(own, (shared.width, shared.height), where)
            pose = quaternion_pose([lines.to_number(values[name]) for name in _STRAY_POSE], where)
            frame = f"{lines.to_integer(values[_STRAY_FRAME], _STRAY_MOST_FRAMES):06d}"
            depth, confidence = (path / each / f"{frame}.png" for each in ("depth", "confidence"))
            frames.append(ScanFrame(f"{frame}.jpg", camera, pose, depth, confidence))
    return frames, unused(names, [_STRAY_FRAME, *_STRAY_POSE, *_INTRINSICS])


def _stray_photos(film: Path, recorded: Sequence[ScanFrame], folder: Path) -> Iterator[ScanFrame]:
    """Write the sharpest frame of each stretch, and yield what was recorded with it.

    Frames of the film are the lines of the odometry, one by one.
    """
    starts = set(starts_of_stretches(recorded)) if recorded else set()
    best: tuple[float, ScanFrame, Frame] | None = None
    row = -1
    for row, frame in enumerate(frames_of(film)):
        if row >= len(recorded):
            break
        if row in starts and best is not None:
            write_jpeg(folder / best[1].name, best[2].rgb())
            yield best[1]
            best = None
        sharp = sharpness(frame.grey(SHARPNESS_SIDE))
        if best is None or sharp > best[0]:
            best = sharp, recorded[row], frame
    if row + 1 != len(recorded) or best is None:
        expected, got = f"{len(recorded)} frames", f"{row + 1} or more"
        raise refuse("import.scan_frames", field=str(film), expected=expected, got=got)
    write_jpeg(folder / best[1].name, best[2].rgb())
    yield best[1]


# Of a film, frames where the camera has moved are used.
read_3d_scanner_app = partial(scan_model, _of_3d_scanner_app)
read_nerfcapture = partial(scan_model, _of_nerfcapture)
read_polycam = partial(scan_model, _of_polycam)
read_record3d = partial(scan_model, _of_record3d)
read_stray_scanner = partial(scan_model, _of_stray_scanner)
