"""No field of a file is dropped in silence: without it, or with one more, a file reads otherwise.

Every field of a small complete file is taken out in turn, and an unknown one is put into every
object and every line. What is read then must differ: in its values, in a note, or by an error.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

from clients.evaluation.pose_files import read_poses
from clients.evaluation.queries import read_queries
from clients.evaluation.scoring import read_conditions
from mapping.frames.georeference import read_correspondences
from mapping.importers import read_model
from mapping.importers.hloc import import_features
from visloc.errors import VislocError
from visloc.kapture import read_dataset
from visloc.kapture.pairs import read_pair_rows

Read = Callable[[Path], object]
FIRST = 2**31  # where cereal names a type or has the data of a pointer


def transforms(folder: Path) -> dict[str, Any]:
    for name in ("a.jpg", "b.jpg", "c.jpg", "m.png"):
        Image.new("L", (32, 24)).save(folder / name)
    Image.new("I;16", (32, 24)).save(folder / "d.png")
    matrix = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    frame = {"transform_matrix": matrix, "w": 64, "h": 48}
    return {
        **{"k1": 0.01, "k2": 0.02, "k3": 0.03, "fl_x": 50.0, "fl_y": 51.0, "cx": 31.0, "cy": 25.0},
        **{"camera_angle_x": 1.5, "camera_angle_y": 1.4, "x_fov": 80, "y_fov": 81},
        **{"integer_depth_scale": 0.25, "applied_transform": matrix[:3], "applied_scale": 2.0},
        **{"ply_file_path": "p.ply", "aabb_scale": 16},
        "frames": [
            {"file_path": "a.jpg", "p1": 0.04, "p2": 0.05, "mask_path": "m.png", **frame}
            | {"fl_x": 52, "fl_y": 53, "depth_file_path": "d.png", "sharpness": 3.5},
            {"file_path": "b.jpg", "is_fisheye": True, "k4": 0.06, "depth_path": "d.png", **frame},
            {"file_path": "c.jpg", "camera_model": "OPENCV_FISHEYE", "k4": 0.07, **frame}
            | {"camera_angle_x": 1.138, "y_fov": 50.0, "cx": 30.0, "cy": 26.0},
        ],
    }


def openmvg(_folder: Path) -> dict[str, Any]:
    def pointer(number: int, data: dict[str, Any], **kind: Any) -> dict[str, Any]:
        return {**kind, "ptr_wrapper": {"id": FIRST + number, "data": data}}

    size = {"width": 64, "height": 48}
    seen = [{"key": 0, "value": {"id_feat": 3, "x": [30.0, 20.0]}}]
    return {
        **{"sfm_data_version": "0.3", "root_path": "photos", "control_points": [7]},
        "views": [
            {
                "key": key,
                "value": pointer(
                    key + 1,
                    {"local_path": "d", "filename": f"{key}.jpg", "id_view": key, **size}
                    | {"id_intrinsic": 7, "id_pose": key, "center": [1.0, 2.0, 3.0]},
                    polymorphic_id=1073741824,
                ),
            }
            for key in (0, 1)
        ],
        "intrinsics": [
            {
                "key": 7,
                "value": pointer(
                    9,
                    {"value0": {**size, "focal_length": 50.0, "principal_point": [31.0, 25.0]}}
                    | {"disto_k3": [0.1, 0.2, 0.3]},
                    polymorphic_id=FIRST + 1,
                    polymorphic_name="pinhole_radial_k3",
                ),
            }
        ],
        "extrinsics": [
            {"key": key, "value": {"rotation": np.eye(3).tolist(), "center": [key, 0.5, 0.25]}}
            for key in (0, 1)
        ],
        "structure": [{"key": 0, "value": {"X": [0.1, 0.2, 4.0], "observations": seen}}],
    }


def opensfm(folder: Path) -> list[dict[str, Any]]:
    (folder / "tracks.csv").write_text(TRACKS)
    shot = {"rotation": [0, 0.1, 0], "camera": "own", "gps_dop": 5.0, "capture_time": 7.0}
    camera = {"projection_type": "brown", "width": 64, "height": 48, "focal_x": 0.8, "c_x": 0.01}
    camera |= {"focal_y": 0.7, "c_y": 0.02, "k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.4, "p2": 0.5}
    return [
        {
            "cameras": {"own": camera},
            "shots": {
                f"{i}.jpg": {**shot, "translation": [i, 0, 1], "gps_position": [i, 2.0, 3.0]}
                for i in range(3)
            },
            "points": {"17": {"color": [3.0, 2.0, 1.0], "coordinates": [0.1, 0.2, 4.0]}},
            "reference_lla": {"latitude": 40.0, "longitude": 3.0, "altitude": 2.0},
            "biases": [1.5],
        }
    ]


TRACKS = "OPENSFM_TRACKS_VERSION_v1\n0.jpg\t17\t3\t0.1\t0.2\t0.01\t1\t2\t3\n"
JSONS = {
    "nerfstudio": ("transforms.json", transforms),
    "openmvg": ("sfm_data.json", openmvg),
    "opensfm": ("reconstruction.json", opensfm),
}


def objects(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Go through the places of all objects in a value."""
    if isinstance(value, dict):
        yield path
    if not isinstance(value, dict | list):
        return
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
        yield from objects(inner, (*path, key))


