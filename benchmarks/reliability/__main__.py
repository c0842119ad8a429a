"""What the service must withstand, one command for each kind of harm (docs/reliability.md).

    python -m benchmarks.reliability soak --seconds 900

Starts the service as users do, on free ports of this machine, and prints a table in Markdown.
Exits with 1 when something that must hold does not.
"""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.reliability.attackers import PAUSE_S
from benchmarks.reliability.checks import print_checks
from benchmarks.reliability.connections import Strength, connections
from benchmarks.reliability.heavy_requests import heavy_photos, many_values
from benchmarks.reliability.kills import kill_service, kill_workers
from benchmarks.reliability.maps import SampleMaps, make_maps
from benchmarks.reliability.siege import siege
from benchmarks.reliability.soak import soak
from benchmarks.reliability.storage import s3_away
from benchmarks.reliability.uploads import full_disk, truncated_upload

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__)


@app.command("soak")
def soak_command(seconds: Annotated[float, typer.Option(help="How long.")] = 900.0) -> None:
    """Twice the load that it can serve, good and bad, while versions are swapped every 20 s."""
    with _prepared() as (maps, work):
        print_checks("soak", asyncio.run(soak(maps, work, seconds)))


@app.command("kill")
def kill_command(
    kills: Annotated[int, typer.Option(help="Of workers, then of the service.")] = 10,
) -> None:
    """Kill -9 under load."""
    with _prepared() as (maps, work):
        copy = maps.copied_to(work / "copy")
        workers = asyncio.run(kill_workers(maps, work, kills))
        service = asyncio.run(kill_service(copy, work, kills))
        print_checks("kill", [*workers, *service])


@app.command("full-disk")
def full_disk_command() -> None:
    """Uploads to a disk without room: a small tmpfs of the service's own mount namespace."""
    with _prepared() as (maps, work):
        print_checks("full disk", full_disk(maps, work))


@app.command("truncated-upload")
def truncated_upload_command() -> None:
    """Uploads that end too early, in every way."""
    with _prepared() as (maps, work):
        print_checks("truncated upload", truncated_upload(maps, work))


@app.command("s3-away")
def s3_away_command(
    seconds: Annotated[float, typer.Option(help="How long it is away, each time.")] = 60.0,
) -> None:
    """An S3 server that is killed, and one that falls silent."""
    with _prepared() as (maps, work):
        print_checks("S3 away", asyncio.run(s3_away(maps, work, seconds)))


@app.command("connections")
def connections_command(
    count: Annotated[int, typer.Option(help="Connections of each attack, at once.")] = 2500,
    seconds: Annotated[float, typer.Option(help="Of each attack.")] = 8.0,
    pause: Annotated[
        float, typer.Option(help="Seconds before a connection that was closed is opened again.")
    ] = PAUSE_S,
    kinds: Annotated[str, typer.Option(help="A word in the names of the attacks.")] = "",
) -> None:
    """Idle, slow and flooding connections, from one address, through HAProxy."""
    strength = Strength(count, seconds, pause, kinds)
    with _prepared() as (maps, work):
        print_checks("connections", asyncio.run(connections(maps, work, strength)))


@app.command("heavy-photos")
def heavy_photos_command(
    deadline: Annotated[float, typer.Option(help="Of the callers, seconds.")] = 0.5,
) -> None:
    """Small photos that take long to decode, whose callers give up."""
    with _prepared() as (maps, work):
        print_checks("heavy photos", heavy_photos(maps, work, deadline))


@app.command("many-values")
def many_values_command(
    clients: Annotated[int, typer.Option(help="At once.")] = 8,
) -> None:
    """Messages of many small values, which take long to parse."""
    with _prepared() as (maps, work):
        print_checks("many values", many_values(maps, work, clients))


@app.command("siege")
def siege_command(
    minutes: Annotated[float, typer.Option(help="How long.")] = 15.0,
) -> None:
    """All attacks at once on two replicas, with swaps, kills, and a replica replaced."""
    with _prepared() as (maps, work):
        print_checks("siege", asyncio.run(siege(maps, work, 60 * minutes)))


@contextmanager
def _prepared() -> Iterator[tuple[SampleMaps, Path]]:
    """Make the maps and a folder for the rest."""
    with tempfile.TemporaryDirectory(prefix="visloc-reliability-") as folder:
        work = Path(folder)
        yield make_maps(work), work


if __name__ == "__main__":
    app()
