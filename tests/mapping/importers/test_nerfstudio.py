from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mapping.importers import MASKS, import_dataset
from mapping.importers.nerfstudio import read
from mapping.stages.depth import DepthMatcher, photo_depth, read_depth
from mapping.stages.photos import collect_photos, masked
from visloc.errors import DatasetError, VislocError
from visloc.geometry import Camera
from visloc.kapture import read_dataset

LOOKING_ALONG_MINUS_Z = np.eye(4).tolist()
FRAME: dict[str, Any] = {"file_path": "images/0.jpg", "transform_matrix": LOOKING_ALONG_MINUS_Z}
TOP: dict[str, Any] = {
    **{"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 51.0, "cx": 32.5, "cy": 24.0},
    "frames": [FRAME],
}


def write(folder: Path, top: dict[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(top))
    return folder


def camera_of(folder: Path) -> Camera:
    model = read(folder)
    camera = model.sensors[model.images[0].sensor].camera
    assert camera is not None
    return camera


@pytest.fixture(scope="module")
def recorded(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample as a recorder of RGB-D writes it, depth maps of half size; only to be read."""
    folder = tmp_path_factory.mktemp("recorded")
    dataset = read_dataset(sample / "mapping")
    matcher = DepthMatcher(dataset, None)
    (folder / "depth").mkdir()
    frames = []
    for number, record in enumerate(dataset.images):
        suffix = Path(record.path).suffix
        target = folder / "images" / f"{number}{suffix}"
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(dataset.path_of(record).read_bytes())
        match = matcher.match(record)
        assert match is not None
        metres = read_depth(dataset.path_of(match.record), match.camera, 0.001)
        units = np.nan_to_num(np.round(metres * 1000)).astype(np.uint16)
        Image.fromarray(units).save(folder / "depth" / f"{number}.png")
        pose, camera = dataset.pose(record), dataset.sensors[record.sensor_id].camera
        assert pose is not None
        assert camera is not None
        world_from_cam = np.eye(4)
        world_from_cam[:3, :3] = pose.rotation.T @ np.diag([1, -1, -1])
        world_from_cam[:3, 3] = pose.center
        scaled = camera.scaled(camera.width, camera.height)
        names = {"PINHOLE": ("fl_x", "fl_y", "cx", "cy")}[scaled.model]
        frames.append(
            {
                "file_path": f"./images/{number}{suffix}",
                "depth_file_path": f"depth/{number}.png",
                "transform_matrix": world_from_cam.tolist(),
                **{"w": camera.width, "h": camera.height},
                **dict(zip(names, camera.params, strict=True)),
            }
        )
    write(folder, {"camera_model": "OPENCV", "frames": frames})
    return folder


def test_a_recording_becomes_a_dataset_with_the_true_cameras_poses_and_depth(
    sample: Path, recorded: Path, tmp_path: Path
) -> None:
    summary = import_dataset("nerfstudio", recorded, tmp_path / "out")
    assert (summary.images, summary.posed, summary.depth_maps) == (8, 8, 8)
    assert summary.metric
    assert summary.notes == ()
    truth, dataset = read_dataset(sample / "mapping"), read_dataset(tmp_path / "out")
    assert dataset.notes == ()
    ours, theirs = DepthMatcher(dataset, None), DepthMatcher(truth, None)
    for record, original in zip(dataset.images, truth.images, strict=True):
        assert dataset.path_of(record).read_bytes() == truth.path_of(original).read_bytes()
        pose, expected = dataset.pose(record), truth.pose(original)
        camera = dataset.sensors[record.sensor_id].camera
        assert pose is not None
        assert expected is not None
        assert camera is not None
        assert camera == truth.sensors[original.sensor_id].camera
        np.testing.assert_allclose(pose.rotation, expected.rotation, atol=1e-14)
        np.testing.assert_allclose(pose.translation, expected.translation, atol=1e-13)
        match, original_match = ours.match(record), theirs.match(original)
        assert match is not None
        assert original_match is not None
        depth, _ = photo_depth(dataset, match, camera, 0.001)
        expected_depth, _ = photo_depth(truth, original_match, camera, 0.001)
        np.testing.assert_allclose(depth, expected_depth, atol=0.00051)


def test_axes_turn_from_opengl_to_ours(tmp_path: Path) -> None:
    # At (1, 2, 3), looking along -z with y up: our z is the world's -z, our y its -y.
    matrix = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]]
    top = TOP | {"frames": [FRAME | {"transform_matrix": matrix}]}
    (image,) = read(write(tmp_path, top)).images
    pose = image.cam_from_world
    assert pose is not None
    assert pose.rotation.tolist() == [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
    assert pose.center.tolist() == [1, 2, 3]
    assert pose.apply(np.array([1.0, 2.0, -4.0])).tolist() == [0, 0, 7]


@pytest.mark.parametrize(
    ("top", "model", "params"),
    [
        ({}, "PINHOLE", ()),
        ({"camera_model": "PINHOLE"}, "PINHOLE", ()),
        ({"camera_model": "SIMPLE_PINHOLE", "k1": 0, "p1": 0.0}, "PINHOLE", ()),
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, "OPENCV", (0.1, 0.2, 0.3, 0.4)),
        (
            {"camera_model": "OPENCV", "k1": 0.1, "k3": 0.2, "k4": 0},
            "FULL_OPENCV",
            (0.1, 0, 0, 0, 0.2, 0, 0, 0),
        ),
        (
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4},
            "OPENCV_FISHEYE",
            (0.1, 0.2, 0.3, 0.4),
        ),
        ({"is_fisheye": True, "k1": 0.1}, "OPENCV_FISHEYE", (0.1, 0, 0, 0)),
    ],
)
def test_intrinsics_become_the_camera_model_that_holds_them(
    tmp_path: Path, top: dict[str, Any], model: str, params: tuple[float, ...]
) -> None:
    camera = camera_of(write(tmp_path, TOP | top))
    assert camera == Camera(model, 64, 48, (50.0, 51.0, 32.5, 24.0, *params))


def test_a_frame_s_own_intrinsics_win_and_equal_ones_share_a_sensor(tmp_path: Path) -> None:
    frames = [
        FRAME | {"file_path": f"{number}.jpg"} | own
        for number, own in enumerate([{}, {"fl_x": 60.0}, {}, {"w": 64.0}])
    ]
    model = read(write(tmp_path, TOP | {"frames": frames}))
    assert [image.sensor for image in model.images] == ["camera1", "camera2", "camera1", "camera1"]
    assert [image.timestamp for image in model.images] == [0, 1, 2, 3]
    camera = model.sensors["camera2"].camera
    assert camera is not None
    assert camera.params == (60, 51, 32.5, 24)


def test_the_field_of_view_and_the_photo_s_size_are_enough(tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    Image.new("RGB", (80, 60)).save(tmp_path / "train" / "r_0.png")
    frame = FRAME | {"file_path": "./train/r_0"}
    folder = write(tmp_path, {"camera_angle_x": math.radians(90), "frames": [frame]})
    model = read(folder / "transforms.json")
    assert model.images[0].name == "train/r_0.png"
    camera = camera_of(folder)
    assert camera.params == pytest.approx((40, 40, 40, 30))


def test_photos_may_lie_elsewhere(tmp_path: Path) -> None:
    Image.new("RGB", (80, 60)).save(tmp_path / "r_0.png")
    top = {"fl_x": 40, "frames": [FRAME | {"file_path": "r_0.png"}]}
    assert read(write(tmp_path / "json", top), tmp_path).photos == tmp_path


def test_what_is_not_kept_is_noted(recorded: Path, tmp_path: Path) -> None:
    top = json.loads((recorded / "transforms.json").read_text())
    top |= {
        "depth_unit_scale_factor": 0.0002,
        "applied_transform": np.eye(4)[:3].tolist(),
        "applied_scale": 0.5,
        "ply_file_path": "points.ply",
    }
    top["frames"][1]["depth_file_path"] = top["frames"][1]["file_path"]
    top["frames"][2]["depth_file_path"] = "depth/gone.png"
    top["frames"][3] |= {"sharpness": 7.0, "colmap_im_id": 3, "time": None}
    top["frames"][4] |= {"sharpness": 7.0}
    model = read(write(tmp_path, top), recorded)
    assert not model.metric
    assert model.depth_scale == 0.0002
    text = "\n".join(model.notes)
    for part in (
        "applied_transform",
        "applied_scale is 0.5",
        "ply_file_path",
        "1 depth maps are not 16-bit grey PNGs and left out: images/1",
        "has fields that are not read: frames[].sharpness (2), frames[].colmap_im_id (1)",
        "1 depth maps are missing: depth/gone.png",
        "nothing says that a unit of the world is a metre",
    ):
        assert part in text
    assert sum(image.depth is not None for image in model.images) == 6


@pytest.mark.parametrize(
    ("changes", "fx", "fy", "note"),
    [
        ({"camera_angle_x": 2 * math.atan(32 / 40)}, 40, 40, ""),
        (
            {"camera_angle_x": 2 * math.atan(32 / 40), "camera_angle_y": 2 * math.atan(24 / 44)},
            *(40, 44, ""),
        ),
        ({"x_fov": math.degrees(2 * math.atan(32 / 40)), "y_fov": 90}, 40, 24, ""),
        ({"fl_x": 50, "y_fov": 90}, 50, 24, ""),
        ({"fl_x": 50, "camera_angle_x": 2 * math.atan(32 / 50.2)}, 50, 50, ""),
        ({"fl_x": 50, "camera_angle_x": 1.0}, 50, 50, "1 camera_angle_x contradict the focal"),
        ({"fl_x": 50, "fl_y": 60, "y_fov": 80}, 50, 60, "1 y_fov contradict the focal length"),
        ({"fl_x": 50, "fl_y": None, "cx": None}, 50, 50, ""),
    ],
)
def test_focal_lengths_are_those_of_each_axis(
    tmp_path: Path, changes: dict[str, Any], fx: float, fy: float, note: str
) -> None:
    model = read(write(tmp_path, {"w": 64, "h": 48, "frames": [FRAME]} | changes))
    camera = model.sensors["camera1"].camera
    assert camera is not None
    assert camera.params == pytest.approx((fx, fy, 32, 24))
    assert note in "\n".join(model.notes)
    assert ("contradict" in "\n".join(model.notes)) == bool(note)


@pytest.mark.parametrize(
    ("frame", "top", "scale", "metric"),
    [
        ("depth_file_path", {}, 0.001, True),
        ("depth_file_path", {"integer_depth_scale": 0.25}, 0.25, True),
        ("depth_path", {"integer_depth_scale": 0.25}, 0.25, False),
        ("depth_path", {"depth_unit_scale_factor": 1, "integer_depth_scale": 1.0}, 1, False),
    ],
)
def test_depth_is_found_under_either_key_and_in_its_unit(
    tmp_path: Path, frame: str, top: dict[str, Any], scale: float, metric: bool
) -> None:
    Image.new("I;16", (32, 24)).save(tmp_path / "d.png")
    model = read(write(tmp_path, TOP | top | {"frames": [FRAME | {frame: "d.png"}]}))
    assert [image.depth for image in model.images] == ["d.png"]
    assert (model.depth_scale, model.metric) == (scale, metric)


def test_masks_lie_where_a_build_looks_for_them(tmp_path: Path) -> None:
    (tmp_path / "in" / "images").mkdir(parents=True)
    (tmp_path / "in" / "masks").mkdir()
    Image.new("RGB", (64, 48)).save(tmp_path / "in" / "images" / "0.jpg")
    Image.new("L", (64, 48)).save(tmp_path / "in" / "masks" / "of 0.png")
    frames = [
        FRAME | {"mask_path": "./masks/of 0.png"},
        FRAME | {"file_path": "1.jpg", "mask_path": "masks/gone.png"},
    ]
    folder = write(tmp_path / "in", TOP | {"frames": frames})
    summary = import_dataset("nerfstudio", folder, tmp_path / "out")
    assert summary.masks == 1
    assert any("1 masks are missing: masks/gone.png" in note for note in summary.notes)
    photos, _ = collect_photos(
        read_dataset(tmp_path / "out"), posed=True, with_files=True, progress=lambda *_: None
    )
    (photo,), _ = masked(photos, tmp_path / "out" / MASKS)
    assert photo.mask is not None
    assert photo.mask.read_bytes() == (tmp_path / "in" / "masks" / "of 0.png").read_bytes()


def frame_with(**changes: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda top: top | {"frames": [FRAME, FRAME | {"file_path": "1.jpg"} | changes]}


def top_with(**changes: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda top: {k: v for k, v in (top | changes).items() if v is not None}


SCALED = (2 * np.eye(4)).tolist()
MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()


@pytest.mark.parametrize(
    ("change", "code", "named"),
    [
        (frame_with(transform_matrix=SCALED), "import.json", "frames[1].transform_matrix"),
        (frame_with(transform_matrix=MIRRORED), "import.json", "frames[1].transform_matrix"),
        (frame_with(transform_matrix=[]), "import.json", "frames[1].transform_matrix"),
        (frame_with(transform_matrix=[[1, 2], [3, 4]]), "import.json", "frames[1]"),
        (frame_with(transform_matrix=None), "import.json", "frames[1].transform_matrix"),
        (frame_with(file_path="a,b.jpg"), "import.photo_name", "frames[1].file_path"),
        (frame_with(file_path=7), "import.json", "frames[1].file_path"),
        (frame_with(depth_file_path=""), "import.photo_name", "frames[1].depth_file_path"),
        (frame_with(fl_x=-5), "camera.param_value", "frames[1]"),
        (frame_with(fl_x=True), "import.json", "frames[1].fl_x"),
        (frame_with(w=0), "import.json", "frames[1].w"),
        (frame_with(w=64.5), "import.json", "frames[1].w"),
        (frame_with(k4=0.1), "import.json", "frames[1]"),
        (frame_with(camera_model="EQUIRECTANGULAR"), "camera.model", "frames[1].camera_model"),
        (frame_with(file_path="images/0.jpg"), "import.photo_name", "images/0.jpg"),
        (top_with(fl_x=None), "import.json", "frames[0]"),
        (top_with(fl_x=None, camera_angle_x=4.0), "import.json", "camera_angle_x"),
        (top_with(fl_x=None, x_fov=-1), "import.json", "x_fov"),
        (top_with(is_fisheye=1), "import.json", "is_fisheye"),
        (top_with(integer_depth_scale=0), "import.json", "integer_depth_scale"),
        (
            top_with(depth_unit_scale_factor=0.001, integer_depth_scale=0.002),
            *("import.json", "integer_depth_scale"),
        ),
        (frame_with(mask_path=3), "import.json", "frames[1].mask_path"),
        (top_with(w=None), "import.json", "frames[0]"),
        (top_with(frames=None), "import.json", "'frames'"),
        (top_with(frames=[]), "import.empty", ""),
        (top_with(frames={"a": 1}), "import.json", "frames"),
    ],
)
def test_what_cannot_be_used_is_named_with_its_frame(
    tmp_path: Path,
    change: Callable[[dict[str, Any]], dict[str, Any]],
    code: str,
    named: str,
) -> None:
    folder = write(tmp_path / "in", change(TOP))
    with pytest.raises(VislocError) as caught:
        import_dataset("nerfstudio", folder, tmp_path / "out")
    assert caught.value.code == code
    assert named in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (SCALED, "scaled by 2;"),
        (MIRRORED, "mirrored"),
        ((2 * np.array(MIRRORED)).tolist(), "mirrored"),
        (np.diag([1.0, 1.0, 1.2, 1.0]).tolist(), "not a rotation"),
        (np.zeros((3, 4)).tolist(), "not a rotation"),
    ],
)
def test_a_pose_that_is_none_says_why(
    tmp_path: Path, matrix: list[list[float]], message: str
) -> None:
    if len(matrix) == 4:
        matrix[3] = [0, 0, 0, 1]
    with pytest.raises(DatasetError, match=message) as caught:
        read(write(tmp_path, frame_with(transform_matrix=matrix)(TOP)))
    determinant = np.linalg.det(np.array(matrix)[:3, :3])
    assert f"determinant {determinant:.6g}" in str(caught.value.got)


@pytest.mark.parametrize(
    "style", ["images\\f0.jpg", "C:\\rec\\f0.jpg", "/gone/f0.jpg", "../f0.jpg"]
)
def test_names_of_other_systems_and_folders_find_their_photos(tmp_path: Path, style: str) -> None:
    where = "images" if style.startswith("images") else "."
    (tmp_path / where).mkdir(exist_ok=True)
    Image.new("RGB", (64, 48)).save(tmp_path / where / "f0.jpg")
    model = read(write(tmp_path, TOP | {"frames": [FRAME | {"file_path": style}]}))
    assert model.photos is not None
    assert (model.photos / model.images[0].name).is_file()


def test_an_absolute_name_below_the_folder_is_that_photo(tmp_path: Path) -> None:
    frame = FRAME | {
        "file_path": str(tmp_path / "images" / "0.jpg"),
        "depth_file_path": str(tmp_path / "depth" / "0.png"),
    }
    (tmp_path / "depth").mkdir()
    Image.new("I;16", (32, 24)).save(tmp_path / "depth" / "0.png")
    (image,) = read(write(tmp_path, TOP | {"frames": [frame]})).images
    assert (image.name, image.depth) == ("images/0.jpg", "depth/0.png")


def test_downscaled_photos_are_refused_before_any_work(tmp_path: Path) -> None:
    folder = write(tmp_path / "in", TOP | {"frames": [FRAME]})
    (folder / "images").mkdir()
    Image.new("RGB", (32, 24)).save(folder / "images" / "0.jpg")
    with pytest.raises(DatasetError, match="--photos") as caught:
        import_dataset("nerfstudio", folder, tmp_path / "out")
    error = caught.value
    assert (error.code, error.field) == ("import.photo_size", str(folder / "images" / "0.jpg"))
    assert "64 x 48" in str(error.expected)
    assert error.got == "32 x 24 pixels"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text", ["", "{", "[1", '{"frames": [NaN]}', "[" * 100_000])
def test_what_is_no_json_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(DatasetError) as caught:
        read(tmp_path)
    assert caught.value.code == "import.json"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"transforms\.json"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("top", "named"),
    [
        ({"root_path": ".", "views": []}, "mapping import openmvg"),
        ([{"shots": {}, "cameras": {}}], "mapping import opensfm"),
    ],
)
def test_a_file_of_another_program_is_recognized(tmp_path: Path, top: Any, named: str) -> None:
    (tmp_path / "cameras.sfm").write_text(json.dumps(top))
    with pytest.raises(DatasetError, match=named) as caught:
        read(tmp_path / "cameras.sfm")
    assert caught.value.code == "import.json"
