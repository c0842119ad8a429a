"""No field of a file is dropped in silence: ``tests.mapping.importers.every_field``."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapping.importers import read_model
from tests.mapping.importers.every_field import check_json, check_lines

FIRST = 2**31  # where cereal names a type or has the data of a pointer


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
JSONS = {"openmvg": ("sfm_data.json", openmvg), "opensfm": ("reconstruction.json", opensfm)}


@pytest.mark.parametrize("name", JSONS)
def test_each_field_of_json_is_used_refused_or_counted(tmp_path: Path, name: str) -> None:
    file, make = JSONS[name]
    check_json(partial(read_model, name), tmp_path / file, make(tmp_path))


IDENTITY = "1 0 0\n0 1 0\n0 0 1\n"
# The files of each format, those whose lines are changed first; and what separates fields.
TEXTS: dict[str, tuple[dict[str, str], str]] = {
    "bundler": (
        {
            "bundle.out": f"# Bundle file v0.3\n2 1\n50 0.1 0.2\n{IDENTITY}1 2 3\n"
            f"50 0.1 0.2\n{IDENTITY}4 5 6\n0.5 0.25 -9\n3 2 1\n2 0 7 3 4 1 8 5 6\n",
            "list.txt": "a.jpg 0 123.5\nb.jpg 0 123.5\n",
        },
        " ",
    ),
    "nvm": (
        {
            "a.nvm": "NVM_V3 FixedK 50 32 50 24\n\n2\na.jpg 50 1 0 0 0 1 2 3 0.1 0\n"
            "b.jpg 50 1 0 0 0 4 5 6 0.2 0\n1\n0.5 0.25 9 3 2 1 2 0 7 3 4 1 8 5 6\n0\n"
        },
        " ",
    ),
    "opensfm": ({"tracks.csv": TRACKS}, "\t"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_each_field_of_a_line_is_used_refused_or_counted(tmp_path: Path, name: str) -> None:
    if name == "opensfm":
        (tmp_path / "reconstruction.json").write_text(json.dumps(opensfm(tmp_path)))
    check_lines(partial(read_model, name), tmp_path, *TEXTS[name])


def test_the_reference_of_opensfm_may_be_a_file_of_its_own(tmp_path: Path) -> None:
    (top,) = opensfm(tmp_path)
    reference = top.pop("reference_lla") | {"unknown_field": 7}
    (tmp_path / "reconstruction.json").write_text(json.dumps([top]))
    (tmp_path / "reference_lla.json").write_text(json.dumps(reference))
    notes = read_model("opensfm", tmp_path).notes
    assert "reference_lla.json has fields that are not read: unknown_field (1)" in notes
