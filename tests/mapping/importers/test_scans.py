"""Scans in the layouts that apps publish, made of the sample: its cameras, poses and depth."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.importers import import_dataset
from mapping.importers.scans.recognition import app_of
from mapping.stages.depth import read_depth
from samples.film import encode_video
from tests.mapping.capture.test_video import turned
from visloc.geometry import Camera, Pose
from visloc.images import read_photo_file
from visloc.kapture import Dataset, FileRecord, read_dataset

_UPRIGHT = (0, 1, -1, 0)  # the display matrix of a phone held upright
ARKIT = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Seen:
    """One frame of the scene, which is known exactly; depth in metres, of half the photo's size."""

    jpeg: bytes
    camera: Camera
    cam_from_world: Pose
    depth: NDArray[np.float32]

    @property
    def arkit(self) -> NDArray[np.float64]:
        """Camera to world, the camera's axes as ARKit's."""
        world_from_cam = np.eye(4)
        world_from_cam[:3, :3] = self.cam_from_world.rotation.T
        world_from_cam[:3, 3] = self.cam_from_world.center
        return world_from_cam @ ARKIT

    @property
    def rgb(self) -> NDArray[np.uint8]:
        return np.asarray(cv2.imdecode(np.frombuffer(self.jpeg, np.uint8), 1)[..., ::-1])

    def xyzw(self, world_from_cam: NDArray[np.float64]) -> list[float]:
        w, x, y, z = Pose(world_from_cam[:3, :3], np.zeros(3)).rotation_wxyz.tolist()
        return [x, y, z, w]


@pytest.fixture(scope="module")
def seen(sample: Path) -> list[Seen]:
    dataset = read_dataset(sample / "mapping")
    depth = {record.path: record for record in dataset.depth_maps}
    found = []
    for record in dataset.images:
        camera, pose = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        assert camera is not None
        assert pose is not None
        file = dataset.path_of(depth[str(Path(record.path).with_suffix(".depth"))])
        metres = read_depth(file, camera, 0.001)
        found.append(Seen(dataset.path_of(record).read_bytes(), camera, pose, metres[::2, ::2]))
    return found


def put(path: Path, content: bytes | str | dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))


def png(values: NDArray[Any]) -> bytes:
    return cv2.imencode(".png", values)[1].tobytes()


def mm(frame: Seen) -> bytes:
    return png(np.nan_to_num(np.round(frame.depth * 1000)).astype(np.uint16))


