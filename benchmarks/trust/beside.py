"""The time of a query beside another commit's: two services that are asked in turn.

Each service runs the code of its own checkout, on a map that this code built.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from time import perf_counter

import httpx

from benchmarks.reliability.service_process import ServiceProcess
from benchmarks.trust.maps import Places
from visloc.kapture import read_dataset

ROUNDS = 3
_MAP = "redkitchen"


def time_beside(places: Places, checkout: Path, folder: Path) -> Iterator[str]:
    """Ask both services about every photo of redkitchen, one at a time, in three rounds.

    Args:
        places: where the data lies.
        checkout: a git checkout of the other commit; this one's dependencies must suffice.
        folder: gets the maps of both, and their logs.

    Returns:
        Lines of a table: p50 of each, and their ratio.
    """
    here = Path(__file__).resolve().parents[2]
    photos = list(_photos(places))
    seconds: dict[Path, list[float]] = {here: [], checkout.resolve(): []}
    with ExitStack() as services:
        urls = {root: _serve(services, root, places, folder.resolve()) for root in seconds}
        for round_number in range(ROUNDS + 1):
            for i, (camera, image) in enumerate(photos):
                fields = {"map": _MAP, "camera": camera}
                # Neither is always the one that finds the caches warm.
                for root in list(seconds)[:: 1 if i % 2 else -1]:
                    started = perf_counter()
                    url, files = f"{urls[root]}/localize", {"image": image}
                    httpx.post(url, data=fields, files=files, timeout=60).raise_for_status()
                    if round_number:  # the first answers of a process are slower
                        seconds[root].append(perf_counter() - started)
    ours, theirs = (median(each) for each in seconds.values())
    yield "\n**Time of a query over HTTP, redkitchen, `xfeat`, p50**\n"
    yield "| queries of each | this | the other | ratio |"
    yield "|---|---|---|---|"
    count = ROUNDS * len(photos)
    yield f"| {count} | {ours * 1e3:.0f} ms | {theirs * 1e3:.0f} ms | {ours / theirs:.2f} |"


def _photos(places: Places) -> Iterator[tuple[str, bytes]]:
    """Yield camera and file of each photo."""
    dataset = read_dataset(places.dataset(_MAP, "query"))
    for record in dataset.images:
        camera = ",".join(dataset.sensors[record.sensor_id].params)
        yield camera, dataset.path_of(record).read_bytes()


def _serve(services: ExitStack, root: Path, places: Places, folder: Path) -> str:
    """Build the map with the code of a checkout, serve it with the same; the URL."""
    maps = folder / root.name
    inside = ["env", f"--chdir={root}"]
    if not (maps / _MAP).is_dir():
        maps.mkdir(parents=True)
        scripts = tomllib.loads((root / "pyproject.toml").read_text())["project"]["scripts"]
        module, _, function = scripts["mapping"].partition(":")
        call = f"from {module} import {function}; {function}()"
        dataset = places.dataset(_MAP, "mapping").resolve()
        build = ["build", str(dataset), "--map", _MAP, "--maps-dir", str(maps)]
        subprocess.run([*inside, sys.executable, "-c", call, *build], check=True, stdout=sys.stderr)
    service = ServiceProcess(maps, folder / f"{root.name}.log", before=inside, workers=1)
    return services.enter_context(service).url
