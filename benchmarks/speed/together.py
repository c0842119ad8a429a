"""Time photos that are sent alone, on a rig and in a sequence (docs/performance.md).

    python -m benchmarks.speed.together MAPS_DIR MAP QUERY RIG [--time-unit ms]

QUERY is a kapture dataset whose photos the rig RIG of the map took. Starts the service in its
default shape and asks it about the same photos in three ways, in turn: one photo at a time, one
instant of the rig at a time, all instants as one sequence. Prints a table in Markdown: medians over
the rounds, of seconds on the clock and of processor time of the service, per photo.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.reliability.service_process import ServiceProcess
from benchmarks.speed.tables import table
from clients import Client, Instant, RigImage
from visloc.geometry import Camera
from visloc.kapture import read_dataset

Photo = tuple[bytes, Camera]


def main(
    maps_dir: Path,
    map_id: str,
    query: Path,
    rig: str,
    time_unit: Annotated[str, typer.Option(help="of the timestamps: s, ms, us or ns")] = "ms",
    rounds: Annotated[int, typer.Option(help="the median counts")] = 5,
    weights_dir: Annotated[Path | None, typer.Option(help="folder of network weights")] = None,
) -> None:
    """Measure and print."""
    photos, instants = _read(query)
    settings: dict[str, Any] = {"workers": None, "threads_per_worker": None}
    with (
        tempfile.TemporaryDirectory() as folder,
        ServiceProcess(
            maps_dir, Path(folder) / "service.log", weights_dir=weights_dir, **settings
        ) as service,
        Client(service.url) as client,
    ):
        service.wait_until_ready()

        def singles() -> int:
            answers = [client.localize(photo, map_id, camera) for photo, camera in photos]
            return sum(answer.pose is not None for answer in answers)

        def rigs() -> int:
            answers = [client.localize_rig(each.images, map_id, rig) for each in instants]
            return sum(answer.pose is not None for answer in answers)

        def sequence() -> int:
            answers = client.localize_sequence(instants, map_id, rig, time_unit)
            return sum(answer.pose is not None for answer in answers)

        ways: dict[str, Callable[[], int]] = {
            "photos, one at a time": singles,
            f"instants of {len(photos) // len(instants)}, one at a time": rigs,
            f"one sequence of {len(instants)} instants": sequence,
        }
        localized = [way() for way in ways.values()]  # not measured: first answers are slower
        spent = np.array(
            [[_timed(service, way) for way in ways.values()] for _ in range(rounds)]
        ) / len(photos)
    medians = np.median(spent, axis=0)
    ratios = np.median(spent[:, :1, 0] / spent[:, :, 0], axis=0)
    rows = [
        [name, f"{answered}", f"{clock:.3f}", f"{processor:.3f}", f"{ratio:.2f}"]
        for name, answered, (clock, processor), ratio in zip(
            ways, localized, medians, ratios, strict=True
        )
    ]
    head = ["asked", "answers with a pose", "s per photo", "processor s per photo"]
    typer.echo("\n".join(table([*head, "photos of their own / this"], rows)))


def _timed(service: ServiceProcess, way: Callable[[], int]) -> tuple[float, float]:
    began, processor = time.perf_counter(), service.processor_seconds()
    way()
    return time.perf_counter() - began, service.processor_seconds() - processor


def _read(query: Path) -> tuple[Sequence[Photo], Sequence[Instant]]:
    """Return the photos of a dataset with their cameras, and as instants."""
    dataset = read_dataset(query)
    records = sorted(dataset.images, key=lambda record: record.timestamp)
    encoded = {record.path: dataset.path_of(record).read_bytes() for record in records}
    cameras = {sensor: each.camera for sensor, each in dataset.sensors.items()}
    photos = [
        (encoded[record.path], camera)
        for record in records
        if (camera := cameras[record.sensor_id]) is not None
    ]
    instants = [
        Instant(timestamp, tuple(RigImage(each.sensor_id, encoded[each.path]) for each in group))
        for timestamp, group in groupby(records, key=lambda record: record.timestamp)
    ]
    return photos, instants


if __name__ == "__main__":
    typer.run(main)