def confidence(frame: Seen, high: int) -> bytes:
    """Low in the left half."""
    levels = np.full(frame.depth.shape, high, np.uint8)
    levels[:, : levels.shape[1] // 2] = 0
    return png(levels)


def write_stray_scanner(folder: Path, frames: Sequence[Seen], *, columns: int = 15) -> None:
    names = "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x, d_y"
    lines = [", ".join(names.split(", ")[:columns])]
    for i, frame in enumerate(frames):
        world_from_cam = frame.arkit @ ARKIT  # the app turns ARKit's axes to OpenCV's
        values = [i / 60, f"{i:06d}", *world_from_cam[:3, 3], *frame.xyzw(world_from_cam)]
        lines.append(", ".join(map(str, [*values, *frame.camera.params, "", ""][:columns])))
        put(folder / "depth" / f"{i:06d}.png", mm(frame))
        put(folder / "confidence" / f"{i:06d}.png", confidence(frame, 2))
    put(folder / "odometry.csv", "\n".join(lines) + "\n")
    fx, fy, cx, cy = frames[0].camera.params
    put(folder / "camera_matrix.csv", f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0")
    put(folder / "imu.csv", "timestamp, a_x, a_y, a_z\n")
    encode_video(folder / "rgb.mp4", (f.rgb for f in frames), options={"crf": "8"})
    turned(folder / "rgb.mp4", _UPRIGHT)  # as older versions say; poses are of the stored pixels


def write_polycam(folder: Path, frames: Sequence[Seen], *, corrected: bool = True) -> None:
    scan = folder / "keyframes"
    for i, frame in enumerate(frames):
        stem = f"{1700000000 + i}"
        camera: dict[str, Any] = dict(
            zip(("fx", "fy", "cx", "cy"), frame.camera.params, strict=True)
        )
        camera |= {"width": frame.camera.width, "height": frame.camera.height, "blur_score": 90.5}
        pose = {f"t_{r}{c}": frame.arkit[r, c] for r in range(3) for c in range(4)}
        if corrected:
            put(scan / "corrected_images" / f"{stem}.jpg", frame.jpeg)
            put(scan / "corrected_cameras" / f"{stem}.json", camera | pose)
            pose = {name: value + 0.01 for name, value in pose.items()}  # not optimized
        put(scan / "images" / f"{stem}.jpg", frame.jpeg)
        put(scan / "cameras" / f"{stem}.json", camera | pose)
        put(scan / "depth" / f"{stem}.png", mm(frame))
        put(scan / "confidence" / f"{stem}.png", confidence(frame, 255))
    put(folder / "mesh_info.json", {})
    put(folder / "thumbnail.jpg", frames[0].jpeg)


def write_polycam_without_corrections(folder: Path, frames: Sequence[Seen]) -> None:
    write_polycam(folder, frames, corrected=False)


def write_3d_scanner_app(folder: Path, frames: Sequence[Seen]) -> None:
    for i, frame in enumerate(frames):
        fx, fy, cx, cy = frame.camera.params
        camera = {
            "cameraPoseARFrame": frame.arkit.ravel().tolist(),
            "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
            "motionQuality": 0.9,
        }
        put(folder / f"frame_{2 * i:05d}.jpg", frame.jpeg)
        put(folder / f"depth_{2 * i:05d}.png", mm(frame))
        put(folder / f"conf_{2 * i:05d}.png", confidence(frame, 2))
        for number in (2 * i, 2 * i + 1):  # most frames have no photo
            put(folder / f"frame_{number:05d}.json", camera | {"frame_index": number})
    put(folder / "info.json", {"title": "hall"})


def record3d_files(frames: Sequence[Seen]) -> dict[str, bytes]:
    fx, fy, cx, cy = frames[0].camera.params
    width, height = frames[0].camera.width, frames[0].camera.height
    metadata = {
        **{"w": width // 2, "h": height // 2, "dw": 96, "dh": 64, "fps": 60},
        "K": [fx / 2, 0, 0, 0, fy / 2, 0, cx / 2, cy / 2, 1],  # of photos of half the size
        "poses": [[*f.xyzw(f.arkit), *f.arkit[:3, 3]] for f in frames],
        "perFrameIntrinsicCoeffs": [[p / 2 for p in f.camera.params] for f in frames],
    }
    files = {"metadata": json.dumps(metadata).encode()}
    for i, frame in enumerate(frames):
        files |= {f"rgbd/{i}.jpg": frame.jpeg, f"rgbd/{i}.depth": b"bvx2"}
    return files


def write_record3d(folder: Path, frames: Sequence[Seen]) -> None:
    for name, content in record3d_files(frames).items():
        put(folder / name, content)


def write_r3d(path: Path, frames: Sequence[Seen]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in record3d_files(frames).items():
            archive.writestr(name, content)


def write_nerfcapture(folder: Path, frames: Sequence[Seen], *, as_bytes: bool = True) -> None:
    unit = 10 / 65535
    rows = []
    for i, frame in enumerate(frames):
        fx, fy, cx, cy = frame.camera.params
        rows.append(
            {
                **{"file_path": f"images/{i}", "depth_path": f"images/{i}.depth.png"},
                **{"transform_matrix": frame.arkit.tolist(), "timestamp": i / 60},
                **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy},
                **{"w": frame.camera.width, "h": frame.camera.height},
            }
        )
        put(folder / "images" / f"{i}.png", png(frame.rgb[..., ::-1]))
        if as_bytes:
            rgba = np.nan_to_num(frame.depth).astype("<f4").view(np.uint8)
            depth = png(rgba.reshape(*frame.depth.shape, 4)[..., [2, 1, 0, 3]])  # OpenCV's order
        else:
            depth = png(np.nan_to_num(np.round(frame.depth / unit)).astype(np.uint16))
        put(folder / "images" / f"{i}.depth.png", depth)
    scale = {} if as_bytes else {"integer_depth_scale": unit}
    put(folder / "transforms.json", scale | {"frames": rows})


def write_splatam(folder: Path, frames: Sequence[Seen]) -> None:
    write_nerfcapture(folder, frames, as_bytes=False)


WRITERS: dict[str, tuple[str, Callable[[Path, Sequence[Seen]], None], str]] = {
    # name of the scan -> app, writer, and number of the first photo's frame by its name
    "2f1a9c": ("strayscanner", write_stray_scanner, "frame"),
    "poly": ("polycam", write_polycam, "rank"),
    "poly_raw": ("polycam", write_polycam_without_corrections, "rank"),
    "2026_01_13": ("3dscannerapp", write_3d_scanner_app, "rank"),
    "walk": ("record3d", write_record3d, "frame"),
    "walk.r3d": ("record3d", write_r3d, "frame"),
    "240223": ("nerfcapture", write_nerfcapture, "rank"),
    "splatam": ("nerfcapture", write_splatam, "rank"),
}


def depth_record(dataset: Dataset, record: FileRecord) -> FileRecord | None:
    sensor = f"{record.sensor_id}_depth"
    of_photo = (
        (d.timestamp, d.sensor_id) == (record.timestamp, sensor) for d in dataset.depth_maps
    )
    return next((d for d, is_one in zip(dataset.depth_maps, of_photo, strict=True) if is_one), None)


@pytest.mark.parametrize("name", WRITERS)
def test_a_scan_becomes_a_dataset_with_the_true_cameras_poses_and_depth(
    seen: list[Seen], tmp_path: Path, name: str
) -> None:
    app, write, numbering = WRITERS[name]
    scan = tmp_path / name
    write(scan, seen)
    assert app_of(scan) == app
    before = {p: p.stat().st_mtime_ns for p in scan.rglob("*")}
    summary = import_dataset(app, scan, tmp_path / "dataset")
    assert before == {p: p.stat().st_mtime_ns for p in scan.rglob("*")}  # scans are only read
    assert summary.metric
    dataset = read_dataset(tmp_path / "dataset")
    photos = tmp_path / f"{name.removesuffix('.r3d')}_photos"
    assert any(note == f"photos and depth maps are in {photos}" for note in summary.notes)
    # The cameras of a pair are 0.2 m apart, which is too near for a film.
    assert len(dataset.images) == (4 if numbering == "frame" else 8)
    assert summary.depth_maps == (0 if app == "record3d" else len(dataset.images))
    for rank, record in enumerate(dataset.images):
        number = int(Path(record.path).stem) if numbering == "frame" else rank
        truth = seen[number]
        camera, pose = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        assert camera is not None
        assert pose is not None
        assert (camera.model, camera.width, camera.height) == ("PINHOLE", 256, 192)
        np.testing.assert_allclose(camera.params, truth.camera.params, rtol=1e-12)
        expected = truth.cam_from_world
        np.testing.assert_allclose(pose.rotation, expected.rotation, atol=1e-9)
        np.testing.assert_allclose(pose.translation, expected.translation, atol=1e-9)
        rgb = read_photo_file(dataset.path_of(record)).rgb  # as stored: not turned
        assert np.abs(rgb.astype(int) - truth.rgb).mean() < (6 if app == "strayscanner" else 0.01)
        found = depth_record(dataset, record)
        if found is None:
            continue
        depth_camera = dataset.sensors[found.sensor_id].camera
        assert depth_camera is not None
        half = truth.camera.scaled(128, 96)
        np.testing.assert_allclose(depth_camera.params, half.params, rtol=1e-12)
        metres = read_depth(dataset.path_of(found), depth_camera, 0.001)
        wanted = truth.depth.copy()
        if app != "nerfcapture":
            wanted[:, :64] = np.nan  # of low confidence
        np.testing.assert_allclose(metres, wanted, atol=0.00066)  # half of both units
