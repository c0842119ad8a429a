"""Scans in the layouts that apps publish, made of the sample: its cameras, poses and depth."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from mapping.cli.main import app as mapping_app
from mapping.importers import import_dataset, read_model, write_imported
from mapping.importers.scans import app_of
from mapping.stages.depth import read_depth
from samples.film import encode_video
from visloc.errors import DatasetError, InvalidInput, VislocError
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, read_dataset
from visloc.photos.reading import read_photo_file
from visloc_extensions.capture.sources import find_sources, read_capture
from visloc_extensions.films.tests.test_video import turned

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


def test_of_each_stretch_of_a_film_the_sharpest_frame_is_used(
    seen: list[Seen], tmp_path: Path
) -> None:
    frames = []
    for frame in seen[::2]:  # the camera stands still for three frames, two of which are blurred
        soft = cv2.GaussianBlur(cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), 1), (0, 0), 3)
        blurred = replace(frame, jpeg=cv2.imencode(".jpg", soft)[1].tobytes())
        frames += [blurred, frame, blurred]
    write_stray_scanner(tmp_path / "scan", frames)
    model = read_model("strayscanner", tmp_path / "scan")
    assert [image.name for image in model.images] == [f"{row:06d}.jpg" for row in (1, 4, 7, 10)]
    assert any("4 of 12 frames are used" in note for note in model.notes)


def test_an_export_of_record3d_is_read_too(seen: list[Seen], tmp_path: Path) -> None:
    for name, content in record3d_files(seen).items():
        name = name.replace("rgbd/", "rgb/").replace("metadata", "metadata.json")
        put(tmp_path / "scan" / "EXR_RGBD" / name.replace("rgb/", "rgb/000"), content)
    assert app_of(tmp_path / "scan") == app_of(tmp_path / "scan" / "EXR_RGBD") == "record3d"
    model = read_model("record3d", tmp_path / "scan")
    assert [image.name for image in model.images] == [f"{row:06d}.jpg" for row in (0, 2, 4, 6)]


@pytest.mark.parametrize("columns", [9, 13])
def test_older_recordings_tell_one_camera_for_all_frames(
    seen: list[Seen], tmp_path: Path, columns: int
) -> None:
    write_stray_scanner(tmp_path / "scan", seen[::2], columns=columns)
    model = read_model("strayscanner", tmp_path / "scan")
    (camera,) = (s.camera for s in model.sensors.values() if s.kind == "camera")
    assert camera is not None
    assert camera.params == seen[0].camera.params


def edit(name: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    def edited(scan: Path) -> None:
        (scan / name).write_text(change((scan / name).read_text()))

    return edited


def without_files(pattern: str) -> Callable[[Path], None]:
    def removed(scan: Path) -> None:
        for file in list(scan.glob(pattern)):
            file.unlink()

    return removed


def with_json(name: str, **changes: Any) -> Callable[[Path], None]:
    return edit(name, lambda text: json.dumps(json.loads(text) | changes))


MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0]).ravel().tolist()
POLY, FRAME = "keyframes/corrected_cameras/1700000003.json", "frame_00004.json"


LINES, MATRIX, TOP = "odometry.csv", "camera_matrix.csv", "transforms.json"
DAMAGED: dict[str, list[tuple[Callable[[Path], None], str, str]]] = {
    "strayscanner": [
        # A film and odometry that do not belong together would give every photo a wrong pose.
        (edit(LINES, lambda t: t.rsplit("\n", 2)[0]), "import.scan_frames", "rgb.mp4"),
        (edit(LINES, lambda t: t + t.splitlines()[-1]), "import.scan_frames", "rgb.mp4"),
        (edit(LINES, lambda t: t.replace("qw", "q_w", 1)), "import.line", f"{LINES}:1"),
        (edit(LINES, lambda t: t.replace("0.0, 000000", "0.0", 1)), "import.line", f"{LINES}:2"),
        (edit(LINES, lambda t: t.replace("000000", "nan", 1)), "import.line", f"{LINES}:2"),
        (edit(MATRIX, lambda t: t.splitlines()[0]), "import.truncated", f"{MATRIX}:1"),
        (edit(MATRIX, lambda t: t.replace("128", "999")), "import.scan_camera", MATRIX),
        (without_files("rgb.mp4"), "import.missing", "rgb.mp4"),
    ],
    "polycam": [
        (with_json(POLY, t_00=7), "import.scan_pose", POLY),
        (with_json(POLY, t_22=None), "import.json", f"{POLY}: t_22"),
        (with_json(POLY, width=1024, height=768), "import.scan_camera", POLY),
        (with_json(POLY, width=10**9), "import.json", f"{POLY}: width"),
        (without_files("keyframes/corrected_images/*"), "import.empty", "keyframes"),
    ],
    "3dscannerapp": [
        (with_json(FRAME, cameraPoseARFrame=MIRRORED), "import.scan_pose", FRAME),
        (with_json(FRAME, intrinsics=[1]), "import.json", f"{FRAME}: intrinsics"),
        (with_json(FRAME, intrinsics=[9, 0, 99, 0, 9, 999, 0, 0, 1]), "import.scan_camera", FRAME),
        (without_files("*.jpg"), "import.empty", ""),
    ],
    "record3d": [
        (with_json("metadata", poses=[[0] * 7]), "pose.rotation", "metadata: poses[0]"),
        (
            with_json("metadata", perFrameIntrinsicCoeffs=[[9, 9, 64, 48]]),
            *("import.json", "metadata: perFrameIntrinsicCoeffs"),
        ),
        (with_json("metadata", w=64), "import.scan_camera", "metadata"),
        (with_json("metadata", h=100), "import.scan_camera", "0.jpg"),
        (without_files("rgbd/*.jpg"), "import.empty", ""),
    ],
    "nerfcapture": [
        (edit(TOP, lambda t: t.replace('"fl_x"', '"f"', 1)), "import.json", f"{TOP}: frames[0]"),
        (edit(TOP, lambda t: t.replace('"frames"', '"f"', 1)), "import.json", TOP),
    ],
}


@pytest.mark.parametrize(
    ("app", "damage", "code", "field"),
    [(app, *row) for app, rows in DAMAGED.items() for row in rows],
)
def test_what_is_wrong_with_a_scan_is_refused_by_name(
    seen: list[Seen],
    tmp_path: Path,
    app: str,
    damage: Callable[[Path], None],
    code: str,
    field: str,
) -> None:
    write = next(write for name, write, _ in WRITERS.values() if name == app)
    scan = tmp_path / "scan"
    write(scan, seen)
    damage(scan)
    with pytest.raises(VislocError) as refused:
        read_model(app, scan)
    assert (refused.value.code, refused.value.field) == (code, str(scan / field))
    assert not (tmp_path / "scan_photos").exists()


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],
        lambda _: b"PK\x03\x04",
        lambda data: data.replace(b"rgbd/0.jpg", b"rgbd/9.xyz"),
        lambda data: data[:60] + bytes(40) + data[100:],
    ],
)
def test_a_damaged_r3d_is_refused(
    seen: list[Seen], tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    path = tmp_path / "walk.r3d"
    write_r3d(path, seen[:1])
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DatasetError) as refused:
        read_model("record3d", path)
    assert refused.value.code in ("import.unreadable", "import.empty", "import.missing")


def test_an_r3d_of_huge_files_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bomb.r3d", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", bytes(130 * 2**20))
    with pytest.raises(DatasetError, match="a file of 136314880 bytes"):
        read_model("record3d", tmp_path / "bomb.r3d")


@pytest.mark.parametrize(
    ("name", "content", "part"),
    [
        ("keyframes/depth/1700000000.png", b"", "does not read this image format"),
        ("keyframes/depth/1700000000.png", png(np.ones((96, 128), np.uint8)), "not a depth map"),
        ("keyframes/depth/1700000000.png", png(np.ones((128, 96), np.uint16)), "the wrong size"),
        ("keyframes/confidence/1700000000.png", png(np.ones((9, 9), np.uint8)), "another size"),
        ("keyframes/depth/1700000000.png", None, "cannot be read"),
    ],
)
def test_one_bad_depth_map_is_left_out_with_its_reason(
    seen: list[Seen], tmp_path: Path, name: str, content: bytes | None, part: str
) -> None:
    write_polycam(tmp_path / "scan", seen)
    (tmp_path / "scan" / name).unlink()
    if content is not None:
        put(tmp_path / "scan" / name, content)
    model = read_model("polycam", tmp_path / "scan")
    assert [image.depth is None for image in model.images] == [True] + [False] * 7
    (note,) = (note for note in model.notes if note.startswith("1 left out (depth"))
    assert part in note
    assert note.endswith("1700000000.jpg")


def test_colours_of_depth_are_not_taken_for_metres(seen: list[Seen], tmp_path: Path) -> None:
    write_nerfcapture(tmp_path / "scan", seen)
    picture = np.full((96, 128, 4), 255, np.uint8)
    picture[..., :3] = np.arange(128, dtype=np.uint8)[:, None]
    for file in (tmp_path / "scan" / "images").glob("*.depth.png"):
        put(file, png(picture))
    model = read_model("nerfcapture", tmp_path / "scan")
    assert all(image.depth is None for image in model.images)
    assert any("not the bytes of metres" in note for note in model.notes)


def test_fields_that_are_not_read_are_named(seen: list[Seen], tmp_path: Path) -> None:
    for name, (app, write, _) in WRITERS.items():
        if app == "nerfcapture":  # as nerfstudio's
            continue
        write(tmp_path / name, seen)
        notes = read_model(app, tmp_path / name).notes
        (note,) = (note for note in notes if "fields that are not used: " in note)
        expected = {
            "strayscanner": "d_y, distortion_center_x, timestamp",
            "polycam": "blur_score",
            "3dscannerapp": "frame_index, motionQuality",
            "record3d": "dh, dw, fps",
        }[app]
        assert note.endswith(f"fields that are not used: {expected}"), (name, notes)


@pytest.mark.parametrize("name", WRITERS)
def test_scans_are_not_taken_for_photos_or_datasets(
    seen: list[Seen], tmp_path: Path, name: str
) -> None:
    app, write, _ = WRITERS[name]
    scan = tmp_path / "scans" / name
    write(scan, seen[:2])
    if scan.is_dir():
        for folder in (scan, tmp_path / "scans"):  # also where it lies deeper
            with pytest.raises(InvalidInput) as refused:
                read_model("images", folder)
            assert (refused.value.code, refused.value.field) == ("import.scan", str(scan))
            assert f"mapping import {app} {scan} --map ID" in str(refused.value)
    command = ["build", str(scan), "--map", "m", "--maps-dir", str(tmp_path / "maps")]
    result = CliRunner().invoke(mapping_app, command)
    assert isinstance(result.exception, InvalidInput)
    assert result.exception.code == "import.scan"


@pytest.mark.parametrize(
    "files",
    [
        {"frame_0001.json": '{"shapes": []}', "frame_0001.jpg": ""},  # labels of photos
        {"cameras/0.json": '{"fx": 1}', "images/0.jpg": ""},
        {"metadata.json": '{"title": "poses"}'},
        {"odometry.csv": "t, x, y"},
        {"transforms.json": '{"frames": [{"depth_file_path": "0.png"}]}'},
        {"frame_1.json": b"\xff\xfe\0", "metadata": b"\0" * 99},
    ],
)
def test_other_folders_are_no_scans(tmp_path: Path, files: dict[str, bytes | str]) -> None:
    for name, content in files.items():
        put(tmp_path / name, content)
    assert app_of(tmp_path) is None


@pytest.mark.parametrize("name", WRITERS)
def test_a_capture_takes_scans_with_their_poses_and_depth(
    seen: list[Seen], tmp_path: Path, name: str
) -> None:
    app, write, _ = WRITERS[name]
    scan = tmp_path / "of a phone" / name
    write(scan, seen)
    sources = find_sources([scan])
    assert list(sources.exports.values()) == [(app, scan)]
    assert (sources.videos, sources.folders) == ({}, {})
    for _ in range(2):  # killed, and called again
        model = read_capture(sources, {}, tmp_path / "work", lambda *_: None)
    assert model.metric
    assert all(image.cam_from_world is not None for image in model.images)
    assert all((image.depth is None) == (app == "record3d") for image in model.images)
    write_imported(model, tmp_path / "dataset")
    dataset = read_dataset(tmp_path / "dataset")
    assert all(dataset.has_file(record) for record in (*dataset.images, *dataset.depth_maps))
    assert [path.name for path in scan.parent.iterdir()] == [name]  # nothing was written beside it
