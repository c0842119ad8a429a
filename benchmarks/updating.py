"""A map that grew by `mapping update`, beside one that was built of all photos at once.

    python -m benchmarks.updating MAPPING QUERIES --work DIR [--poses tie|given|localize]
        [--method rgbd|sfm] [--other DATASET] [--local-features NAME] [--weights-dir DIR]

MAPPING and QUERIES are kapture datasets with true poses in one frame. MAPPING is split by time in
two captures of as many photos; but for ``--poses given`` the second gets a frame of its own, by a
seeded rigid motion. A map is built of the first, updated with the second, and another is built of
both. Prints a table in Markdown: queries within the bins of docs/results.md, median errors, and
seconds; then how far the tie is from the motion that was chosen. ``--other`` is a dataset of
another place, which must be refused.

Seconds of ``features`` are those of the local features of the photos that a row adds; ``rest`` is
all else. DIR must not exist; maps stay there.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.map_methods import BINS, Stopwatch, measure
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import Map, open_map
from visloc.errors import Conflict
from visloc.evaluation import pose_error
from visloc.features import DEFAULT_LOCAL_FEATURES
from visloc.geometry import Pose, Similarity
from visloc.kapture import Dataset, read_dataset, write_dataset
from visloc_extensions.living_maps.updating import UpdateSettings, update_map

SEED = 0
FEATURES = "local features"


def split(dataset: Dataset, root: Path, here_from_world: Similarity) -> tuple[Path, Path]:
    """Write the earlier and the later half of the photos as datasets, the later one moved."""
    times = sorted(image.timestamp for image in dataset.images)
    middle = times[len(times) // 2]
    moved = {key: here_from_world.move(pose) for key, pose in dataset.trajectories.items()}
    first, second = root / "first", root / "second"
    for path, later, poses in ((first, False, dataset.trajectories), (second, True, moved)):
        (path / "sensors").mkdir(parents=True)
        (path / "sensors" / "records_data").symlink_to(
            (dataset.root / "sensors" / "records_data").resolve()
        )
        images = [image for image in dataset.images if (image.timestamp >= middle) == later]
        write_dataset(replace(dataset, root=path, images=tuple(images), trajectories=poses))
    return first, second


def some_motion(seed: int) -> Similarity:
    """Return a rigid motion of any rotation, and of some tens of metres."""
    random = np.random.default_rng(seed)
    pose = Pose.from_quaternion(random.normal(size=4), random.uniform(-50, 50, 3))
    return Similarity(1.0, pose.rotation, pose.translation)


def row_of(
    name: str, opened: Map, watch: Stopwatch | None, queries: Path, weights_dir: Path | None
) -> str:
    """Localize the queries and return a line of the table."""
    total, errors = measure(opened, queries, weights_dir)
    within = [int(((errors[:, 0] <= m) & (errors[:, 1] <= deg)).sum()) for m, deg in BINS]
    median = np.median(errors, axis=0) if len(errors) else np.full(2, np.nan)
    seconds = {} if watch is None else watch.seconds
    features = seconds.get(FEATURES, 0.0)
    rest = sum(seconds.values()) - features
    counts = opened.manifest.counts
    return (
        f"| {name} | {counts.images} | {counts.landmarks} | {len(errors)} of {total} | "
        f"{' | '.join(map(str, within))} | {median[0] * 100:.2f} cm, {median[1]:.3f} deg | "
        f"{features:.1f} | {rest:.1f} |"
    )


def main(
    mapping: Annotated[Path, typer.Argument(help="kapture folder with poses.")],
    queries: Annotated[Path, typer.Argument(help="kapture folder with poses, of the same frame.")],
    work: Annotated[Path, typer.Option(help="Folder to make; maps and captures stay there.")],
    poses: str = "tie",
    method: str = "rgbd",
    other: Annotated[Path | None, typer.Option(help="A dataset of another place.")] = None,
    local_features: str = DEFAULT_LOCAL_FEATURES,
    weights_dir: Path | None = None,
    workers: int = 2,
) -> None:
    """Split, build, update, build all, localize, print."""
    work.mkdir(parents=True)
    dataset = read_dataset(mapping)
    motion = Similarity.identity() if poses == "given" else some_motion(SEED)
    first, second = split(dataset, work, motion)
    maps = work / "maps"
    build = BuildSettings(
        first,
        "grown",
        maps,
        method=method,
        local_features=local_features,
        weights_dir=weights_dir,
        workers=workers,
    )
    watch = Stopwatch()
    rows = [row_of("first half", open_map(build_map(build, watch)), watch, queries, weights_dir)]
    update = UpdateSettings(
        "grown",
        second,
        maps,
        poses=poses,
        weights_dir=weights_dir,
        workers=workers,
    )
    grown_watch, start = Stopwatch(), time.perf_counter()
    updated = update_map(update, grown_watch)
    update_s = time.perf_counter() - start
    grown = open_map(updated.folder)
    rows.append(row_of("updated", grown, grown_watch, queries, weights_dir))
    watch, start = Stopwatch(), time.perf_counter()
    whole = open_map(build_map(replace(build, dataset=mapping, map_id="whole"), watch))
    whole_s = time.perf_counter() - start
    rows.append(row_of("built of all", whole, watch, queries, weights_dir))

    typer.echo(
        "| map | photos | landmarks | localized | 5 cm, 5 deg | 25 cm, 2 deg | 50 cm, 5 deg | "
        "median | features, s | rest, s |"
    )
    typer.echo("|---|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        typer.echo(row)
    beyond = update_s - grown_watch.seconds.get(FEATURES, 0.0)
    typer.echo(
        f"\nupdate beyond the features of its photos: {beyond:.1f} s, "
        f"{beyond / whole_s:.2f} of {whole_s:.1f} s that building all takes"
    )
    typer.echo("seconds of the update: " + _stages(grown_watch))
    typer.echo("seconds of building all: " + _stages(watch))
    record = updated.record
    typer.echo(
        f"{record.tied} of {record.tried} photos tied, median residual {record.pixels:.2f} px, "
        f"{record.position * 100:.2f} cm, {record.orientation_deg:.3f} deg"
    )
    typer.echo("photos that joined, from where the dataset has them: " + _apart(grown, dataset))
    if other is not None:
        try:
            update_map(replace(update, dataset=other, method="sfm"), Stopwatch())
        except Conflict as error:
            typer.echo(f"{other.parent.name}/{other.name}: [{error.code}] {error}")
        else:
            raise SystemExit(f"{other} was not refused")


def _stages(watch: Stopwatch) -> str:
    return ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in watch.seconds.items())


def _apart(grown: Map, dataset: Dataset) -> str:
    """Distance between the poses of a map and those of the dataset that it was made of."""
    truth = {image.path: dataset.pose(image) for image in dataset.images}
    errors = []
    for image, row in zip(grown.images, grown.image_poses, strict=True):
        pose = truth[image.name]
        error = pose_error(Pose.from_quaternion(row[:4], row[4:]), pose) if pose else (0.0, 0.0)
        if error[0] > 1e-9 or error[1] > 1e-6:
            errors.append(error)
    if not errors:
        return "none differs"
    position, angle = np.median(errors, axis=0)
    return f"median {position * 100:.2f} cm, {angle:.3f} deg, of {len(errors)}"


if __name__ == "__main__":
    typer.run(main)
