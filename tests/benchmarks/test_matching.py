"""What matching costs, on the sample: the command itself checks that both ways find equal pairs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.matching import PARTS, main


def test_the_command_compares_every_part(
    sample: Path, built_maps: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(built_maps / "room", sample / "query", photos=1, repeats=1)

    rows = re.findall(r"^\| ([\w ]+) \| ([\d.]+) \| ([\d.]+) \|", capsys.readouterr().out, re.M)
    assert tuple(part for part, _, _ in rows) == PARTS
    for times in zip(*((float(before), float(now)) for _, before, now in rows), strict=True):
        assert all(each > 0 for each in times)
