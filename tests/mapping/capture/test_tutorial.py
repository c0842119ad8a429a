from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests import docs_check
from visloc.archive import MapStore

PAGE = docs_check.ROOT / "docs" / "tutorials" / "your-room.md"


@pytest.mark.slow
def test_the_commands_of_the_tutorial_run_on_a_ten_second_clip(tmp_path: Path) -> None:
    (tmp_path / ".venv").symlink_to(Path(sys.executable).parents[1])
    (tmp_path / "examples").symlink_to(docs_check.ROOT / "examples")
    desk = docs_check.Desk(tmp_path)
    did = []
    try:
        for command in docs_check.commands_of(PAGE):
            what, problem = docs_check.checked(command, desk)
            assert problem == "", command.text
            did.append(what)
    finally:
        desk.close()
    assert did.count("run") == 5
    opened = MapStore(tmp_path / "maps").open("room")
    assert opened.manifest.world.metric
    assert len(opened.images) >= 30
    picture = cv2.imread(str(tmp_path / "room-capture.png"))
    assert picture is not None
    assert np.ptp(picture) > 200
