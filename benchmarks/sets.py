"""What it costs, in time and in right answers, to ask a set of maps instead of the right map.

    python -m benchmarks.sets MAPS_DIR SETID MAP=QUERIES ... [--weights-dir DIR] [--workers N]

MAP is a map of the folder, QUERIES the kapture dataset of photos to ask it about. A set of these
maps, ten kilometres apart, is published when there is none of this id. An engine as the service has
it answers each photo twice in turn, in its own map and in the set, with one request under way at a
time; all are asked about once before, which opens what they need and counts for nothing. A tile is
right when it is the photo's own map. Prints a table in Markdown.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np
import typer

from benchmarks.engines import engine_of
from service.engine.engine import Engine
from service.values import Localization, RigJob, photo_job
from visloc.archive import MapStore
from visloc.geometry import Similarity
from visloc.kapture import read_dataset
from visloc.options import LocalizeOptions
from visloc.types import Reason
from visloc_extensions.sets.publishing import publish_set

APART_M = 10_000.0
OPTIONS = LocalizeOptions()


@dataclass
class Tally:
    """What became of the photos of one dataset."""

    own_s: list[float] = field(default_factory=list)
    set_s: list[float] = field(default_factory=list)
    localized: int = 0
    in_set: Counter[str] = field(default_factory=Counter)  # of those that their own map localizes
    others: Counter[str] = field(default_factory=Counter)  # of those that it does not

    def take(
        self, map_id: str, own: Localization, own_s: float, found: Localization, set_s: float
    ) -> None:
        """Count the two answers to a photo."""
        self.own_s.append(own_s)
        self.set_s.append(set_s)
        is_localized = own.answer.pose is not None
        self.localized += is_localized
        refusal = found.answer.refusal
        if refusal is None:
            tile = (found.tile or "").partition("@")[0]
            outcome = "right" if tile == map_id else "wrong"
        else:
            outcome = "ambiguous" if refusal.reason is Reason.AMBIGUOUS else "refused"
        (self.in_set if is_localized else self.others)[outcome] += 1

    def row(self, map_id: str) -> str:
        """Write a row of the table."""
        own, in_set = np.median(self.own_s) * 1e3, np.median(self.set_s) * 1e3
        counts = [self.in_set[name] for name in ("right", "wrong", "ambiguous", "refused")]
        others = self.others["right"] + self.others["wrong"]
        cells = [map_id, len(self.own_s), self.localized, *counts, others]
        times = f"{own:.0f} | {in_set:.0f} | {in_set / own:.2f}"
        return f"| {' | '.join(map(str, cells))} | {times} |"


def jobs_of(dataset: Path, map_id: str) -> list[RigJob]:
    """Make a job of each photo, with its camera where the dataset knows it."""
    queries = read_dataset(dataset)
    return [
        photo_job(
            (map_id,),
            queries.path_of(record).read_bytes(),
            queries.sensors[record.sensor_id].camera,
            OPTIONS,
        )
        for record in queries.images
    ]


async def timed(engine: Engine, job: RigJob) -> tuple[Localization, float]:
    """Ask, and say how long it took."""
    started = perf_counter()
    found = await engine.localize(job)
    return found, perf_counter() - started


async def compare(engine: Engine, set_id: str, datasets: dict[str, list[RigJob]]) -> None:
    """Ask about all photos, and print a row for each dataset."""
    await engine.start()
    try:
        for map_id, jobs in datasets.items():
            tally = Tally()
            for job in jobs:
                for each in (job, replace(job, maps=(set_id,))):
                    await engine.localize(each)
            for job in jobs:
                own = await timed(engine, job)
                found = await timed(engine, replace(job, maps=(set_id,)))
                tally.take(map_id, *own, *found)
            typer.echo(tally.row(map_id))
    finally:
        await engine.close()


def main(
    maps_dir: Path,
    set_id: str,
    queries: Annotated[list[str], typer.Argument(metavar="MAP=QUERIES")],
    weights_dir: Path | None = None,
    workers: int = 1,
    threads: int = 2,
) -> None:
    """Compare a set of maps with its maps."""
    store = MapStore(maps_dir)
    given = dict(each.split("=", 1) for each in queries)
    if set_id not in store.ids():
        tiles = [
            (map_id, Similarity(1.0, np.eye(3), np.array([APART_M * i, 0.0, 0.0])))
            for i, map_id in enumerate(given)
        ]
        publish_set(store, set_id, tiles, lambda *_: None)
    engine = engine_of(store, weights_dir, workers=workers, threads=threads)
    typer.echo(
        "| queries of | photos | localized by the own map | in the set: right tile | wrong tile "
        "| ambiguous | refused | others localized | p50 own map, ms | p50 set, ms | ratio |\n"
        f"|{'---|' * 11}"
    )
    datasets = {map_id: jobs_of(Path(path), map_id) for map_id, path in given.items()}
    asyncio.run(compare(engine, set_id, datasets))


if __name__ == "__main__":
    typer.run(main)
