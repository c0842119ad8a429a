from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapping.importers import read_model
from visloc.errors import DatasetError
from visloc.pose.reprojection import project
from visloc_extensions.importers.openmvg import read
from visloc_extensions.importers.tracks import reprojection_errors

POINTS = np.array([[0.1, -0.2, 3.0], [0.5, 0.3, 4.0], [-0.6, 0.2, 2.5], [0.9, 0.7, 3.5]])
FIRST_USE = 2**31


def view(key: int, name: str, **changes: Any) -> dict[str, Any]:
    data = {
        "local_path": "",
        "filename": name,
        "width": 640,
        "height": 480,
        "id_view": key,
        "id_intrinsic": 0,
        "id_pose": key,
    } | changes
    pointer = {"id": FIRST_USE + key + 1, "data": data}
    return {"key": key, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": pointer}}


def intrinsic(key: int, kind: str, pointer: int, **distortion: list[float]) -> dict[str, Any]:
    data = {"width": 640, "height": 480, "focal_length": 500.0, "principal_point": [310.0, 250.0]}
    return {
        "key": key,
        "value": {
            "polymorphic_id": FIRST_USE + 1,
            "polymorphic_name": kind,
            "ptr_wrapper": {"id": FIRST_USE + pointer, "data": data | distortion},
        },
    }


def pose(key: int, angle: float, center: list[float]) -> dict[str, Any]:
    c, s = math.cos(angle), math.sin(angle)
    rotation = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]
    return {"key": key, "value": {"rotation": rotation, "center": center}}


def scene(kind: str = "pinhole", **distortion: list[float]) -> dict[str, Any]:
    return {
        "sfm_data_version": "0.3",
        "root_path": "photos",
        "views": [view(0, "a.jpg"), view(1, "b.jpg")],
        "intrinsics": [intrinsic(0, kind, 9, **distortion)],
        "extrinsics": [pose(0, 0.0, [0.0, 0.0, 0.0]), pose(1, 0.1, [0.4, 0.0, -0.2])],
        "structure": [],
        "control_points": [],
    }


def write(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "sfm_data.json"
    path.write_text(json.dumps(content))
    return path


def test_the_sample_s_points_project_to_their_observations(shared_data: Path) -> None:
    model = read(shared_data / "import_samples/openmvg_maupertuis/reconstruction_global")

    errors = reprojection_errors(model)
    assert len(errors) == 1228
    assert errors.mean() < 0.48  # OpenMVG's own residuals: 0.4703 px
    assert np.median(errors) < 0.32
    assert [image.name for image in model.images][:2] == [
        "MaupertuisTest_01.jpg",
        "MaupertuisTest_02.jpg",
    ]
    assert model.points.shape == (365, 3)


def test_the_sample_s_features_are_read_from_the_folder_of_matches(shared_data: Path) -> None:
    model = read(shared_data / "import_samples/openmvg_maupertuis/reconstruction_global")

    assert model.keypoints_type == "sift"
    first = model.images[0]
    assert first.keypoints is not None
    assert first.descriptors is not None
    assert first.keypoints.shape == (1850, 4)
    assert first.descriptors.shape == (1850, 128)
    assert first.descriptors.dtype == np.uint8
    # "1092.98 10.1572 2.23473 0.336916", and the centre of the first pixel moves to 0.5
    assert first.keypoints[0] == pytest.approx([1093.48, 10.6572, 2.23473, 0.336916])


def test_a_scene_before_reconstruction_has_photos_without_poses(shared_data: Path) -> None:
    model = read(shared_data / "import_samples/openmvg_maupertuis/matches/sfm_data.json")

    assert len(model.images) == 4
    assert all(image.cam_from_world is None for image in model.images)
    assert "4 of 4 photos were not reconstructed" in model.notes


def radial(x: float, y: float, *k: float) -> tuple[float, float]:
    r2 = x * x + y * y
    factor = 1 + sum(value * r2 ** (i + 1) for i, value in enumerate(k))
    return x * factor, y * factor


def brown(x: float, y: float) -> tuple[float, float]:
    t1, t2, r2 = 0.003, -0.002, x * x + y * y
    dx, dy = radial(x, y, -0.1, 0.05, 0.01)
    dx += t2 * (r2 + 2 * x * x) + 2 * t1 * x * y
    dy += t1 * (r2 + 2 * y * y) + 2 * t2 * x * y
    return dx, dy


def fisheye(x: float, y: float) -> tuple[float, float]:
    r = math.hypot(x, y)
    theta = math.atan(r)
    powers = [0.05, -0.01, 0.002, -0.001]
    scale = theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(powers))) / r
    return x * scale, y * scale


