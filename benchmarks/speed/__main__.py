"""Speed beside the peer and beside the hardware's limit, in one run (docs/performance.md).

    python -m benchmarks.speed ../shared/data/redkitchen --local-features faster2d2 \
        --weights-dir ../shared/weights --report report.json

Builds the map, then asks all queries in rounds: in this process in several ways, a service over
HTTP, the peer, and the machine itself for its best rates, so that what else runs here disturbs all
alike. Prints tables in Markdown on stdout; progress goes to stderr. Stopped, it goes on with
--resume.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.speed.building import MAP_ID, build
from benchmarks.speed.dataset import make_bench
from benchmarks.speed.figures import Measured
from benchmarks.speed.limits import NETWORKS, measure_rates
from benchmarks.speed.machine import num_threads, this_machine
from benchmarks.speed.peer import export_for_peer, run_peer, why_no_peer
from benchmarks.speed.queries import Queries
from benchmarks.speed.served import ask_service
from benchmarks.speed.steps import Steps, say
from benchmarks.speed.tables import describe_machine, tables
from visloc.archive import MapStore
from visloc.options import Inference


def main(
    dataset: Annotated[Path, typer.Argument(help="Holds mapping/ and query/.")],
    local_features: Annotated[str, typer.Option(help="What to find in photos.")] = "faster2d2",
    weights_dir: Annotated[Path | None, typer.Option(help="Folder with network weights.")] = None,
    peer: Annotated[
        Path, typer.Option(help="The peer's run.sh; without such a file it is left out.")
    ] = Path("../shared/peer/run.sh"),
    repeats: Annotated[int, typer.Option(min=1, help="Rounds, each with a seed of its own.")] = 5,
    peer_repeats: Annotated[
        int, typer.Option(min=1, help="Rounds with the peer and a build: they take minutes.")
    ] = 3,
    queries: Annotated[
        int | None, typer.Option(min=1, help="Only so many queries, evenly chosen.")
    ] = None,
    work: Annotated[Path, typer.Option(help="Folder for maps, features and results.")] = Path(
        ".bench"
    ),
    report: Annotated[Path | None, typer.Option(help="Write all figures here, as JSON.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a run that was stopped.")
    ] = False,
) -> None:
    """Measure, print."""
    folder = work.resolve() / f"{dataset.name}-{local_features}"
    bench = make_bench(dataset, local_features, weights_dir, queries, folder)
    settings = {"queries": bench.num_queries, "repeats": repeats, "peer_repeats": peer_repeats}
    steps = Steps(folder / "steps", settings, resume=resume)
    machine, network = this_machine(), NETWORKS.get(local_features)
    say("; ".join(describe_machine(machine, [])))
    no_peer = why_no_peer(peer, has_depth=bench.has_depth)
    if no_peer is None:
        export_for_peer(bench)
    else:
        say(f"without the peer: {no_peer}")

    maps_dir, torch_dir = folder / "maps", folder / "maps-torch"
    builds = [steps.get("build-0", lambda: build(bench, maps_dir))]
    steps.get("build-torch", lambda: build(bench, torch_dir, Inference.TORCH))
    map_folder = MapStore(maps_dir).folder(MAP_ID)
    say("warming up")
    ours = Queries(
        bench, {Inference.AUTO: map_folder, Inference.TORCH: MapStore(torch_dir).folder(MAP_ID)}
    )
    described = steps.get("described", ours.describe)
    rounds: dict[str, list[Any]] = {"queries": [], "service": [], "peer": [], "rates": []}
    for number in range(repeats):
        ask = {
            "queries": partial(ours.ask_all, number),
            "service": partial(ask_service, bench, maps_dir, number),
            "rates": partial(
                measure_rates,
                network or NETWORKS["xfeat"],
                num_threads(),
                bf16=machine.has_bf16,
            ),
        }
        if number < peer_repeats:
            if no_peer is None:
                ask["peer"] = partial(run_peer, peer.resolve(), bench)
            if number > 0:
                rebuild = partial(build, bench, folder / "rebuilt")
                builds.append(steps.get(f"build-{number}", rebuild))
        for kind, measure in ask.items():
            rounds[kind].append(steps.get(f"{kind}-{number}", measure))

    measured = Measured(builds=builds, described=described, **rounds)
    loads = steps.load_averages()
    for line in [*describe_machine(machine, loads), *tables(bench, measured, no_peer)]:
        sys.stdout.write(f"{line}\n")
    if report is not None:
        figures = {
            "dataset": dataset.name,
            "local_features": local_features,
            "settings": settings,
            "machine": asdict(machine),
            "load_averages": loads,
            "without_peer": no_peer,
            **asdict(measured),
        }
        report.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
