"""The ranges of a network's activations, which its 8-bit numbers have to cover.

They are measured once on pictures made by code, so that one network serves all maps, and kept
in the user's cache folder. Nothing depends on that file: without it they are measured again.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.openvino import Graph, Ranges
from visloc.synthetic import papers, surfaces

_LOGGER = logging.getLogger(__name__)
_REVISION = 1  # raised whenever the pictures or the way of measuring change
# Those of published networks are 3 to 24 wide. Others may be, but then the file is no help.
_NARROWEST, _WIDEST = 1e-3, 1e4
_SIZE = (480, 640)
_MIDDLE = (slice(120, 360), slice(160, 480))  # what is shown of a picture, as that takes time
_PICTURES = (
    surfaces.book_shelf,
    surfaces.mural_wall,
    surfaces.pinboard_wall,
    surfaces.brick_wall,
    surfaces.desk,
    papers.town_map,
    papers.text_page,
    papers.art_poster,
)


def calibrate(
    network: str,
    names: Sequence[str],
    make_graph: Callable[[], Graph],
    make_input: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
) -> Ranges:
    """Return the range of what enters each named convolution, from the cache or measured.

    Args:
        network: identifies architecture and weights; part of a file's name.
        names: of the convolutions.
        make_graph: makes a graph from the network's input to the smallest and largest value of
            each, in the order of the names.
        make_input: makes the network's input of RGB (H, W, 3).
    """
    folder = _cache_folder()
    path = None if folder is None else folder / f"{network}-{_REVISION}.json"
    ranges = None if path is None else _read(path, names)
    if ranges is None:
        _LOGGER.info("calibrating %s for 8 bits", network)
        ranges = _measure(names, make_graph(), make_input)
        if path is not None:
            _write(path, ranges)
    return ranges


def pictures() -> list[NDArray[np.uint8]]:
    """Return what is measured: (240, 320, 3) RGB."""
    return [
        np.asarray(paint(np.random.default_rng(number), *_SIZE)[_MIDDLE], np.uint8)
        for number, paint in enumerate(_PICTURES)
    ]


def _measure(
    names: Sequence[str],
    graph: Graph,
    make_input: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
) -> Ranges:
    """Return the extremes of each picture, averaged: outliers of one picture are cut off."""
    extremes = np.mean(
        [[float(value) for value in graph(make_input(picture))] for picture in pictures()], axis=0
    )
    # Four digits are plenty, and the same on machines that add up in another order.
    rounded = [float(f"{value:.4g}") for value in extremes]
    # Zero is always among what a convolution sees: it is the padding.
    lows, highs = [min(low, 0.0) for low in rounded[::2]], [max(h, 0.0) for h in rounded[1::2]]
    return dict(zip(names, zip(lows, highs, strict=True), strict=True))


def _cache_folder() -> Path | None:
    configured = os.environ.get("XDG_CACHE_HOME")
    try:
        base = Path(configured) if configured else Path.home() / ".cache"
    except RuntimeError:  # a user without a home, as in some containers
        return None
    return base / "visloc" / "networks"


def _read(path: Path, names: Sequence[str]) -> Ranges | None:
    """Return what the file holds, None if it is absent or not what was written."""
    try:
        held = json.loads(path.read_bytes())
        ranges = {name: (float(held[name][0]), float(held[name][1])) for name in names}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        _LOGGER.info("%s is not usable and made anew: %s", path, error)
        return None
    if not all(
        low <= 0 <= high and _NARROWEST < high - low < _WIDEST for low, high in ranges.values()
    ):
        _LOGGER.info("%s is not usable and made anew: not such ranges as networks have", path)
        return None
    return ranges


def _write(path: Path, ranges: Ranges) -> None:
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(json.dumps(ranges), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        _LOGGER.info("the calibration is not kept: %s", error)
