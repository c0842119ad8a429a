"""The map at the top of docs/architecture.md against the tree; imports are import-linter's."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("visloc", "mapping", "service", "clients", "visloc_api", "visloc_extensions")


def mapped() -> Iterator[str]:
    """The folders (with a slash at the end) and files of the map, without absent extensions."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    (tree,) = re.findall(r"```text\n(.*?)```", page.partition("\n## ")[0], re.DOTALL)
    folders: list[str] = []
    for line in tree.splitlines():
        depth = (len(line) - len(line.lstrip())) // 2
        names = re.split(r"  +", line.strip())[0].split(", ")
        if not all(re.fullmatch(r"[\w.]+/?", name) for name in names):
            continue  # the rest of the line above
        above = "".join(folders[:depth])
        extension = re.match(r"visloc_extensions/\w+/", above + names[0])
        for name in names:
            if extension is None or (ROOT / extension[0]).exists():
                yield above + name
        if names[0].endswith("/"):
            folders[depth:] = [names[0]]


def test_the_map_names_every_folder_once() -> None:
    folders = [path for path in mapped() if path.endswith("/")]
    of_packages = {path for path in folders if path.split("/")[0] in PACKAGES}
    there = {
        file.parent.relative_to(ROOT).as_posix() + "/"
        for package in PACKAGES
        for file in (ROOT / package).rglob("*.py")
        if file.parent.name != "tests"
    }
    assert len(folders) == len(set(folders))
    assert of_packages == there


def test_what_the_map_names_is_there() -> None:
    paths = list(mapped())
    assert len(paths) > 40
    assert not [path for path in paths if not (ROOT / path).exists()]
