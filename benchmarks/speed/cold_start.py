"""How soon a service is ready and gives its first answer (docs/operations.md).

    python -m benchmarks.speed.cold_start MAPS_DIR MAP PHOTO [--repeats 3]

Starts the service with all maps of the folder, in its default shape. Prints the median in Markdown:
seconds on the clock, and seconds of processor time of all its processes, which other programs on
the machine hardly change.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Annotated

import httpx
import typer

from benchmarks.reliability.service_process import ServiceProcess
from benchmarks.speed.tables import table

_WAIT_S = 60.0


def main(
    maps_dir: Path,
    map_id: str,
    photo: Path,
    workers: Annotated[int | None, typer.Option(help="the service's default if not given")] = None,
    repeats: Annotated[int, typer.Option(help="starts; the median counts")] = 3,
) -> None:
    """Measure and print."""
    runs = [_start(maps_dir, map_id, photo, workers) for _ in range(repeats)]
    ready, ready_processor, first, first_processor = map(statistics.median, zip(*runs, strict=True))
    rows = [
        ["ready", f"{ready:.2f}", f"{ready_processor:.2f}"],
        ["first answer", f"{first:.2f}", f"{first_processor:.2f}"],
    ]
    typer.echo("\n".join(table(["after the start", "s", "processor s"], rows)))


def _start(
    maps_dir: Path, map_id: str, photo: Path, workers: int | None
) -> tuple[float, float, float, float]:
    with tempfile.TemporaryDirectory() as folder:
        service = ServiceProcess(
            maps_dir, Path(folder) / "service.log", threads_per_worker=None, workers=workers
        )
        began = time.perf_counter()
        service.start()
        try:
            while not service.is_ready():
                time.sleep(0.02)
            ready, ready_processor = time.perf_counter() - began, service.processor_seconds()
            response = httpx.post(
                f"{service.url}/localize",
                files={"image": photo.read_bytes()},
                data={"map": map_id},
                timeout=_WAIT_S,
            )
            response.raise_for_status()
            first = time.perf_counter() - began
            return ready, ready_processor, first, service.processor_seconds()
        finally:
            service.stop()


if __name__ == "__main__":
    typer.run(main)