@pytest.mark.parametrize(
    ("kind", "distortion", "formula"),
    [
        ("pinhole", {}, lambda x, y: (x, y)),
        ("pinhole_radial_k1", {"disto_k1": [-0.1]}, lambda x, y: radial(x, y, -0.1)),
        (
            "pinhole_radial_k3",
            {"disto_k3": [-0.1, 0.05, 0.01]},
            lambda x, y: radial(x, y, -0.1, 0.05, 0.01),
        ),
        ("pinhole_brown_t2", {"disto_t2": [-0.1, 0.05, 0.01, 0.003, -0.002]}, brown),
        ("fisheye", {"fisheye": [0.05, -0.01, 0.002, -0.001]}, fisheye),
    ],
)
def test_every_camera_projects_as_openmvg_defines_it(
    tmp_path: Path,
    kind: str,
    distortion: dict[str, list[float]],
    formula: Callable[[float, float], tuple[float, float]],
) -> None:
    model = read(write(tmp_path, scene(kind, **distortion)))

    camera = model.sensors["camera_0"].camera
    assert camera is not None
    for point in POINTS:
        x, y = formula(point[0] / point[2], point[1] / point[2])
        expected = [500 * x + 310 + 0.5, 500 * y + 250 + 0.5]  # pixel centres from 0
        assert project(camera, point[None])[0] == pytest.approx(expected, abs=1e-9)


def test_a_pose_is_made_of_rotation_and_centre(tmp_path: Path) -> None:
    model = read(write(tmp_path, scene()))

    second = model.images[1].cam_from_world
    assert second is not None
    assert second.center == pytest.approx([0.4, 0.0, -0.2])
    assert second.rotation[0, 2] == pytest.approx(-math.sin(0.1))


def test_types_and_data_that_cereal_wrote_once_are_found_again(tmp_path: Path) -> None:
    content = scene()
    later = {"polymorphic_id": 1, "ptr_wrapper": {"id": 9}}
    content["intrinsics"].append({"key": 5, "value": later})
    content["views"][1]["value"]["ptr_wrapper"]["data"]["id_intrinsic"] = 5

    model = read(write(tmp_path, content))

    assert model.sensors["camera_5"].camera == model.sensors["camera_0"].camera


def test_the_fields_of_a_base_class_may_be_nested(tmp_path: Path) -> None:
    content = scene("pinhole_radial_k1", disto_k1=[0.1])
    pointer = content["intrinsics"][0]["value"]["ptr_wrapper"]
    distortion = pointer["data"].pop("disto_k1")
    pointer["data"] = {"value0": pointer["data"], "disto_k1": distortion}

    assert read(write(tmp_path, content)).sensors["camera_0"].camera is not None


def test_photos_of_a_spherical_camera_are_left_out_and_counted(tmp_path: Path) -> None:
    content = scene()
    content["intrinsics"].append(intrinsic(1, "spherical", 10))
    content["intrinsics"][1]["value"]["polymorphic_id"] += 1
    content["views"].append(view(2, "c.jpg", id_intrinsic=1))
    content["structure"] = [
        {
            "key": 0,
            "value": {
                "X": [0, 0, 3],
                "observations": [{"key": k, "value": {"id_feat": 0, "x": [1, 2]}} for k in (0, 2)],
            },
        }
    ]

    model = read(write(tmp_path, content))

    assert [image.name for image in model.images] == ["a.jpg", "b.jpg"]
    assert "1 photos of a camera of the kind 'spherical' were left out" in model.notes
    assert model.observations.tolist() == [[0, 0, 0]]


def test_a_view_without_intrinsics_has_an_unknown_camera_of_its_size(tmp_path: Path) -> None:
    content = scene()
    content["views"][0] = view(0, "a.jpg", id_intrinsic=2**32 - 1)

    sensor = read(write(tmp_path, content)).sensors["unknown_640x480"]

    assert sensor.camera is None
    assert sensor.image_size == (640, 480)


