"""Measure what a service's workers and threads cost (docs/performance.md).

    python -m benchmarks.speed.workers MAPS_DIR MAP QUERY_DATASET [--shapes 1x1,1x2,2x1,2x2]

Starts the service once for each shape, asks it by ``localize benchmark``, and prints a table in
Markdown on stdout. ``default`` is the shape that the service takes by itself. Processor seconds are
those of all its processes: other programs on the machine hardly change them. ``--only-core`` leaves
one core, and ``--memory`` puts the service into a cgroup of its own with so many bytes, which only
root may do: it is killed where it needs more.
"""

from __future__ import annotations

import atexit
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.reliability.service_process import ServiceProcess, peak_resident_bytes
from benchmarks.speed.machine import load_average
from benchmarks.speed.served import report_of
from benchmarks.speed.steps import say
from benchmarks.speed.tables import table


@dataclass(frozen=True, slots=True)
class Measured:
    """One run of ``localize benchmark``.

    Attributes:
        processor_s: of all processes of the service, for one answer.
        peak_bytes: largest resident memory of one worker process so far.
        together_bytes: of all processes after the run; a page that several share counts once.
    """

    shape: str
    concurrency: int
    per_second: float
    p50_s: float
    p90_s: float
    processor_s: float
    peak_bytes: int
    together_bytes: int


def main(
    maps_dir: Path,
    map_id: str,
    query: Path,
    shapes: Annotated[str, typer.Option(help="workers x threads")] = "1x1,1x2,2x1,2x2,default",
    concurrencies: Annotated[str, typer.Option(help="requests at a time")] = "1,2,8",
    repeats: Annotated[int, typer.Option(help="runs; the median counts")] = 3,
    only_core: Annotated[int | None, typer.Option(help="the only core of the service")] = None,
    memory: Annotated[int | None, typer.Option(help="limit of all processes, bytes")] = None,
    weights_dir: Annotated[Path | None, typer.Option(help="folder of network weights")] = None,
) -> None:
    """Measure and print."""
    before: list[str] = []
    if only_core is not None:
        before += ["taskset", "-c", str(only_core)]
    if memory is not None:
        before += _limited(memory)
    say(f"load average before: {load_average():.1f}")
    measured = []
    for shape in shapes.split(","):
        with _service(maps_dir, shape, before, weights_dir) as service:
            report_of(service.url, map_id, query)  # the first answers of a process are slower
            for concurrency in map(int, concurrencies.split(",")):
                runs = [
                    _measure(service, shape, map_id, query, concurrency) for _ in range(repeats)
                ]
                measured.append(sorted(runs, key=lambda run: run.processor_s)[len(runs) // 2])
                say(str(measured[-1]))
    head = ["workers x threads", "concurrency", "processor s per photo", "photos per second"]
    head += ["p50 s", "p90 s", "MiB of a worker at most", "MiB of all together"]
    typer.echo("\n".join(table(head, [_row(each) for each in measured])))


def _row(measured: Measured) -> list[str]:
    return [
        measured.shape,
        str(measured.concurrency),
        f"{measured.processor_s:.3f}",
        f"{measured.per_second:.1f}",
        f"{measured.p50_s:.3f}",
        f"{measured.p90_s:.3f}",
        f"{measured.peak_bytes / 2**20:.0f}",
        f"{measured.together_bytes / 2**20:.0f}",
    ]


def _limited(memory: int) -> list[str]:
    """Words before a command that put it into a new cgroup, of version 2 or 1."""
    version_2 = Path("/sys/fs/cgroup/cgroup.controllers").exists()
    group = Path("/sys/fs/cgroup") / ("" if version_2 else "memory") / f"visloc-{os.getpid()}"
    group.mkdir()
    (group / ("memory.max" if version_2 else "memory.limit_in_bytes")).write_text(str(memory))
    atexit.register(_remove, group)
    return ["sh", "-c", f'echo $$ > {group}/cgroup.procs; exec "$@"', "sh"]


def _remove(group: Path) -> None:
    """Remove a cgroup once its last process, which multiprocessing leaves for a while, has gone."""
    while (group / "cgroup.procs").read_text():
        time.sleep(0.1)
    group.rmdir()


@contextmanager
def _service(
    maps_dir: Path, shape: str, before: Sequence[str], weights_dir: Path | None
) -> Iterator[ServiceProcess]:
    settings: dict[str, Any] = {"workers": None, "threads_per_worker": None}
    if shape != "default":
        workers, threads = shape.split("x")
        settings = {"workers": workers, "threads_per_worker": threads}
    if weights_dir is not None:
        settings["weights_dir"] = weights_dir
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "service.log"
        with ServiceProcess(maps_dir, log, before=before, **settings) as service:
            yield service


def _measure(
    service: ServiceProcess, shape: str, map_id: str, query: Path, concurrency: int
) -> Measured:
    began = service.processor_seconds()
    report = report_of(service.url, map_id, query, concurrency)
    spent = service.processor_seconds() - began
    latencies = report["latency_s"]
    return Measured(
        shape,
        concurrency,
        report["throughput_qps"],
        latencies["p50"],
        latencies["p90"],
        spent / report["queries"],
        max(map(peak_resident_bytes, service.worker_pids)),
        service.proportional_bytes(),
    )


if __name__ == "__main__":
    typer.run(main)
