from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.features import calibration
from visloc.features.calibration import calibrate
from visloc.features.graph import Ranges


class _Extremes:
    """Counts the pictures, in place of a network."""

    def __init__(self) -> None:
        self.seen = 0

    def __call__(self, image: NDArray[np.float32]) -> list[Any]:
        self.seen += 1
        return [np.float32(image.min()), np.float32(image.max())]


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pictures = [np.full((4, 4, 3), value, np.uint8) for value in (10, 30)]
    monkeypatch.setattr(calibration, "pictures", lambda: pictures)
    return tmp_path / "visloc" / "networks"


def _calibrated(graph: _Extremes) -> Ranges:
    return calibrate("net", ["first"], lambda: graph, lambda rgb: rgb.astype(np.float32))  # type: ignore[arg-type, return-value]


def test_ranges_are_averaged_over_pictures_and_measured_once(cache: Path) -> None:
    first, second = _Extremes(), _Extremes()
    assert _calibrated(first) == _calibrated(second) == {"first": (20.0, 20.0)}
    assert (first.seen, second.seen) == (2, 0)
    assert [path.name for path in cache.iterdir()] == ["net-1.json"]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\x00",
        b"[]",
        b"{}",
        b'{"other": [0, 1]}',
        b'{"first": [0]}',
        b'{"first": [0, "x"]}',
        b'{"first": null}',
        b'{"first": [NaN, 1]}',
        b'{"first": [0, Infinity]}',
        b'{"first": [2, 1]}',
        b"[" * 100_000,
    ],
)
def test_damaged_cache_is_made_anew(
    content: bytes, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache.mkdir(parents=True)
    path = cache / "net-1.json"
    path.write_bytes(content)
    graph = _Extremes()
    with caplog.at_level(logging.INFO):
        assert _calibrated(graph) == {"first": (20.0, 20.0)}
    assert graph.seen == 2
    assert "made anew" in caplog.text
    assert json.loads(path.read_bytes()) == {"first": [20.0, 20.0]}


def test_cache_that_cannot_be_written_is_done_without(
    cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache.parent.parent.joinpath("visloc").write_text("a file where the folder should be")
    with caplog.at_level(logging.INFO):
        assert _calibrated(_Extremes()) == {"first": (20.0, 20.0)}
    assert "not kept" in caplog.text


def test_user_without_a_home_is_calibrated_for(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", no_home)
    assert _calibrated(_Extremes()) == {"first": (20.0, 20.0)}
    assert not cache.exists()


def test_pictures_are_the_same_each_time_and_full_of_contrast() -> None:
    first, again = calibration.pictures(), calibration.pictures()
    for picture, same in zip(first, again, strict=True):
        assert picture.shape == (240, 320, 3)
        assert picture.std() > 10
        np.testing.assert_array_equal(picture, same)
