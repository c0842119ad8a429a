from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from visloc.features.backends.calibration import PICTURES, RECORDED
from visloc_extensions.training.__main__ import main
from visloc_extensions.training.ranges import paint_pictures


def test_pictures_are_those_that_the_code_paints(tmp_path: Path) -> None:
    paint_pictures(tmp_path / "painted.png")
    painted, kept = (
        np.asarray(Image.open(path), np.int16) for path in (tmp_path / "painted.png", PICTURES)
    )
    # The last bits of a few pixels differ by the processor.
    assert painted.shape == kept.shape
    assert np.abs(painted - kept).mean() < 0.01


def test_recorded_ranges_are_those_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ranges", "--output", str(tmp_path)]) == 0
    paths = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert [path.name.partition("-")[0] for path in paths] == ["xfeat", "faster2d2"]
    for path in paths:
        measured, recorded = (
            json.loads(each.read_bytes()) for each in (path, RECORDED / path.name)
        )
        assert list(measured) == list(recorded)
        for name, ends in measured.items():
            np.testing.assert_allclose(ends, recorded[name], rtol=2e-3)
