"""Localize queries in a map without landmarks, or in any other: for the first time, and again.

    python -m benchmarks.local_sfm MAPS MAP QUERY [--every EVERY]

MAPS is a folder of maps, QUERY a kapture dataset of which every EVERYth photo is asked, twice: the
first time may triangulate; the second time, its place is known.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path

import numpy as np
import typer

from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.types import Localized


def main(maps_dir: Path, map_id: str, queries: Path, every: int = 1) -> None:
    """Print a row: how many are localized, how far off, how often deviations hold, and seconds."""
    opened = MapStore(maps_dir).open(map_id)
    extractor = make_local_features(opened.manifest.local_features.fingerprint.name)
    began = time.perf_counter()
    localizer = Localizer(opened, extractor)
    localizer.warm_up()
    started = time.perf_counter() - began
    dataset = read_dataset(queries)
    errors, inside, reasons = [], 0, []
    seconds: tuple[list[float], list[float]] = ([], [])
    records = dataset.images[::every]
    for record in records:
        photo = read_photo_file(dataset.path_of(record))
        camera, truth = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        for spent in seconds:
            began = time.perf_counter()
            answer = localizer.localize(photo, camera, LocalizeOptions())
            spent.append(time.perf_counter() - began)
        if not isinstance(answer, Localized):
            reasons.append(str(answer.reason))
            continue
        if truth is None:
            raise typer.BadParameter(f"{record.path} has no pose")
        errors.append(pose_error(answer.cam_from_world, truth))
        off = np.abs(answer.cam_from_world.center - truth.center)
        inside += bool((off <= 3.0 * answer.position_std).all())
    position, angle = np.array(errors).reshape(-1, 2).T
    typer.echo(
        "| localized | refused | position: median, 90 %, largest | orientation: median, largest | "
        "within 3 stated deviations | seconds: first, most, again, start |"
    )
    typer.echo("|---|---|---|---|---|---|")
    unit, times = ("cm", 100.0) if opened.manifest.world.metric else ("units", 1.0)
    quantiles = times * np.quantile(position, [0.5, 0.9, 1.0])
    refused = ", ".join(f"{number} {reason}" for reason, number in Counter(reasons).items())
    typer.echo(
        f"| {len(errors)} of {len(records)} | {refused} | "
        f"{', '.join(f'{each:.3g}' for each in quantiles)} {unit} | {np.median(angle):.3f}, "
        f"{angle.max():.2f} deg | {inside} of {len(errors)} | {np.median(seconds[0]):.2f}, "
        f"{max(seconds[0]):.2f}, {np.median(seconds[1]):.2f}, {started:.1f} |"
    )


if __name__ == "__main__":
    typer.run(main)
