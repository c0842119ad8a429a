"""Builds of one dataset by one or two versions of the project, stage by stage.

    mapping sample /tmp/s200 --images 200
    python -m benchmarks.builds /tmp/s200/mapping .venv/bin/mapping OLD/.venv/bin/mapping

OLD is another checkout with an environment of its own. Each way and number of photos is built by
every command in turn, from nothing. CPU seconds are of all processes of a build, which tells more
than time on a machine that does other work. Memory is what all of them hold together, shared pages
once, twice a second. Prints tables in Markdown.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from visloc.kapture import read_dataset, write_dataset

WAYS = {
    "rgbd": ("--method", "rgbd"),
    "sfm": ("--method", "sfm"),
    "poses": ("--method", "sfm", "--poses", "estimate"),
}
_ROW = re.compile(
    r"^\s*(?P<stage>\S.*?)(?:\s+\d+)?\s+(?P<wall>\d+\.\d)\s+(?P<cpu>\d+\.\d)\s+\d+\.\d\s*$"
)
_ALL = "in all"
_PR_SET_CHILD_SUBREAPER = 36  # of Linux


@dataclass(frozen=True, slots=True)
class Cost:
    """Seconds of a stage: of the clock, and of the processors."""

    wall_s: float
    cpu_s: float


@dataclass(frozen=True, slots=True)
class Built:
    """One build, from the start of its process to the end.

    Attributes:
        stages: in their order, as the build prints them.
        memory_bytes: most that its processes held together.
    """

    whole: Cost
    stages: dict[str, Cost]
    memory_bytes: int


def first_photos(root: Path, count: int, output: Path) -> Path:
    """Write a dataset of the first photos of another, whose files it links to."""
    dataset = read_dataset(root)
    write_dataset(replace(dataset, root=output, images=dataset.images[:count]))
    data = root.resolve() / "sensors" / "records_data"
    (output / "sensors" / "records_data").symlink_to(data)
    return output


def built(command: Path, dataset: Path, way: str, maps_dir: Path, workers: int) -> Built:
    """Build a map, and remove it."""
    call = [str(command.absolute()), "build", str(dataset.absolute()), "--map", "bench", *WAYS[way]]
    call += ["--maps-dir", str(maps_dir), "--workers", str(workers)]
    _adopt_orphans()
    start = time.perf_counter()
    with tempfile.TemporaryFile("w+") as out:
        # Not in this folder: its packages would come before those of the command's environment.
        process = subprocess.Popen(call, stdout=out, stderr=subprocess.STDOUT, cwd="/")
        peak = _Peak(process.pid)
        peak.start()
        _, status, usage = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        peak.ended.set()
        peak.join()
        cpu_s = usage.ru_utime + usage.ru_stime + _spent_by_orphans(peak.seen)
        out.seek(0)
        text = out.read()
    shutil.rmtree(maps_dir, ignore_errors=True)
    stages = _stages(text)
    if _ALL not in stages:  # a map in doubt ends with an error, and has its costs all the same
        raise RuntimeError(f"{' '.join(call)} failed:\n{text}")
    return Built(Cost(wall_s, cpu_s), stages, peak.largest_bytes)


def _adopt_orphans() -> None:
    """Let processes whose parent ends become children of this one: workers outlive their build."""
    if ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
        raise OSError("this system does not hand orphans on")


def _spent_by_orphans(pids: set[int]) -> float:
    """Wait for processes that were left, and return their CPU seconds."""
    spent_s = 0.0
    for pid in pids:
        with suppress(ChildProcessError):  # its parent waited for it
            usage = os.wait4(pid, 0)[2]
            spent_s += usage.ru_utime + usage.ru_stime
    return spent_s


def _stages(text: str) -> dict[str, Cost]:
    rows = text.partition("CPU seconds")[2].splitlines()
    found = [match for row in rows if (match := _ROW.match(row))]
    return {match["stage"]: Cost(float(match["wall"]), float(match["cpu"])) for match in found}


class _Peak(threading.Thread):
    """Follows the memory of a process and its children."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self.largest_bytes = 0
        self.seen: set[int] = set()
        self.ended = threading.Event()
        self._pid = pid

    def run(self) -> None:
        while not self.ended.wait(0.5):
            family = _family(self._pid)
            self.seen.update(family)
            self.largest_bytes = max(self.largest_bytes, sum(map(_held, family)))


def _family(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:  # it ended
        return []
    return [pid, *(one for child in children for one in _family(int(child)))]


def _held(pid: int) -> int:
    """Return the bytes that a process holds, with its part of what it shares."""
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:
        return 0
    found = re.search(r"^Pss:\s+(\d+) kB", text, re.MULTILINE)
    return int(found[1]) * 1024 if found else 0


def _print_table(way: str, count: int, results: list[Built]) -> None:
    names = [f"CPU s, {number}" for number in range(1, len(results) + 1)]
    typer.echo(f"\n`{way}`, {count} photos\n\n| stage | {' | '.join(names)} |")
    typer.echo("|---" * (len(names) + 1) + "|")
    stages = list(dict.fromkeys(stage for result in results for stage in result.stages))
    for stage in (each for each in stages if each != _ALL):
        costs = [result.stages.get(stage) for result in results]
        cells = ["" if cost is None else f"{cost.cpu_s:.1f}" for cost in costs]
        typer.echo(f"| {stage} | {' | '.join(cells)} |")
    for title, cells in (
        ("**all processes**", [f"**{result.whole.cpu_s:.1f}**" for result in results]),
        ("seconds of the clock", [f"{result.whole.wall_s:.1f}" for result in results]),
        ("most memory, GiB", [f"{result.memory_bytes / 2**30:.2f}" for result in results]),
    ):
        typer.echo(f"| {title} | {' | '.join(cells)} |")


def main(
    dataset: Annotated[Path, typer.Argument(help="kapture folder with depth maps.")],
    commands: Annotated[list[Path], typer.Argument(help="`mapping`, of each version.")],
    photos: Annotated[list[int] | None, typer.Option(help="First so many; all.")] = None,
    way: Annotated[list[str] | None, typer.Option(help=", ".join(WAYS))] = None,
    workers: int = 2,
) -> None:
    """Build by all, print."""
    for count in photos or [len(read_dataset(dataset).images)]:
        for each in way or list(WAYS):
            with tempfile.TemporaryDirectory() as folder:
                some = first_photos(dataset, count, Path(folder) / "dataset")
                maps_dir = Path(folder) / "maps"
                results = [built(one, some, each, maps_dir, workers) for one in commands]
            _print_table(each, count, results)


if __name__ == "__main__":
    typer.run(main)
