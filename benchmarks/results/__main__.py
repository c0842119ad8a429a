"""Measure tables of docs/results.md again, and write them there with commit and date.

    python -m benchmarks.results [NAME ...] [--data DATA] [--work WORK] [--measure-only]

Without NAME all tables are measured, which takes hours: do it on a quiet machine. What is measured
is kept in WORK by commit, with the maps, so that a run that was stopped goes on with the table that
it was at, and a second run measures nothing. Delete WORK/COMMIT to begin anew. Where files differ
from the commit, whose name then ends in "+", nothing is taken from an earlier run but its maps.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.results.page import Measured, joined_rows, with_table
from benchmarks.results.tables import MAPS, TABLES, Build
from visloc.kapture.writer import write_atomically

ROOT = Path(__file__).parents[2]


def main(
    names: Annotated[list[str] | None, typer.Argument(help=", ".join(TABLES))] = None,
    data: Path = Path("../shared/data"),
    work: Path = Path(".results"),
    measure_only: Annotated[
        bool, typer.Option(help="Leave docs/results.md as it is, and print the tables.")
    ] = False,
) -> None:
    """Measure what is missing, and write it into docs/results.md."""
    for name in names or ():
        if name not in TABLES:
            raise typer.BadParameter(f"{name}: there is {', '.join(TABLES)}")
    page = ROOT / "docs" / "results.md"
    commit = commit_of(ROOT)
    folder = work.resolve() / commit
    (folder / "maps").mkdir(parents=True, exist_ok=True)
    for name in names or TABLES:
        kept = folder / f"{name}.json"
        if not kept.exists() or commit.endswith("+"):
            typer.echo(f"{name} ...", err=True)
            try:
                measured = _measured(name, commit, data.resolve(), folder)
            except (subprocess.CalledProcessError, ValueError) as error:
                sys.exit(f"table {name} was not measured: {error}")
            write_atomically(kept, json.dumps(asdict(measured), indent=1).encode())
        measured = Measured(**json.loads(kept.read_text(encoding="utf-8")))
        if measure_only:
            typer.echo("\n".join((f"{name}, {measured.date}, {commit}", *measured.rows)))
        else:
            text = page.read_text(encoding="utf-8")
            write_atomically(page, with_table(text, name, measured).encode())


def commit_of(root: Path) -> str:
    """Return the short hash of the commit, with ``+`` if a file of the programs differs from it."""
    commit = _git(root, "rev-parse", "--short=7", "HEAD")
    changed = _git(root, "status", "--porcelain", "--untracked-files=no", "--", ":!docs", ":!*.md")
    return f"{commit}+" if changed else commit


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], cwd=root, check=True, stdout=subprocess.PIPE, text=True
    )
    return done.stdout.strip()


def _measured(name: str, commit: str, data: Path, folder: Path) -> Measured:
    table = TABLES[name]
    for map_id in table.maps:
        if not (folder / "maps" / map_id / "current").exists():
            _build(map_id, MAPS[map_id], data, folder / "maps")
    places = {"DATA": data, "MAPS": folder / "maps", "WORK": folder}
    outputs = [(label, _output(_filled(run, places))) for label, run in table.runs.items()]
    return Measured(commit, datetime.now(UTC).date().isoformat(), joined_rows(outputs))


def _build(map_id: str, build: Build, data: Path, maps: Path) -> None:
    dataset = data / build.dataset / "mapping"
    mapping = str(Path(sys.executable).with_name("mapping"))
    command = [mapping, "build", str(dataset), "--map", map_id, "--maps-dir", str(maps)]
    subprocess.run([*command, *build.options], cwd=ROOT, check=True, stdout=sys.stderr)


def _filled(run: Sequence[str], places: dict[str, Path]) -> list[str]:
    """Return arguments with the folders that DATA, MAPS and WORK stand for."""
    parts = (argument.partition("/") for argument in run)
    return [f"{places.get(first, first)}{slash}{rest}" for first, slash, rest in parts]


def _output(arguments: Sequence[str]) -> str:
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout


if __name__ == "__main__":
    typer.run(main)
