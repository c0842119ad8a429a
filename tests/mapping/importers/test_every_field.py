"""No field of a file is dropped in silence: ``every_field``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from clients.evaluation.queries import read_queries
from mapping.frames.georeference import read_correspondences
from mapping.importers import read_model
from tests.mapping.importers.every_field import Read, check_json, check_lines
from visloc.kapture import read_dataset
from visloc.kapture.pairs import read_pair_rows


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


def test_each_field_of_nerfstudio_is_used_refused_or_counted(tmp_path: Path) -> None:
    whole = transforms(tmp_path)
    check_json(partial(read_model, "nerfstudio"), tmp_path / "transforms.json", whole)


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
    "kapture": ({f"sensors/{name}": text for name, text in KAPTURE.items()}, ", ", read_dataset),
    "pairs": ({"pairs.txt": "a.jpg, b.jpg, 0.5\n"}, ", ", matches_of),
    "hloc pairs": ({"pairs.txt": "a.jpg b.jpg 0.5\n"}, " ", matches_of),
    "list": (
        {"list.txt": f"a.jpg {CAMERA}\nb.jpg UNKNOWN_CAMERA 64 48\n"},
        " ",
        lambda folder: read_queries(folder / "list.txt").photos,
    ),
    "control points": (
        {"p.csv": "x,y,z,latitude,longitude,altitude\n" + "1,2,3,40,5,6\n" * 3},
        ",",
        # The map is asked for photos only, of which these rows have none.
        lambda folder: read_correspondences(None, folder / "p.csv"),  # type: ignore[arg-type]
    ),
}


@pytest.mark.parametrize("name", TEXTS)
def test_each_field_of_a_line_is_used_refused_or_counted(tmp_path: Path, name: str) -> None:
    files, comma, read = TEXTS[name]
    check_lines(read, tmp_path, files, comma)


def test_tables_that_kapture_has_and_we_do_not_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "sensors").mkdir()
    for file, text in KAPTURE.items():
        (tmp_path / "sensors" / file).write_text(text)
    assert not any("is not read" in note for note in read_dataset(tmp_path).notes)
    (tmp_path / "sensors" / "records_lidar.txt").write_text("1, l, a.ply\n")
    assert "sensors/records_lidar.txt is not read" in read_dataset(tmp_path).notes
