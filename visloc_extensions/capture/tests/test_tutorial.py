"""The tutorial of your room: its commands, what it shows, and the map that comes out."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapping.frames.anchor import align_poses
from samples.scene import ROOM_SIZE_M
from tests import docs_check
from tests.test_tutorials import like, shown
from visloc.archive import Map, MapStore
from visloc.geometry import Pose

PAGE = docs_check.ROOT / "docs" / "tutorials" / "your-room.md"


@pytest.fixture(scope="module")
def film() -> dict[str, Any]:
    """The names of examples/film.py."""
    return runpy.run_path(str(docs_check.ROOT / "examples" / "film.py"))


def test_the_page_tells_the_size_of_the_film_s_room_and_walk(film: dict[str, Any]) -> None:
    page = " ".join(PAGE.read_text().split())
    length, width, height = ROOM_SIZE_M
    assert f"{length:.2f} m long, {width:.2f} m wide and {height:.2f} m high" in page
    centers = np.array([pose.center for pose in film["poses_of_film"]()])
    along, across, _ = np.ptp(centers, axis=0)
    assert f"{along:.1f} m long and {across:.1f} m wide" in page
    scales = re.findall(r"--scale walk\.mp4@(\d+) walk\.mp4@(\d+) ([\d.]+)m", page)
    assert len(scales) == 2
    for first, second, metres in scales:
        frames = [int(at) * film["FRAMES_PER_SECOND"] for at in (first, second)]
        apart = np.linalg.norm(np.subtract(*centers[frames]))
        assert apart == pytest.approx(float(metres), abs=0.005)


@pytest.mark.slow
def test_the_commands_of_the_tutorial_run_on_a_ten_second_clip(
    film: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / ".venv").symlink_to(Path(sys.executable).parents[1])
    (tmp_path / "examples").symlink_to(docs_check.ROOT / "examples")
    desk = docs_check.Desk(tmp_path)
    did, versions = [], []
    store = MapStore(tmp_path / "maps")
    try:
        for command in docs_check.commands_of(PAGE):
            what, problem = docs_check.checked(command, desk)
            assert problem == "", command.text
            did.append(what)
            if command.words[:2] == ["mapping", "capture"]:
                versions.append(store.open("room"))
    finally:
        desk.close()
    assert did.count("run") == 8
    printed = " ".join(desk.printed.split())
    for line in shown(PAGE):
        assert re.search(like(line), printed), line
    of_film, with_photo = versions
    for opened in versions:
        assert opened.manifest.world.metric
        assert_has_the_shape_of(film, opened)
    assert len(of_film.images) >= 30
    assert "photos/photo.jpg" in [image.name for image in with_photo.images]
    picture = cv2.imread(str(tmp_path / "room-capture.png"))
    assert picture is not None
    assert np.ptp(picture) > 200


def assert_has_the_shape_of(film: dict[str, Any], opened: Map) -> None:
    """Compare the path in a map with the true one: where the camera was, and lengths on the way."""
    poses, rate = film["poses_of_film"](), film["FRAMES_PER_SECOND"]
    found, true = [], []
    for image, row in zip(opened.images, opened.image_poses, strict=True):
        if at := re.fullmatch(r"walk/([\d.]+)s\.jpg", image.name):
            found.append(Pose.from_quaternion(row[:4], row[4:]))
            true.append(poses[round(float(at[1]) * rate)])
    true_from_map = align_poses(found, true)
    centers = true_from_map.apply(np.array([pose.center for pose in found]))
    truth = np.array([pose.center for pose in true])
    # Of films with three different noises: 1.5 cm at most, 0.2 % in scale, 1 % in each second.
    assert np.linalg.norm(centers - truth, axis=1).max() < 0.04
    assert true_from_map.scale == pytest.approx(1.0, abs=0.03)
    steps = [np.linalg.norm(np.diff(path, axis=0), axis=1) for path in (centers, truth)]
    for start in range(0, len(truth) - rate, rate):  # of about each second
        ours, theirs = (step[start : start + rate].sum() for step in steps)
        assert ours == pytest.approx(theirs, rel=0.03)
