"""Open one set, rank its tiles, and tell seconds, memory and recall as JSON.

A process of ``benchmarks.tiles``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray

from visloc.features.descriptors.whitening import unit_rows
from visloc.priors import PositionPrior, Priors
from visloc.types import LocalFeatures
from visloc_extensions.sets.choosing import MAX_SEARCHED, allowed_tiles, plan
from visloc_extensions.sets.coarse import rank_tiles, ranked
from visloc_extensions.sets.files import MapSet, open_set

RADIUS_M = 30.0
# Features of a query of default options.
NUM_FEATURES = 2500
WARM_UP = 5


def main(folder: Path, queries: Path) -> None:
    """Open the set, ask it, print."""
    with np.load(queries) as arrays:
        rows, tiles, positions = arrays["rows"], arrays["tiles"], arrays["positions"]
    before, started = memory("RssAnon"), time.perf_counter()
    opened = open_set(folder)
    seconds = time.perf_counter() - started
    of_set = memory("RssAnon") - before
    none = [Priors() for _ in rows]
    near = [Priors(position=PositionPrior(position, RADIUS_M)) for position in positions]
    found = {
        "photos": opened.manifest.counts.images,
        "open_s": seconds,
        "without a prior": asked(opened, rows, tiles, none),
        "position to 30 m": asked(opened, rows, tiles, near),
        "anonymous_bytes": [of_set, memory("RssAnon")],
        "resident_bytes": [memory("VmRSS")],
        "disk_bytes": disk_bytes(folder),
    }
    typer.echo(json.dumps(found))


def asked(
    opened: MapSet, rows: NDArray[np.float32], tiles: NDArray[np.int64], priors: Sequence[Priors]
) -> dict[str, Any]:
    """Ask for the tiles of queries."""
    features = some_features(opened)
    ranks, ranking, whole, allowed, lengths, searched = [], [], [], [], [], []
    for number in [*range(min(WARM_UP, len(rows))), *range(len(rows))]:
        started = time.perf_counter()
        mask = allowed_tiles(opened, priors[number])
        scores = ranked(opened.coarse, rows[number], mask)
        ranking.append(time.perf_counter() - started)
        started = time.perf_counter()
        rank_tiles(opened, features, allowed_tiles(opened, priors[number]))
        whole.append(time.perf_counter() - started)
        order = [score.tile for score in scores]
        ranks.append(order.index(tiles[number]) if tiles[number] in order else len(opened.tiles))
        allowed.append(np.count_nonzero(mask))
        lengths.append(len(order))
        searched.append(len(plan(scores)[0]))
    counted = np.array(ranks[-len(rows) :])
    return {
        "allowed": float(np.median(allowed)),
        "ranked": float(np.median(lengths)),
        "searched": float(np.mean(searched[-len(rows) :])),
        "ranking_ms": percentiles_ms(ranking[-len(rows) :]),
        "all_ms": percentiles_ms(whole[-len(rows) :]),
        "first": float(np.mean(counted == 0)),
        "first_5": float(np.mean(counted < MAX_SEARCHED)),
        "anywhere": float(np.mean(counted < len(opened.tiles))),
    }


def some_features(opened: MapSet) -> LocalFeatures:
    """Features as many as a photo has; where they lead to does not matter."""
    dim = opened.coarse.model["vocabulary"].shape[1]
    random = np.random.default_rng(0)
    descriptors = unit_rows(random.standard_normal((NUM_FEATURES, dim), dtype=np.float32))
    nothing = np.zeros(NUM_FEATURES, np.float32)
    return LocalFeatures(np.zeros((NUM_FEATURES, 2), np.float32), descriptors, nothing, nothing)


def percentiles_ms(seconds: Sequence[float]) -> list[float]:
    """Median and 90th percentile, in milliseconds."""
    return [float(value) for value in 1e3 * np.percentile(seconds, [50, 90])]


def disk_bytes(folder: Path) -> list[int]:
    """Sizes of lists, centres, manifest, and of all files."""
    sizes = {path.name: path.stat().st_size for path in folder.rglob("*") if path.is_file()}
    names = ("photos.lists", "photos.centers.npy", "manifest.json")
    return [*(sizes[name] for name in names), sum(sizes.values())]


def memory(name: str) -> int:
    """Memory of this process, in bytes: RssAnon without pages of files, VmRSS with them."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (kib,) = (line.split()[1] for line in lines if line.startswith(f"{name}:"))
    return int(kib) * 1024


if __name__ == "__main__":
    typer.run(main)
