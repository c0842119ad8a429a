"""The commands ``localize maps``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from clients.cli.display import print_line
from clients.cli.maps_display import print_map, print_maps
from clients.cli.options import Connection, spread
from clients.cli.progress import EXIT_STOPPED
from clients.wire.requests import checked_version
from visloc.errors import VislocError, refuse
from visloc.types import Near

maps_app = typer.Typer(
    help="List, publish, switch and remove the maps of a localization service.",
    no_args_is_help=True,
)
_out = Console()
_err = Console(stderr=True)

Version = Annotated[str, typer.Argument(metavar="ID@VERSION", help="The map and its version.")]


@maps_app.command("list")
@spread
def list_maps(
    *,
    near: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,RADIUS",
            help="Only maps that are anchored to the Earth and reach into this circle: degrees "
            "and metres, WGS84.",
        ),
    ] = None,
    connection: Connection,
) -> None:
    """List the maps, each in the current version."""
    circle = None if near is None else _near(near)
    with connection.client() as client:
        print_maps(_out, client.maps(circle))


@maps_app.command()
@spread
def show(
    map_ref: Annotated[str, typer.Argument(metavar="ID", help="id, or id@version.")],
    connection: Connection,
) -> None:
    """Describe a map: features, extent, place on Earth, versions."""
    with connection.client() as client:
        print_map(_out, client.map(map_ref))


@maps_app.command()
@spread
def push(
    packed: Annotated[Path, typer.Argument(metavar="FILE", help="A map as mapping pack wrote it.")],
    connection: Connection,
) -> None:
    """Publish a version of a map, under the names that it was built with.

    The server verifies it byte by byte before anyone can see it. It is not current until localize
    maps use names it. When this command is stopped, nothing is published.
    """
    with (
        connection.client() as client,
        _bar() as progress,
    ):
        try:
            total = packed.stat().st_size if packed.is_file() else None
            task = progress.add_task("sent", total=total)
            info = client.upload_map(packed, on_progress=lambda sent: progress.advance(task, sent))
        except KeyboardInterrupt:
            progress.stop()
            _err.print("stopped; nothing was published", highlight=False)
            raise typer.Exit(EXIT_STOPPED) from None
        except VislocError:
            progress.stop()
            raise
    print_map(_out, info)
    if not info.current:
        print_line(_out, "next", f"localize maps use {info.ref}")


@maps_app.command()
@spread
def use(version: Version, connection: Connection) -> None:
    """Make a version current, a newer or an older one, without dropping a request.

    Returns when the service answers with it.
    """
    with connection.client() as client:
        info = client.use_version(*_names(version))
    print_line(_out, "current", info.ref, "bold green")


@maps_app.command()
@spread
def remove(version: Version, connection: Connection) -> None:
    """Delete a version that is not current, or the last one of a map."""
    map_id, name = _names(version)
    with connection.client() as client:
        client.delete_version(map_id, name)
    print_line(_out, "removed", f"{map_id}@{name}")


def _bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=_err,
    )


def _names(version: str) -> tuple[str, str]:
    map_id, at, name = version.partition("@")
    if not at:
        raise refuse(
            "map.id",
            "this does not name a version of a map",
            field="map",
            expected="ID@VERSION",
            got=version,
        )
    return checked_version(map_id, name)


def _near(text: str) -> Near:
    try:
        latitude, longitude, radius = (float(number) for number in text.split(","))
    except ValueError:
        raise refuse("near.syntax", field="near", got=text) from None
    return Near(latitude, longitude, radius)
