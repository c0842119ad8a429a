"""The benchmark of matching runs on the sample, and itself checks that all ways find equal rows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.matching import main, ways


def test_the_command_compares_every_way(
    sample: Path, built_maps: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(built_maps / "room", sample / "query", photos=1, repeats=1)

    row = r"^\| ([\w ,-]+) \| ([\d.]+) \| ([\d.]+) \| (\d+) \|$"
    rows = re.findall(row, capsys.readouterr().out, re.M)
    assert [name for name, *_ in rows] == list(ways())
    assert all(float(each) > 0 for _, *figures in rows for each in figures)
