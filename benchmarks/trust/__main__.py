"""How far an answer can be trusted: all figures of docs/trust.md in one run (``make trust``).

    python -m benchmarks.trust [--data-dir ../shared/data] [--maps-dir DIR] [--only NAME ...]

Maps that the folder does not have are built first. Every answer becomes a line of JSON in
``--answers-dir``, one file for each of the scenarios: own, focal, prints, mirrored, halves, shapes,
floors, floor-set, night, elsewhere. Prints tables in Markdown. With ``--pictures DIR`` each photo
that is wrongly believed is drawn, beside a mapping photo. With ``--beside CHECKOUT`` only the time
of a query is measured, beside the code of another commit.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from itertools import chain, islice
from pathlib import Path
from time import perf_counter
from typing import Annotated, TypeVar

import typer

from benchmarks.trust.asking import Maps, ask_floors
from benchmarks.trust.beside import time_beside
from benchmarks.trust.maps import Places, make_missing
from benchmarks.trust.outcomes import Outcome
from benchmarks.trust.pictures import ask_and_draw
from benchmarks.trust.scenarios import FLOOR_SET, NEEDED, SCENARIOS, floor_set
from benchmarks.trust.table import write_tables

_Asked = TypeVar("_Asked")


def main(
    data_dir: Annotated[Path, typer.Option(help="The shared data sets.")] = Path("../shared/data"),
    maps_dir: Annotated[Path, typer.Option(help="A store of maps; missing ones are built.")] = Path(
        ".trust/maps"
    ),
    answers_dir: Annotated[Path, typer.Option(help="Gets a file for each scenario.")] = Path(
        ".trust/answers"
    ),
    only: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(NEEDED)}.")] = None,
    beside: Annotated[
        Path | None, typer.Option(help="Only time queries beside this checkout of a commit.")
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Gets a picture of each photo that is wrongly believed.")
    ] = None,
    weights_dir: Path | None = None,
    resume: Annotated[
        bool, typer.Option(help="Keep the answers of a run of the same code that was stopped.")
    ] = False,
) -> None:
    """Run the scenarios, and print the tables."""
    chosen = only or list(NEEDED)
    unknown = set(chosen) - set(NEEDED)
    if unknown:
        raise typer.BadParameter(f"{', '.join(sorted(unknown))}: one of {', '.join(NEEDED)}")
    places = Places(data_dir, maps_dir)
    if beside is not None:
        for line in time_beside(places, beside, answers_dir / "beside"):
            typer.echo(line)
        return
    needed = set().union(*(NEEDED[name] for name in chosen))
    make_missing(places, needed, lambda line: typer.echo(line, err=True))
    answers_dir.mkdir(parents=True, exist_ok=True)
    maps = Maps(places.store, weights_dir)
    outcomes: list[Outcome] = []
    for name in chosen:
        started = perf_counter()
        path = answers_dir / f"{name}.jsonl"
        before = list(outcomes_in(path)) if resume and path.exists() else []
        if name == FLOOR_SET:
            found = ask_floors(places.store, weights_dir, _after(before, floor_set(places)))
        elif pictures is None:
            found = maps.ask(_after(before, SCENARIOS[name](places)))
        else:
            queries = _after(before, SCENARIOS[name](places))
            found = ask_and_draw(maps, queries, places, pictures / name)
        outcomes += kept(chain(before, found), path)
        typer.echo(f"{name}: {perf_counter() - started:.0f} s", err=True)
    for line in write_tables(outcomes):
        typer.echo(line)


def kept(outcomes: Iterator[Outcome], path: Path) -> list[Outcome]:
    """Write outcomes as they come, one line of JSON each."""
    seen = []
    with path.open("w", buffering=1, encoding="utf-8") as lines:
        for outcome in outcomes:
            lines.write(json.dumps(asdict(outcome)) + "\n")
            seen.append(outcome)
    return seen


def outcomes_in(path: Path) -> Iterator[Outcome]:
    """Read the outcomes that ``kept`` wrote, up to a line that was cut off."""
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            yield Outcome(**json.loads(line))
        except json.JSONDecodeError:
            return


def _after(before: list[Outcome], queries: Iterator[_Asked]) -> Iterator[_Asked]:
    """Leave out the queries that were answered; a scenario asks in the same order each time."""
    return islice(queries, len(before), None)


if __name__ == "__main__":
    typer.run(main)
