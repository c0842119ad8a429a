"""Matching again after the pose, on the sample, whose poses are exact."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.after_the_pose import WAYS, main


def test_the_command_compares_its_ways(
    sample: Path, built_maps: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(built_maps / "room", sample / "query")

    medians = dict(re.findall(r"^\| (\D+?) \| (\S+) cm", capsys.readouterr().out, re.MULTILINE))
    assert tuple(medians) == tuple(WAYS)
    assert all(float(centimetres) < 1 for centimetres in medians.values())