def test_observations_are_the_keypoints_where_feature_files_are_absent(
    tmp_path: Path, shared_data: Path
) -> None:
    sample = shared_data / "import_samples/openmvg_maupertuis/reconstruction_global/sfm_data.json"
    shutil.copy(sample, tmp_path)

    model = read(tmp_path)

    assert model.keypoints_type == "openmvg"
    assert sum(len(image.keypoints) for image in model.images if image.keypoints is not None) > 1000
    assert reprojection_errors(model).mean() < 0.48
    assert any("absent" in note for note in model.notes)


def test_features_of_another_extraction_are_not_taken(tmp_path: Path, shared_data: Path) -> None:
    sample = shared_data / "import_samples/openmvg_maupertuis"
    shutil.copy(sample / "reconstruction_global/sfm_data.json", tmp_path)
    (tmp_path / "matches").mkdir()
    for number in range(1, 5):
        name = f"MaupertuisTest_0{number}.feat"
        lines = (sample / "matches" / name).read_text().splitlines()
        (tmp_path / "matches" / name).write_text("\n".join(reversed(lines)))

    model = read(tmp_path)

    assert model.keypoints_type == "openmvg"
    assert any("not those that the model was made of" in note for note in model.notes)


@pytest.mark.parametrize("announced", [0, 2**63 - 1])
def test_descriptors_that_announce_another_count_are_refused(
    tmp_path: Path, announced: int
) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.feat").write_text("1 2 3 0.5\n")
        (tmp_path / f"{name}.desc").write_bytes(announced.to_bytes(8, "little") + bytes(128))

    with pytest.raises(DatasetError, match="do not match the features") as caught:
        read(write(tmp_path, scene()))
    assert caught.value.code == "import.descriptors"


def test_a_malformed_feature_is_named_by_file_and_line(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.feat").write_text("1 2 3 0.5\n1 2 nan 0.5\n")

    with pytest.raises(DatasetError) as caught:
        read(write(tmp_path, scene()))
    assert caught.value.field == f"{tmp_path / 'a.feat'}:2"


def _first(content: dict[str, Any], array: str) -> Any:
    return content[array][0]["value"]


def _data(content: dict[str, Any], array: str) -> Any:
    return _first(content, array)["ptr_wrapper"]["data"]


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda c: c.pop("views"), ""),
        (lambda c: c.update(views={}), "views"),
        (lambda c: c.update(views=[]), ""),
        (lambda c: c["views"][1].update(key=0), "views[1].key"),
        (lambda c: _data(c, "views").pop("filename"), "views[0].value.ptr_wrapper.data"),
        (lambda c: _data(c, "views").update(filename=""), "views[0].value.ptr_wrapper.data"),
        (lambda c: _data(c, "views").update(filename="b.jpg"), "views[1].value.ptr_wrapper.data"),
        (lambda c: _data(c, "views").update(filename="a\0"), "views[0].value.ptr_wrapper.data"),
        (lambda c: _data(c, "views").update(width=641), "views[0].value.ptr_wrapper.data"),
        (
            lambda c: _data(c, "views").update(id_intrinsic=7),
            "views[0].value.ptr_wrapper.data.id_intrinsic",
        ),
        (
            lambda c: _first(c, "views")["ptr_wrapper"].update(id=77),
            "views[0].value.ptr_wrapper.id",
        ),
        (
            lambda c: _first(c, "intrinsics").update(polymorphic_id=4),
            "intrinsics[0].value.polymorphic_id",
        ),
        (
            lambda c: _data(c, "intrinsics").update(focal_length=-1.0),
            "intrinsics[0].value.ptr_wrapper.data",
        ),
        (
            lambda c: _data(c, "intrinsics").update(focal_length="500"),
            "intrinsics[0].value.ptr_wrapper.data.focal_length",
        ),
        (
            lambda c: _data(c, "intrinsics").update(principal_point=[1.0]),
            "intrinsics[0].value.ptr_wrapper.data.principal_point",
        ),
        (
            lambda c: _first(c, "extrinsics")["rotation"][0].__setitem__(0, 2.0),
            "extrinsics[0].value.rotation",
        ),
        (
            lambda c: _first(c, "extrinsics").update(center=[0, 0, 1e300]),
            "extrinsics[0].value.center[2]",
        ),
        (
            lambda c: c.update(structure=[{"key": 0, "value": {"X": [0, 0, 1]}}]),
            "structure[0].value",
        ),
    ],
)
def test_what_is_malformed_is_named_by_its_place(
    tmp_path: Path, change: Callable[[dict[str, Any]], Any], place: str
) -> None:
    content = scene()
    change(content)
    path = write(tmp_path, content)

    with pytest.raises(DatasetError) as caught:
        read(path)
    assert caught.value.field == (f"{path}: {place}" if place else str(path))


