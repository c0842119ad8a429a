"""Networks, queries and a service on a CUDA GPU (docs/performance.md).

    python -m benchmarks.speed.gpu ../shared/data/redkitchen --weights-dir ../shared/weights

Builds a map for each of the local features. Asks its queries in this process and over HTTP, and
once more in a process that sees no GPU, with the same map. Prints tables in Markdown on stdout.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import torch
import typer

from benchmarks.speed.building import MAP_ID, build
from benchmarks.speed.dataset import Bench, Error, make_bench, num_within
from benchmarks.speed.load import ask_at_once
from benchmarks.speed.machine import load_average, num_threads, this_machine
from benchmarks.speed.queries import answer_to
from benchmarks.speed.served import service
from benchmarks.speed.steps import say
from benchmarks.speed.tables import describe_machine, number, table
from visloc.archive import MapStore, open_map
from visloc.features import make_local_features
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import Extraction, Inference, LocalizeOptions
from visloc.photos.reading import read_photo_file

_NETWORKS = ("r2d2", "faster2d2", "xfeat")
_SIZES = ((640, 480), (1024, 768), (1600, 1200))
_REPEATS = 10
_WARM_UPS = 3  # the first runs choose kernels
_CLIENTS = 32
_LOAD_S = 5.0


def measure_gpu(
    bench: Bench, maps_dir: Path, workers: tuple[int, ...], keep: Callable[[dict[str, Any]], None]
) -> None:
    """Everything about one kind of local features; its map is built in ``maps_dir``.

    What is known so far is given to ``keep``, so that a run that is stopped leaves something.
    """
    say(f"{bench.features}: building")
    torch.cuda.reset_peak_memory_stats()
    started = time.perf_counter()
    built = build(bench, maps_dir)
    figures: dict[str, Any] = {"built": built, "built_in": time.perf_counter() - started}
    say(f"{bench.features}: built in {figures['built_in']:.1f} s; asking")
    figures["gpu"] = ask_here(bench, maps_dir)
    figures["gpu"]["megabytes"] = torch.cuda.max_memory_allocated() / 1e6
    keep(figures)
    say(f"{bench.features}: asking without the GPU")
    figures["processor"] = _ask_without_gpu(bench, maps_dir)
    figures["service"] = []
    for count in workers:
        say(f"{bench.features}: a service of {count} workers")
        figures["service"].append(_ask_service(bench, maps_dir, count))
        keep(figures)


def measure_extraction(bench: Bench) -> list[dict[str, Any]]:
    """Seconds to find the features of one photo, by network, effort and size."""
    photo = read_photo_file(_a_photo(bench)).rgb
    found = []
    for name in _NETWORKS:
        extractor = make_local_features(name, bench.weights_dir, Inference.TORCH)
        for width, height in _SIZES:
            rgb = np.asarray(cv2.resize(photo, (width, height)), np.uint8)
            for effort in (Extraction.DEFAULT, Extraction.ACCURATE):
                torch.cuda.reset_peak_memory_stats()

                def run(
                    rgb: np.ndarray = rgb,
                    effort: Extraction = effort,
                    extractor: Any = extractor,
                ) -> None:
                    extractor.extract(rgb, max_keypoints=5000, extraction=effort)

                row = {"network": name, "extraction": effort.value, "size": [width, height]}
                seconds = _median_seconds(run)
                peak = torch.cuda.max_memory_allocated() / 1e6
                found.append({**row, "seconds": seconds, "megabytes": peak})
    return found


def ask_here(bench: Bench, maps_dir: Path) -> dict[str, Any]:
    """Ask every query in this process: median seconds by stage, and how good the poses are."""
    dataset = read_dataset(bench.query)
    extractor = make_local_features(bench.features, bench.weights_dir, Inference.TORCH)
    localizer = Localizer(open_map(MapStore(maps_dir).folder(MAP_ID)), extractor)
    localizer.warm_up()
    records = [*dataset.images[:_WARM_UPS], *dataset.images]
    asked = [answer_to(localizer, dataset, record, LocalizeOptions()) for record in records]
    stages = [{**one["seconds"], "whole query": one["total"]} for one in asked[_WARM_UPS:]]
    errors: list[Error | None] = [one["error"] for one in asked[_WARM_UPS:]]
    known = [error for error in errors if error is not None]
    return {
        "computed_with": extractor.computed_with,
        "seconds": {name: float(np.median([s[name] for s in stages])) for name in stages[0]},
        "queries": len(errors),
        "localized": len(known),
        "within_5cm_5deg": num_within(errors, 0.05, 5.0),
        "median_m": float(np.median([error[0] for error in known])),
        "median_deg": float(np.median([error[1] for error in known])),
    }


def _ask_without_gpu(bench: Bench, maps_dir: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.speed.gpu", str(bench.dataset)]
    command += ["--ask", str(maps_dir), "--local-features", bench.features]
    if bench.weights_dir is not None:
        command += ["--weights-dir", str(bench.weights_dir)]
    without = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, env=without)
    figures: dict[str, Any] = json.loads(done.stdout)
    return figures


def _ask_service(bench: Bench, maps_dir: Path, workers: int) -> dict[str, Any]:
    """A service of so many workers: one client, then many at once."""
    threads = max(1, num_threads() // workers)
    free_before = torch.cuda.mem_get_info()[0]
    with service(bench, maps_dir, workers=workers, threads_per_worker=threads) as served:
        ask = partial(ask_at_once, served.url, MAP_ID, bench.query)
        ask(_CLIENTS, _LOAD_S / 2)  # the first answers of a process are slower
        alone, many = ask(1, _LOAD_S / 2), ask(_CLIENTS, _LOAD_S)
        used = free_before - torch.cuda.mem_get_info()[0]
    return {
        "workers": workers,
        "threads": threads,
        "alone": float(np.median(alone.latencies)),
        "alone_stages": alone.stages,
        "p50": float(np.median(many.latencies)),
        "p95": float(np.percentile(many.latencies, 95)),
        "stages": many.stages,
        "queries_per_second": many.per_second,
        "megabytes": used / 1e6,
    }


def _a_photo(bench: Bench) -> Path:
    dataset = read_dataset(bench.query)
    return dataset.path_of(dataset.images[0])


def _median_seconds(run: Callable[[], None]) -> float:
    seconds = []
    for _ in range(_REPEATS + _WARM_UPS):
        torch.cuda.synchronize()
        started = time.perf_counter()
        run()
        torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds[_WARM_UPS:]))


def main(
    dataset: Annotated[Path, typer.Argument(help="Holds mapping/ and query/.")],
    local_features: Annotated[str, typer.Option(help="With commas between.")] = "faster2d2,xfeat",
    weights_dir: Annotated[Path | None, typer.Option(help="Folder with network weights.")] = None,
    workers: Annotated[str, typer.Option(help="Of services to start, with commas.")] = "1,4,8,16",
    work: Annotated[Path, typer.Option(help="Folder for maps and logs.")] = Path(".bench/gpu"),
    report: Annotated[Path | None, typer.Option(help="Write all figures here, as JSON.")] = None,
    ask: Annotated[Path | None, typer.Option(help="Only ask the map in this folder.")] = None,
) -> None:
    """Measure, print."""
    names = local_features.split(",")
    benches = {
        name: make_bench(dataset, name, weights_dir, None, work.resolve() / name) for name in names
    }
    if ask is not None:
        sys.stdout.write(json.dumps(ask_here(benches[names[0]], ask)) + "\n")
        return
    counts = tuple(int(count) for count in workers.split(","))
    figures: dict[str, Any] = {
        "machine": list(describe_machine(this_machine(), [load_average()])),
        "by_features": {},
    }

    def keep(part: dict[str, Any], name: str, value: Any) -> None:
        part[name] = value
        if report is not None:
            report.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")

    for name, bench in benches.items():
        bench.work.mkdir(parents=True, exist_ok=True)
        measure_gpu(bench, bench.work / "maps", counts, partial(keep, figures["by_features"], name))
    say("extraction")
    keep(figures, "extraction", measure_extraction(benches[names[0]]))
    for line in _lines(figures):
        sys.stdout.write(f"{line}\n")


def _lines(figures: Mapping[str, Any]) -> Iterator[str]:
    """The tables, as docs/performance.md has them."""
    yield from figures["machine"]
    rows = [
        [
            f"`{row['network']}`",
            f"{row['size'][0]} x {row['size'][1]}",
            f"`{row['extraction']}`",
            number(1e3 * row["seconds"], 1),
            number(row["megabytes"], 0),
        ]
        for row in figures["extraction"]
    ]
    yield from table(["network", "photo", "extraction", "ms", "MB of the GPU at most"], rows)
    asked = {
        f"`{name}`, {'GPU' if kind == 'gpu' else 'processor'}": measured[kind]
        for name, measured in figures["by_features"].items()
        for kind in ("gpu", "processor")
    }
    stages = next(iter(asked.values()))["seconds"]
    rows = [
        [
            stage.replace("_", " "),
            *(number(1e3 * one["seconds"][stage], 1) for one in asked.values()),
        ]
        for stage in stages
    ]
    yield from table(["ms per query, median", *asked], rows)
    rows = [
        [
            name,
            f"{one['localized']} of {one['queries']}",
            str(one["within_5cm_5deg"]),
            number(100 * one["median_m"], 2),
            number(one["median_deg"], 3),
        ]
        for name, one in asked.items()
    ]
    yield from table(["accuracy", "localized", "5 cm, 5 deg", "median cm", "median deg"], rows)
    rows = [
        [
            f"`{name}`",
            f"{one['workers']} x {one['threads']}",
            number(1e3 * one["alone"], 1),
            number(one["queries_per_second"], 0),
            number(1e3 * one["p50"], 0),
            number(1e3 * one["p95"], 0),
            number(one["megabytes"], 0),
        ]
        for name, measured in figures["by_features"].items()
        for one in measured["service"]
    ]
    head = ["service", "workers x threads", "one client: p50 ms"]
    head += [f"{_CLIENTS} clients: per second", "p50 ms", "p95 ms", "MB of the GPU"]
    yield from table(head, rows)
    rows = [
        [
            f"`{name}`",
            number(measured["built_in"], 1),
            str(measured["built"]["counts"]["landmarks"]),
        ]
        for name, measured in figures["by_features"].items()
    ]
    yield from table(["building", "seconds", "landmarks"], rows)


if __name__ == "__main__":
    typer.run(main)
