"""Maps of one dataset made in several ways, side by side: landmarks, time, accuracy.

    python -m benchmarks.map_methods DATASET rgbd sfm:retrieval sfm:distance sfm:frustum

DATASET holds ``mapping`` and ``query``, kapture datasets. Each way is a method, for sfm with its
pairing. Maps are built in order and kept in --maps-dir; ``sfm:covisibility`` asks the first of
them who sees what. Queries are localized in this process, one after the other, with the default
options. Prints a table in Markdown.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.speed.building import Stopwatch
from mapping.methods.sfm_settings import SfmSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc import in_process
from visloc.archive import Map, open_map
from visloc.features import DEFAULT_LOCAL_FEATURES

# Stages that depend on the way; features and global descriptors do not.
STAGES = ("depth", "landmarks", "pairs", "matches", "verified", "triangulation")
BINS = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0))


def main(
    dataset: Annotated[Path, typer.Argument(help="Holds mapping/ and query/.")],
    ways: Annotated[list[str], typer.Argument(help="rgbd, or sfm:PAIRING[,PAIRING].")],
    maps_dir: Path = Path("maps"),
    local_features: str = DEFAULT_LOCAL_FEATURES,
    weights_dir: Path | None = None,
    mapper: str = "config1",
    workers: int = 2,
) -> None:
    """Build, localize, print."""
    typer.echo(
        "| way | landmarks | observations | s to make them | localized | "
        "5 cm, 5 deg | 25 cm, 2 deg | 50 cm, 5 deg | median |"
    )
    typer.echo("|---|---|---|---|---|---|---|---|---|")
    first: Map | None = None
    for way in ways:
        method, _, pairs = way.partition(":")
        sfm = SfmSettings(mapper=mapper, covisible_in=first)
        settings = BuildSettings(
            dataset=dataset / "mapping",
            map_id="-".join([dataset.name, local_features, method, *pairs.split(",")]).strip("-"),
            maps_dir=maps_dir,
            method=method,
            local_features=local_features,
            weights_dir=weights_dir,
            sfm=replace(sfm, pairs=tuple(pairs.split(","))) if pairs else sfm,
            workers=workers,
            force=True,
        )
        watch = Stopwatch()
        opened = open_map(build_map(settings, watch))
        first = first or opened
        results = in_process.open_map(opened.ref, maps_dir, weights_dir).localize_folder(
            dataset / "query"
        )
        found = [result.pose_error for result in results if result.pose_error is not None]
        errors = np.array(found).reshape(-1, 2)
        counts = opened.manifest.counts
        within = [int(((errors[:, 0] <= m) & (errors[:, 1] <= deg)).sum()) for m, deg in BINS]
        median = np.median(errors, axis=0) if len(errors) else np.full(2, np.nan)
        seconds = sum(watch.seconds.get(stage, 0.0) for stage in STAGES)
        typer.echo(
            f"| `{way}` | {counts.landmarks} | {counts.observations} | {seconds:.1f} | "
            f"{len(errors)} of {len(results)} | {' | '.join(map(str, within))} | "
            f"{median[0] * 100:.2f} cm, {median[1]:.3f} deg |"
        )


if __name__ == "__main__":
    typer.run(main)
