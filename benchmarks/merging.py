"""How well two maps of the halves of a dataset are registered and merged.

    python -m benchmarks.merging DATASET QUERIES --work DIR [--local-features faster2d2]
        [--weights-dir DIR]

DATASET is a kapture folder with poses, QUERIES one in its frame. The photos are halved by time,
then in turn. The second half is put into a frame of its own, so that it is known how it lies in
the first. Each half is built, both are merged, and the merged map is compared with that of all
photos. What lies in DIR already is used again. Prints two tables in Markdown.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from scipy.spatial.transform import Rotation

from mapping.cli.progress import StageProgress
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import Map, MapStore
from visloc.features import make_global_descriptor, make_local_features
from visloc.geometry import Similarity, rotation_angle
from visloc.kapture import read_dataset, write_dataset
from visloc_extensions.living_maps.merging import merge_maps
from visloc_extensions.living_maps.prune_command import accuracy_rows
from visloc_extensions.living_maps.pruning.accuracy import of_queries

ELSEWHERE = Similarity(
    1.0,
    Rotation.from_euler("xyz", [30.0, -50.0, 100.0], degrees=True).as_matrix(),
    np.array([12.0, -3.0, 5.0]),
)


def write_half(root: Path, target: Path, instants: set[int], moved_by: Similarity) -> None:
    """Write the part of a dataset that was taken at some instants, in another frame."""
    if target.exists():
        return
    whole = read_dataset(root)
    records = target / "sensors" / "records_data"
    records.parent.mkdir(parents=True)
    records.symlink_to((root / "sensors" / "records_data").resolve())
    write_dataset(
        replace(
            whole,
            root=target,
            trajectories={
                key: moved_by.move(pose)
                for key, pose in whole.trajectories.items()
                if key[0] in instants
            },
            images=tuple(record for record in whole.images if record.timestamp in instants),
            depth_maps=tuple(r for r in whole.depth_maps if r.timestamp in instants),
        )
    )


def error_of(found: Similarity, truth: Similarity, opened: Map) -> tuple[float, float]:
    """Largest distance (m) of the map's photos from where they are, and the angle (degrees)."""
    rows = opened.image_poses
    rotations = Rotation.from_quat(rows[:, :4], scalar_first=True)
    centers: NDArray[np.float64] = -rotations.inv().apply(rows[:, 4:])
    off = np.linalg.norm(found.apply(centers) - truth.apply(centers), axis=1)
    angle = np.degrees(rotation_angle(found.rotation @ truth.rotation.T))
    return float(off.max()), float(angle)


def main(
    dataset: Path,
    queries: Path,
    work: Path = Path("work"),
    local_features: str = "faster2d2",
    weights_dir: Path | None = None,
) -> None:
    """Halve, build, merge, localize, print."""
    store = MapStore(work / "maps")
    times = sorted({record.timestamp for record in read_dataset(dataset).images})
    halves = {"time": set(times[: len(times) // 2]), "turns": set(times[::2])}
    console = Console(stderr=True)

    def built(root: Path, map_id: str) -> Map:
        if map_id not in store.ids():
            settings = BuildSettings(
                root,
                map_id,
                store.root,
                local_features=local_features,
                weights_dir=weights_dir,
                workers=1,
            )
            with StageProgress(console) as progress:
                build_map(settings, progress)
        return store.open(map_id)

    maps, lines = [built(dataset, "whole")], []
    for name, first in halves.items():
        write_half(dataset, work / f"{name}-a", first, Similarity.identity())
        write_half(dataset, work / f"{name}-b", set(times) - first, ELSEWHERE)
        built(work / f"{name}-a", f"{name}-a")
        second = built(work / f"{name}-b", f"{name}-b")
        shutil.rmtree(store.root / f"{name}-merged", ignore_errors=True)
        with StageProgress(console) as progress:
            merged = merge_maps(store, f"{name}-a", f"{name}-b", f"{name}-merged", progress)
        maps.append(store.open(f"{name}-merged"))
        tie = merged.registration.tie
        position, angle = error_of(tie.there_from_here, ELSEWHERE.inverse(), second)
        lines.append(
            f"| {name} | {tie.tied.sum()} of {len(second.images)} | "
            f"{np.median(tie.errors_px[tie.tied]):.2f} | {100 * position:.2f} | {angle:.3f} |"
        )
    typer.echo(
        "| halves by | tied | median, px | off by at most, cm | deg |\n|---|---|---|---|---|"
    )
    typer.echo("\n".join(lines))
    extractor = make_local_features(local_features, weights_dir)
    make_descriptor = partial(make_global_descriptor, weights_dir=weights_dir)
    accuracies = of_queries(maps, queries, extractor, make_descriptor, lambda *_: None)
    typer.echo("\n| | whole | " + " | ".join(f"merged, by {name}" for name in halves) + " |")
    typer.echo("|---" * (len(maps) + 1) + "|")
    for row in accuracy_rows(tuple(accuracies), metric=maps[0].manifest.world.metric):
        typer.echo("| " + " | ".join(row) + " |")


if __name__ == "__main__":
    typer.run(main)