@pytest.mark.parametrize(
    "seen", [{"key": 9, "value": {"id_feat": 0, "x": [1, 2]}}, {"key": 0, "value": {"x": [1, 2]}}]
)
def test_an_observation_of_nothing_is_refused(tmp_path: Path, seen: dict[str, Any]) -> None:
    content = scene()
    content["structure"] = [{"key": 0, "value": {"X": [0, 0, 1], "observations": [seen]}}]

    with pytest.raises(DatasetError) as caught:
        read(write(tmp_path, content))
    assert caught.value.field is not None
    assert "structure[0].value.observations[0].value" in caught.value.field


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[" * 100_000,
        '{"views": NaN}',
        '{"views": [], "views": []}',
        '{"a": 1' + "0" * 5000 + "}",
        "[]",
        "\udcff",
    ],
    ids=["empty", "deep", "nan", "twice", "long number", "array", "not UTF-8"],
)
def test_what_is_not_usable_json_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "sfm_data.json").write_bytes(text.encode(errors="surrogateescape"))

    with pytest.raises(DatasetError) as caught:
        read(tmp_path)
    assert caught.value.code == "import.json"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        read(tmp_path)
    assert caught.value.code == "import.missing"
    assert caught.value.field == str(tmp_path / "sfm_data.json")


def test_photos_lie_where_the_file_says_unless_told_otherwise(tmp_path: Path) -> None:
    path = write(tmp_path, scene())
    assert read(path).photos is None

    (tmp_path / "photos").mkdir()
    (tmp_path / "other").mkdir()
    assert read(path).photos == tmp_path / "photos"
    assert read(path, tmp_path / "other").photos == tmp_path / "other"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sub/c.jpg", "sub/c.jpg"),
        ("sub\\c.jpg", "sub/c.jpg"),
        ("./sub//c.jpg", "sub/c.jpg"),
        ("/elsewhere/c.jpg", "c.jpg"),
        ("D:\\photos\\c.jpg", "c.jpg"),
        ("../../c.jpg", "c.jpg"),
        ("{photos}/sub/c.jpg", "sub/c.jpg"),
    ],
)
def test_names_become_relative_to_the_folder_of_photos(
    tmp_path: Path, name: str, expected: str
) -> None:
    content = scene()
    (tmp_path / "photos").mkdir()
    content["views"][1] = view(1, name.format(photos=tmp_path / "photos"))

    assert read(write(tmp_path, content)).images[1].name == expected


def test_absolute_names_that_end_alike_are_refused(tmp_path: Path) -> None:
    content = scene()
    content["views"] = [view(0, "/one/a.jpg"), view(1, "/two/a.jpg")]

    with pytest.raises(DatasetError, match="two photos have the name 'a\\.jpg'"):
        read(write(tmp_path, content))


@pytest.mark.parametrize(
    ("reader", "top", "named"),
    [
        ("openmvg", {"frames": []}, "mapping import nerfstudio"),
        ("openmvg", {"version": [], "matchesFolders": [], "views": []}, "aliceVision_exportColmap"),
        ("opensfm", {"version": [], "featuresFolders": [], "views": []}, "Meshroom"),
        ("opensfm", {"frames": []}, "mapping import nerfstudio"),
    ],
)
def test_a_file_of_another_program_is_recognized(
    tmp_path: Path, reader: str, top: Any, named: str
) -> None:
    (tmp_path / "cameras.sfm").write_text(json.dumps(top))
    with pytest.raises(DatasetError, match=named) as caught:
        read_model(reader, tmp_path / "cameras.sfm")
    assert caught.value.code == "import.json"
