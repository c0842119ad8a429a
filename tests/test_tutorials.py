"""The commands of docs/tutorials, one after the other, as their reader pastes them.

What they print is compared with what the page shows (```output), except for its numbers.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import pytest

from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from tests import docs_check

# How many commands run; your-room takes minutes more, and has its own test.
TUTORIALS = {
    "beach": 5,
    "building": 8,
    "for-others": 12,
    "from-hloc": 5,
    "robot": 4,
    "your-app": 4,
}
WITHOUT_COMMANDS = "from-hosted"
# They make maps, or start several services.
SLOW = ("for-others", "beach", "building", "from-hloc", "robot")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``make demo`` leaves in ``.demo``, smaller: its dataset, its map and two photos."""
    folder = tmp_path_factory.mktemp("demo")
    dataset = folder / "dataset"
    write_sample(dataset, images=10, size=(320, 240))
    settings = BuildSettings(dataset / "mapping", "sample", folder / "maps")
    build_map(settings, lambda *_: None)
    for camera, name in (("left", "photo.jpg"), ("right", "right.jpg")):
        photos = dataset / "query/sensors/records_data/query" / camera
        shutil.copy(photos / "0001.jpg", folder / name)
    return folder


def test_every_tutorial_is_run() -> None:
    pages = {page.stem for page in (docs_check.ROOT / "docs" / "tutorials").glob("*.md")}
    assert pages == {*TUTORIALS, WITHOUT_COMMANDS, "your-room"}


def shown(page: Path) -> list[str]:
    """Return the lines of output that a page shows."""
    blocks = re.findall(r"^```output\n(.*?)^```$", page.read_text(), re.M | re.S)
    return [line for block in blocks for line in block.splitlines() if line != "..."]


def like(line: str) -> str:
    """Return a pattern for a line of output: any numbers and versions, and any spaces."""
    parts = re.split(r"(@[\w.-]+|-?\d[\d.]*)", " ".join(line.split()))
    for i, part in enumerate(parts):
        number = r"@[\w.-]+" if part.startswith("@") else r"\s?-?\d[\d.e-]*\s?"
        parts[i] = number if i % 2 else re.escape(part)
    return "".join(parts)


@pytest.mark.parametrize(
    ("line", "printed", "is_like"),
    [
        ("position  0.94 -3.1 m", "a position 7 4.1 m", True),
        ("[0.94 0.32]", "[ 1. 2]", True),
        ("6 [0.94 0.32]", "9 [0.5 0.25 ]", True),
        ("tile  a@2026-1f", "tile b@2026-1f", False),
        ("tile  a@2026-1f", "tile a@2027-ff", True),
        ("6 matrices", "matrices", False),
    ],
)
def test_an_output_is_compared_but_for_its_numbers(line: str, printed: str, is_like: bool) -> None:
    assert bool(re.search(like(line), printed)) is is_like


def run_page(page: Path, count: int, demo: Path, folder: Path) -> None:
    """Run the commands of a page, of which so many run, beside what the demo leaves."""
    commands = docs_check.commands_of(page)
    if any(command.text.startswith("npm ") for command in commands):
        if shutil.which("npm") is None:
            pytest.skip("needs Node.js: `npm` on PATH")
        if not (docs_check.ROOT / "web" / "client" / "dist").is_dir():
            pytest.skip("needs the built client, which `make page` makes")
    shutil.copytree(demo, folder / ".demo")
    (folder / ".venv").symlink_to(Path(sys.executable).parents[1])
    for name in ("examples", "web"):
        (folder / name).symlink_to(docs_check.ROOT / name)
    desk, did = docs_check.Desk(folder), []
    try:
        for command in commands:
            what, problem = docs_check.checked(command, desk)
            assert problem == "", command.text
            if what.startswith("skipped"):
                pytest.skip(what)
            did.append(what)
    finally:
        desk.close()
    assert did.count("run") == count
    printed = " ".join(desk.printed.split())
    for line in shown(page):
        assert re.search(like(line), printed), line


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in TUTORIALS],
)
def test_the_commands_of_a_tutorial_run(name: str, demo: Path, tmp_path: Path) -> None:
    page = docs_check.ROOT / "docs" / "tutorials" / f"{name}.md"
    run_page(page, TUTORIALS[name], demo, tmp_path)
