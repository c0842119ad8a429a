"""Whether pytest would run every test file, however few of them this run selects."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TESTS = (ROOT / "tests", *ROOT.glob("visloc_extensions/*/tests"))


def test_every_test_file_is_collected(request: pytest.FixtureRequest, tmp_path: Path) -> None:
    session = request.session

    def ignored(path: Path) -> bool:
        hook = session.gethookproxy(path.parent)
        return bool(hook.pytest_ignore_collect(collection_path=path, config=session.config))

    hidden = tmp_path / ".hidden"
    hidden.mkdir()
    assert ignored(hidden)  # pytest asks this hook about folders, too
    files = {file for folder in TESTS for file in folder.rglob("test_*.py")}
    folders = {folder for file in files for folder in file.parents if ROOT in folder.parents}
    assert not sorted(path for path in files | folders if ignored(path))
