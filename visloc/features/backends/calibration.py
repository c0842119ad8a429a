"""The ranges of a network's activations, which its 8-bit numbers have to cover.

Those of known weights are recorded in ``visloc/features/weights/ranges``. For other weights they
are measured once, on the pictures that lie there too, and kept in the user's cache folder. Nothing
depends on the cache: without it they are measured again. The extension ``training`` makes the
records and the pictures (its command ``ranges``).
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from visloc.features.backends.openvino import Graph, Ranges

_LOGGER = logging.getLogger(__name__)
_REVISION = 1  # raised whenever the pictures or the way of measuring change
RECORDED = Path(__file__).parents[1] / "weights" / "ranges"
PICTURES = RECORDED / "pictures.png"  # (8 * 240, 320) px, one below the other
PICTURE_HEIGHT_PX = 240
# Those of published networks are 3 to 24 wide. Others may be, but then the file is no help.
_NARROWEST, _WIDEST = 1e-3, 1e4


def ranges_of(
    network: str, weights_sha256: str, names: Sequence[str], measure_them: Callable[[], Ranges]
) -> Ranges:
    """Return the range of the input of each named convolution: recorded, cached or measured."""
    file_name = f"{network}-{weights_sha256}"
    recorded = _read(RECORDED / f"{file_name}.json", names)
    if recorded is not None:
        return recorded
    folder = _cache_folder()
    path = None if folder is None else folder / f"{file_name}-{_REVISION}.json"
    ranges = None if path is None else _read(path, names)
    if ranges is None:
        _LOGGER.info("measuring the ranges of %s for 8 bits", file_name)
        ranges = measure_them()
        if path is not None:
            _write(path, ranges)
    return ranges


def measure(
    names: Sequence[str],
    graph: Graph,
    make_input: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
) -> Ranges:
    """Return the extremes of each picture, averaged: outliers of one picture are cut off.

    Args:
        graph: from the network's input to the smallest and largest value of what enters each
            convolution, in the order of the names.
        make_input: makes the network's input of RGB (H, W, 3).
    """
    extremes = np.mean(
        [[float(value) for value in graph(make_input(picture))] for picture in pictures()], axis=0
    )
    # Four digits are plenty, and the same on machines that add up in another order.
    rounded = [float(f"{value:.4g}") for value in extremes]
    # Zero is always among what a convolution sees: it is the padding.
    lows, highs = [min(low, 0.0) for low in rounded[::2]], [max(h, 0.0) for h in rounded[1::2]]
    return dict(zip(names, zip(lows, highs, strict=True), strict=True))


def pictures() -> list[NDArray[np.uint8]]:
    """Return the pictures to measure on: (240, 320, 3) RGB."""
    with Image.open(PICTURES) as image:
        column = np.asarray(image.convert("RGB"))
    return np.split(column, len(column) // PICTURE_HEIGHT_PX)


def _cache_folder() -> Path | None:
    configured = os.environ.get("XDG_CACHE_HOME")
    try:
        base = Path(configured) if configured else Path.home() / ".cache"
    except RuntimeError:  # a user without a home, as in some containers
        return None
    return base / "visloc" / "networks"


def _read(path: Path, names: Sequence[str]) -> Ranges | None:
    """Return the ranges in a file, None if it is absent or damaged."""
    try:
        held = json.loads(path.read_bytes())
        ranges = {name: (float(held[name][0]), float(held[name][1])) for name in names}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        _LOGGER.info("%s is ignored: %s", path, error)
        return None
    if not all(
        low <= 0 <= high and _NARROWEST < high - low < _WIDEST for low, high in ranges.values()
    ):
        _LOGGER.info("%s is ignored: no network has such ranges", path)
        return None
    return ranges


def _write(path: Path, ranges: Ranges) -> None:
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(json.dumps(ranges), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        _LOGGER.info("the ranges are not cached: %s", error)
