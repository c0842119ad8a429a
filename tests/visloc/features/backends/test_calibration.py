from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.features.backends import calibration
from visloc.features.backends.calibration import measure, ranges_of
from visloc.features.backends.openvino import Ranges

FILE_NAME = f"net-{'0' * 64}-1.json"


class _Extremes:
    """Counts the pictures, in place of a network."""

    def __init__(self) -> None:
        self.seen = 0

    def __call__(self, image: NDArray[np.float32]) -> list[Any]:
        self.seen += 1
        return [np.float32(image.min()), np.float32(image.max())]


class _Constants:
    """Sees these extremes in every picture."""

    def __init__(self, *extremes: float) -> None:
        self._extremes = extremes

    def __call__(self, _image: NDArray[np.float32]) -> list[Any]:
        return [np.float32(value) for value in self._extremes]


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pictures = [np.array([[[0, 0, value]]], np.uint8) for value in (10, 30)]
    monkeypatch.setattr(calibration, "pictures", lambda: pictures)
    return tmp_path / "visloc" / "networks"


def _ranges(graph: _Extremes | _Constants) -> Ranges:
    names = ["first"]
    return ranges_of(
        "net",
        "0" * 64,
        names,
        lambda: measure(names, graph, lambda rgb: rgb.astype(np.float32)),  # type: ignore[arg-type]
    )


def test_ranges_are_averaged_over_pictures_and_measured_once(cache: Path) -> None:
    first, second = _Extremes(), _Extremes()
    assert _ranges(first) == _ranges(second) == {"first": (0.0, 20.0)}
    assert (first.seen, second.seen) == (2, 0)
    assert [path.name for path in cache.iterdir()] == [FILE_NAME]


def test_recorded_ranges_are_neither_measured_nor_cached(
    cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(calibration, "RECORDED", tmp_path)
    (tmp_path / f"net-{'0' * 64}.json").write_text('{"first": [-1, 2]}')
    graph = _Extremes()
    assert _ranges(graph) == {"first": (-1.0, 2.0)}
    assert graph.seen == 0
    assert not cache.exists()


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
        b'{"first": [1, -1]}',
        b'{"first": [1, 20]}',
        b'{"first": [-20, -1]}',
        b'{"first": [0, 0]}',
        b'{"first": [0, 1e-30]}',
        b'{"first": [0, 3e38]}',
        b'{"first": [-3e38, 3e38]}',
        b'{"first": [0, %s]}' % (b"9" * 400),
        b"[" * 100_000,
    ],
)
def test_damaged_cache_is_measured_again(
    content: bytes, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache.mkdir(parents=True)
    path = cache / FILE_NAME
    path.write_bytes(content)
    graph = _Extremes()
    with caplog.at_level(logging.INFO):
        assert _ranges(graph) == {"first": (0.0, 20.0)}
    assert graph.seen == 2
    assert "is ignored" in caplog.text
    assert json.loads(path.read_bytes()) == {"first": [0.0, 20.0]}


@pytest.mark.parametrize(
    ("extremes", "expected"),
    [((3, 8), (0.0, 8.0)), ((-8, -3), (-8.0, 0.0)), ((-2, 5), (-2.0, 5.0))],
)
def test_ranges_reach_to_the_zeros_of_the_padding(
    extremes: tuple[float, float], expected: tuple[float, float], cache: Path
) -> None:
    assert _ranges(_Constants(*extremes)) == {"first": expected}
    assert cache.is_dir()


def test_cache_that_cannot_be_written_is_done_without(
    cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache.parent.parent.joinpath("visloc").write_text("a file where the folder should be")
    with caplog.at_level(logging.INFO):
        assert _ranges(_Extremes()) == {"first": (0.0, 20.0)}
    assert "not cached" in caplog.text


def test_user_without_a_home_gets_ranges(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", no_home)
    assert _ranges(_Extremes()) == {"first": (0.0, 20.0)}
    assert not cache.exists()


def test_every_recorded_file_holds_ranges_of_a_network() -> None:
    paths = list(calibration.RECORDED.glob("*.json"))
    assert len(paths) == 4
    for path in paths:
        name, _, sha256 = path.stem.partition("-")
        held = json.loads(path.read_bytes())
        recorded = ranges_of(name, sha256, list(held), lambda: pytest.fail("measured"))
        assert recorded == {name: (low, high) for name, (low, high) in held.items()}


def test_pictures_to_measure_on() -> None:
    pictures = calibration.pictures()
    assert [picture.shape for picture in pictures] == [(240, 320, 3)] * 8
    assert {picture.dtype for picture in pictures} == {np.dtype(np.uint8)}
