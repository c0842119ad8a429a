"""Are the answers still the same, bit for bit? For changes that are to move code and nothing else.

    python -m benchmarks.same_answers record ANSWERS --maps-dir MAPS     # before
    python -m benchmarks.same_answers compare ANSWERS --maps-dir MAPS    # after
    python -m benchmarks.same_answers surfaces FOLDER                    # then diff -r two folders

``record`` builds the maps that are missing, starts the service and asks it about every query in
every mode, over HTTP and over gRPC, through the command ``localize batch``. ``compare`` asks again
and exits with 1 where an answer differs, or where HTTP and gRPC do. It uses commands only, so that
it runs before and after any change of the code. Compare on one machine: other processors round
differently.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.reliability.service_process import ServiceProcess
from tools.site.http_reference import openapi_schema

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
# Of an answer: what no two runs share.
CHANGING = ("seconds", "request_id", "client_seconds", "attempts")
SET_ID = "places"


@dataclass(frozen=True)
class Place:
    """A map: how it is built, the queries, and the options of ``localize batch``."""

    mapping: str
    query: str
    build: tuple[str, ...]
    modes: tuple[str, ...] = ("single",)
    batch: tuple[str, ...] = ()


PLACES = {
    "redkitchen": Place(
        "redkitchen/mapping",
        "redkitchen/query",
        build=("--method", "rgbd"),
        modes=("single", "seq"),
        batch=("--time-unit", "ms"),
    ),
    "castle": Place("castle/mapping", "castle/query", ("--method", "sfm")),
    "kitti_curve": Place(
        "kitti_curve/mapping",
        "kitti_curve/query",
        build=("--method", "sfm"),
        modes=("single", "rig", "seq", "rig+seq", "gp3p"),
        batch=("--time-unit", "ms"),
    ),
    "gardenspoint": Place("gardenspoint/mapping", "gardenspoint/query", ("--method", "sfm")),
    "ie_tower": Place(
        "ie_tower/floor11_hallway_right/mapping",
        "ie_tower/floor11_hallway_right/query",
        ("--method", "sfm"),
    ),
}
TILES = ("castle", "redkitchen", "kitti_curve")
APART_M = 10_000.0
app = typer.Typer(add_completion=False, no_args_is_help=True)


def run(command: str, *arguments: object) -> None:
    """Run a command of ours; stop at the first that fails."""
    subprocess.run([Path(sys.executable).with_name(command), *map(str, arguments)], check=True)


def make_maps(maps_dir: Path) -> None:
    """Build the maps that are missing, and the set of three of them."""
    for map_id, place in PLACES.items():
        if not (maps_dir / map_id / "current").exists():
            typer.echo(f"building {map_id}")
            run(
                *("mapping", "build", DATA / place.mapping, "--map", map_id),
                *("--maps-dir", maps_dir, *place.build),
            )
    if not (maps_dir / SET_ID / "current").exists():
        with tempfile.NamedTemporaryFile("w", suffix=".txt") as poses:
            poses.writelines(f"{tile} 1 0 0 0 {APART_M * i} 0 0\n" for i, tile in enumerate(TILES))
            poses.flush()
            run(
                *("mapping", "set", SET_ID, *TILES),
                *("--poses", poses.name, "--maps-dir", maps_dir),
            )


def ask(maps_dir: Path, answers: Path) -> None:
    """Write the answers of all cases as ``CASE.http.jsonl`` and ``CASE.grpc.jsonl``."""
    answers.mkdir(parents=True, exist_ok=True)
    cases = [(map_id, map_id, mode) for map_id, place in PLACES.items() for mode in place.modes]
    cases += [(SET_ID, map_id, "single") for map_id in TILES]
    service = ServiceProcess(maps_dir, answers / "service.log")
    service.start()
    try:
        service.wait_until_ready()
        for asked, queries, mode in cases:
            for transport, url in (("http", service.url), ("grpc", f"grpc://{service.grpc}")):
                with tempfile.TemporaryDirectory() as folder:
                    run(
                        *("localize", "batch", DATA / PLACES[queries].query, "--map", asked),
                        *("--server", url, "--mode", mode, "--output", folder),
                        *PLACES[queries].batch,
                    )
                    lines = Path(folder, "results.jsonl").read_text(encoding="utf-8").splitlines()
                kept = sorted(
                    json.dumps(stable(json.loads(line)), sort_keys=True) for line in lines
                )
                name = f"{asked}.{queries}.{mode}.{transport}.jsonl"
                (answers / name).write_text("\n".join(kept) + "\n", encoding="utf-8")
    finally:
        service.stop()


def stable(answer: Any) -> Any:
    """Return an answer without what no two runs share."""
    if isinstance(answer, Mapping):
        return {name: stable(value) for name, value in answer.items() if name not in CHANGING}
    return [stable(each) for each in answer] if isinstance(answer, list) else answer


def differences(a: Path, b: Path) -> list[str]:
    """Return the lines of ``a`` that ``b`` has not."""
    there = set(b.read_text(encoding="utf-8").splitlines())
    return [line for line in a.read_text(encoding="utf-8").splitlines() if line not in there]


@app.command()
def record(answers: Path, maps_dir: Annotated[Path, typer.Option()]) -> None:
    """Build maps where there are none, ask about everything, and keep the answers."""
    make_maps(maps_dir)
    ask(maps_dir, answers)
    typer.echo(f"{len(list(answers.glob('*.jsonl')))} files of answers in {answers}")


@app.command()
def surfaces(folder: Path) -> None:
    """Write what users see without asking about a photo: --help of all commands, and OpenAPI."""
    folder.mkdir(parents=True, exist_ok=True)
    for command in ("mapping", "localize", "visloc-service"):
        for path in _subcommands((command,)):
            (folder / f"{'_'.join(path)}.txt").write_text(_help(path), encoding="utf-8")
    (folder / "openapi.json").write_text(
        json.dumps(openapi_schema(), indent=1, sort_keys=True), encoding="utf-8"
    )
    typer.echo(f"{len(list(folder.iterdir()))} files in {folder}")


def _help(path: tuple[str, ...]) -> str:
    program = str(Path(sys.executable).with_name(path[0]))
    wide = {**os.environ, "COLUMNS": "160", "NO_COLOR": "1", "TERM": "dumb"}
    asked = [program, *path[1:], "--help"]
    return subprocess.run(asked, check=True, stdout=subprocess.PIPE, text=True, env=wide).stdout


def _subcommands(path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    yield path
    listed = _help(path).partition("Commands")[2]
    for name in re.findall(r"^│ ([a-z][a-z-]+) ", listed, flags=re.MULTILINE):
        yield from _subcommands((*path, name))


@app.command()
def compare(answers: Path, maps_dir: Annotated[Path, typer.Option()]) -> None:
    """Ask again, and say what differs from the answers that were kept."""
    with tempfile.TemporaryDirectory() as folder:
        now = Path(folder)
        ask(maps_dir, now)
        wrong = 0
        for file in sorted(answers.glob("*.jsonl")):
            lines = len(file.read_text(encoding="utf-8").splitlines())
            changed = differences(file, now / file.name)
            wrong += len(changed)
            typer.echo(f"{file.name}: {lines} answers, {len(changed)} differ")
            for line in changed[:1]:
                typer.echo(f"  such as {line[:300]}")
        for file in sorted(now.glob("*.http.jsonl")):
            other = file.with_name(file.name.replace(".http.", ".grpc."))
            changed = differences(file, other)
            wrong += len(changed)
            if changed:
                typer.echo(
                    f"{file.name}: {len(changed)} differ over gRPC, such as {changed[0][:300]}"
                )
    raise typer.Exit(1 if wrong else 0)


if __name__ == "__main__":
    app()
