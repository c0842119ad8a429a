"""Measures what the core keeps for 8-bit networks: activation ranges of known weights."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from samples import papers, surfaces
from visloc.features.backends.calibration import PICTURE_HEIGHT_PX
from visloc.features.backends.openvino import Ranges
from visloc.features.networks.r2d2 import model as r2d2
from visloc.features.networks.r2d2.openvino import measure_ranges as measure_r2d2
from visloc.features.networks.xfeat import model as xfeat
from visloc.features.networks.xfeat.openvino import measure_ranges as measure_xfeat

_SIZE = (480, 640)
_MIDDLE = (slice(120, 120 + PICTURE_HEIGHT_PX), slice(160, 480))  # whole pictures take long
_PAINTERS = (
    surfaces.book_shelf,
    surfaces.mural_wall,
    surfaces.pinboard_wall,
    surfaces.brick_wall,
    surfaces.desk,
    papers.town_map,
    papers.text_page,
    papers.art_poster,
)


def paint_pictures(output: Path) -> None:
    """Paint the pictures on which ranges are measured, one below the other."""
    pictures = [
        np.asarray(paint(np.random.default_rng(number), *_SIZE)[_MIDDLE], np.uint8)
        for number, paint in enumerate(_PAINTERS)
    ]
    Image.fromarray(np.concatenate(pictures)).save(output, optimize=True)


def record_ranges(folder: Path, weights_dir: Path | None) -> list[Path]:
    """Write ``NETWORK-SHA256.json`` for our weights, XFeat's, and the R2D2s of a weights folder."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, ranges in _measured(weights_dir):
        path = folder / f"{name}.json"
        path.write_text(json.dumps(ranges, indent=1) + "\n", encoding="utf-8")
        paths.append(path)
    return paths


def _measured(weights_dir: Path | None) -> Iterator[tuple[str, Ranges]]:
    network, sha256 = xfeat.read_network(None)
    yield f"xfeat-{sha256}", measure_xfeat(network)
    known: list[tuple[r2d2.Architecture, Path | None]] = [(r2d2.FAST_R2D2, None)]
    if weights_dir is not None:
        known += [(r2d2.FAST_R2D2, weights_dir), (r2d2.R2D2, weights_dir)]
    for architecture, folder in known:
        r2d2_network, sha256 = r2d2.read_network(architecture, folder)
        yield f"{architecture.name}-{sha256}", measure_r2d2(r2d2_network)