def at(value: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        value = value[key]
    return value


def told(read: Read, path: Path) -> str:
    """Return all that reading a file tells: the values with their notes, or the error."""
    try:
        return shown(read(path))
    except VislocError as error:
        return f"{error.code} {error}"


def shown(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.tolist()}"
    if isinstance(value, dict):
        return str({key: shown(inner) for key, inner in value.items()})
    if isinstance(value, tuple | list):
        return str([shown(inner) for inner in value])
    if hasattr(value, "__dataclass_fields__"):
        return str([shown(getattr(value, each.name)) for each in fields(value)])  # type: ignore[arg-type]
    return str(value)


@pytest.mark.parametrize("name", JSONS)
def test_each_field_of_json_is_used_refused_or_counted(tmp_path: Path, name: str) -> None:
    file, make = JSONS[name]
    whole = make(tmp_path)
    read = partial(read_model, name)

    def outcome(value: Any) -> str:
        (tmp_path / file).write_text(json.dumps(value))
        return told(read, tmp_path)

    before = outcome(whole)
    assert "import." not in before
    silent = []
    for path in objects(whole):
        more = copy.deepcopy(whole)
        at(more, path)["unknown_field"] = {"value": 7}
        if "unknown_field" not in outcome(more):
            silent.append((path, "unknown_field"))
        for key in at(whole, path):
            less = copy.deepcopy(whole)
            del at(less, path)[key]
            if outcome(less) == before:
                silent.append((path, key))
    assert silent == []


IDENTITY = "1 0 0\n0 1 0\n0 0 1\n"
CAMERA = "PINHOLE 64 48 50 51 31 25"
KAPTURE = {
    "sensors.txt": f"# kapture format: 1.1\nc, left, camera, {CAMERA.replace(' ', ', ')}\n"
    "r, right, camera, UNKNOWN_CAMERA, 64, 48\ng, , gnss, EPSG:4326\nw, own, wifi, 7\n",
    "rigs.txt": "rig, c, 1, 0, 0, 0, 0, 0, 0\nrig, r, 1, 0, 0, 0, 1, 2, 3\n",
    "trajectories.txt": "1, rig, 1, 0, 0, 0, 4, 5, 6\n2, c, 1, 0, 0, 0, 7, 8, 9\n",
    "records_camera.txt": "1, c, a.jpg\n1, r, b.jpg\n2, c, d.jpg\n",
    "records_gnss.txt": "1, g, 3.5, 4.5, 5.5, 6.5, 7.5\n",
    "records_wifi.txt": "1, w, x, 2400, -60, y, 0, 1\n",
}


def matches_of(folder: Path) -> object:
    return [row[:3] for row in read_pair_rows(folder / "pairs.txt")]


# The files of each format, those whose lines are changed first; and what reads them.
TEXTS: dict[str, tuple[dict[str, str], str, Read]] = {
    "bundler": (
        {
            "bundle.out": f"# Bundle file v0.3\n2 1\n50 0.1 0.2\n{IDENTITY}1 2 3\n"
            f"50 0.1 0.2\n{IDENTITY}4 5 6\n0.5 0.25 -9\n3 2 1\n2 0 7 3 4 1 8 5 6\n",
            "list.txt": "a.jpg 0 123.5\nb.jpg 0 123.5\n",
        },
        " ",
        partial(read_model, "bundler"),
    ),
    "nvm": (
        {
            "a.nvm": "NVM_V3 FixedK 50 32 50 24\n\n2\na.jpg 50 1 0 0 0 1 2 3 0.1 0\n"
            "b.jpg 50 1 0 0 0 4 5 6 0.2 0\n1\n0.5 0.25 9 3 2 1 2 0 7 3 4 1 8 5 6\n0\n"
        },
        " ",
        partial(read_model, "nvm"),
    ),
    "colmap": (
        {
            "cameras.txt": f"1 {CAMERA}\n",
            "images.txt": "1 1 0 0 0 1 2 3 1 a.jpg\n3.5 4.5 7 5.5 6.5 -1\n"
            "2 1 0 0 0 4 5 6 1 b.jpg\n7.5 8.5 7\n",
            "points3D.txt": "7 1 2 3 30 20 10 0.5 1 0 2 0\n",
        },
        " ",
        partial(read_model, "colmap"),
    ),
    "opensfm": (
        {"tracks.csv": TRACKS, "reconstruction.json": ""},
        "\t",
        partial(read_model, "opensfm"),
    ),
    "kapture": ({f"sensors/{name}": text for name, text in KAPTURE.items()}, ", ", read_dataset),
    "pairs": ({"pairs.txt": "a.jpg, b.jpg, 0.5\n"}, ", ", matches_of),
    "hloc pairs": ({"pairs.txt": "a.jpg b.jpg 0.5\n"}, " ", matches_of),
    "list": (
        {"list.txt": f"a.jpg {CAMERA}\nb.jpg UNKNOWN_CAMERA 64 48\n"},
        " ",
        lambda folder: read_queries(folder / "list.txt").photos,
    ),
    "poses": (
        {"poses.txt": "a.jpg 1 0 0 0 1 2 3\n"},
        " ",
        lambda folder: read_poses(folder / "poses.txt"),
    ),
    "control points": (
        {"p.csv": "x,y,z,latitude,longitude,altitude\n" + "1,2,3,40,5,6\n" * 3},
        ",",
        # The map is asked for photos only, of which these rows have none.
        lambda folder: read_correspondences(None, folder / "p.csv"),  # type: ignore[arg-type]
    ),
    "conditions": (
        {"of.txt": "a.jpg, night\n"},
        ", ",
        lambda folder: read_conditions([], folder / "of.txt"),
    ),
}


# Lines that tell nothing: blank ones, the mark at the end of a NVM file, kapture's comments.
ENDS = ("", "0")


@pytest.mark.parametrize("name", TEXTS)
def test_each_field_of_a_line_is_used_refused_or_counted(tmp_path: Path, name: str) -> None:
    files, comma, read = TEXTS[name]
    for photo in ("a.jpg", "b.jpg"):
        Image.new("L", (64, 48)).save(tmp_path / photo)
    for file, text in files.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    if "reconstruction.json" in files:
        (tmp_path / "reconstruction.json").write_text(json.dumps(opensfm(tmp_path)))
    before = told(read, tmp_path)
    assert "expected" not in before
    silent = []
    for file, text in files.items():
        lines = text.splitlines()
        for number, line in enumerate(lines):
            cells = line.split(comma)
            changed = [comma.join(cells[:i] + cells[i + 1 :]) for i in range(len(cells))]
            for new in (*changed, *([] if line.startswith("#") else [f"{line}{comma}7"])):
                others = "\n".join([*lines[:number], new, *lines[number + 1 :], ""])
                (tmp_path / file).write_text(others)
                if told(read, tmp_path) == before and line not in ENDS:
                    silent.append((file, line, new))
        (tmp_path / file).write_text(f"{text}7\n")
        if told(read, tmp_path) == before:
            silent.append((file, "", "7"))
        (tmp_path / file).write_text(text)
    assert silent == []


def test_the_reference_of_opensfm_may_be_a_file_of_its_own(tmp_path: Path) -> None:
    (top,) = opensfm(tmp_path)
    reference = top.pop("reference_lla") | {"unknown_field": 7}
    (tmp_path / "reconstruction.json").write_text(json.dumps([top]))
    (tmp_path / "reference_lla.json").write_text(json.dumps(reference))
    notes = read_model("opensfm", tmp_path).notes
    assert "reference_lla.json has fields that are not read: unknown_field (1)" in notes


def test_each_array_of_hloc_is_used_refused_or_counted(tmp_path: Path) -> None:
    groups: dict[str, dict[str, Any]] = {
        "a.jpg": {"keypoints": np.ones((3, 2)), "descriptors": np.eye(4)[:, :3]},
        "b.jpg": {"keypoints": np.ones((2, 2)), "descriptors": np.eye(4)[:, :2]},
        "c.jpg": {"global_descriptor": np.ones(4), "image_size": np.ones(2)},
        "a.jpg/b.jpg": {"matches0": np.array([0, 1, -1]), "matching_scores0": np.full(3, 0.5)},
    }
    runs = iter(range(100))

    def outcome(of: dict[str, dict[str, Any]]) -> str:
        file, output = tmp_path / "f.h5", tmp_path / str(next(runs))
        with h5py.File(file, "w") as opened:
            for group, arrays in of.items():
                for key, value in arrays.items():
                    opened[f"{group}/{key}"] = value

        def read(path: Path) -> object:
            made = import_features([path], output, "own")
            return made, {
                str(each.relative_to(output)): each.read_bytes()
                for each in sorted(output.rglob("*"))
                if each.is_file()
            }

        return told(read, file)

    before = outcome(groups)
    for group, arrays in groups.items():
        assert "unknown_array" in outcome(groups | {group: arrays | {"unknown_array": np.ones(2)}})
        for key in arrays:
            less = {name: array for name, array in arrays.items() if name != key}
            assert outcome(groups | {group: less}) != before


def test_tables_that_kapture_has_and_we_do_not_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "sensors").mkdir()
    for file, text in KAPTURE.items():
        (tmp_path / "sensors" / file).write_text(text)
    assert not any("is not read" in note for note in read_dataset(tmp_path).notes)
    (tmp_path / "sensors" / "records_lidar.txt").write_text("1, l, a.ply\n")
    assert "sensors/records_lidar.txt is not read" in read_dataset(tmp_path).notes
