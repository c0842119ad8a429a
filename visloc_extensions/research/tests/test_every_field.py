"""No field of a file is dropped in silence: ``tests.mapping.importers.every_field``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.mapping.importers.every_field import Read, check_lines, told
from visloc_extensions.research.evaluation.pose_files import read_poses
from visloc_extensions.research.evaluation.scoring import read_conditions
from visloc_extensions.research.hloc import import_features

# The files of each format, those whose lines are changed first; and what reads them.
TEXTS: dict[str, tuple[dict[str, str], str, Read]] = {
    "poses": (
        {"poses.txt": "a.jpg 1 0 0 0 1 2 3\n"},
        " ",
        lambda folder: read_poses(folder / "poses.txt"),
    ),
    "conditions": (
        {"of.txt": "a.jpg, night\n"},
        ", ",
        lambda folder: read_conditions([], folder / "of.txt"),
    ),
}


@pytest.mark.parametrize("name", TEXTS)
def test_each_field_of_a_line_is_used_refused_or_counted(tmp_path: Path, name: str) -> None:
    files, comma, read = TEXTS[name]
    check_lines(read, tmp_path, files, comma)


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
