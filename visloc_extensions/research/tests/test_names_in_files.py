"""Names of photos that are special in text: ``tests.test_names_in_files``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clients.evaluation.pairs import of_photos
from clients.evaluation.results import write_poses
from tests.test_names_in_files import BREAKS, OTHER, POSE, check_names
from visloc.errors import VislocError
from visloc.geometry import Pose
from visloc_extensions.research.evaluation.pose_files import read_poses
from visloc_extensions.research.evaluation.scoring import read_conditions


def poses(folder: Path, name: str) -> list[str]:
    write_poses(folder / "poses.txt", [(name, POSE), (OTHER, POSE)])
    found, unknown = of_photos(read_poses(folder / "poses.txt"), [OTHER, name])
    assert unknown == 0
    return list(found)


def conditions(folder: Path, name: str) -> list[str]:
    (folder / "of.txt").write_text(f"# by hand\n./{name}, night\n{OTHER}, night\n", "utf-8")
    return read_conditions([], folder / "of.txt").split([name.replace("\\", "/"), OTHER])["night"]


def test_names_come_back_or_are_refused_by_name(tmp_path: Path) -> None:
    check_names(poses, tmp_path / "poses")
    check_names(conditions, tmp_path / "conditions", BREAKS | {",", "\x85"})


def test_names_that_differ_in_one_sign_only_are_kept_apart(tmp_path: Path) -> None:
    names = ["a b.jpg", "a%20b.jpg", "#a.jpg", "a.jpg", "\u00e9.jpg", "e\u0301.jpg", "A.jpg"]
    at = [Pose(np.eye(3), np.array([float(row), 0, 0])) for row in range(len(names))]
    write_poses(tmp_path / "poses.txt", zip(names, at, strict=True))
    with pytest.raises(VislocError, match=r"a%20b\.jpg") as caught:
        of_photos(read_poses(tmp_path / "poses.txt"), names)
    assert caught.value.code == "poses.ambiguous"
    del names[1], at[1]
    write_poses(tmp_path / "poses.txt", zip(names, at, strict=True))
    found, _ = of_photos(read_poses(tmp_path / "poses.txt"), names)
    assert {name: known.pose.translation[0] for name, known in found.items()} == {
        name: pose.translation[0] for name, pose in zip(names, at, strict=True)
    }


@pytest.mark.parametrize(
    "text",
    [
        "#a.jpg 1 0 0 0 1 2 3\n",
        "%23a.jpg 1 0 0 0 1 2 3\n",
        "# name qw qx qy qz tx ty tz\n#a.jpg 1 0 0 0 1 2 3\n",
    ],
)
def test_poses_of_other_tools_of_names_that_begin_like_comments_are_read(
    tmp_path: Path, text: str
) -> None:
    (tmp_path / "poses.txt").write_text(text)
    found, unknown = of_photos(read_poses(tmp_path / "poses.txt"), ["#a.jpg", "b.jpg"])
    assert list(found) == ["#a.jpg"]
    assert unknown == 0
    commented, unknown = of_photos(read_poses(tmp_path / "poses.txt"), ["a.jpg", "b.jpg"])
    assert (commented, unknown) == ({}, int(text.startswith("%")))
