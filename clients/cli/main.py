"""The ``localize`` command."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from clients.cli.dataset import benchmark, localize_batch
from clients.cli.display import print_line, print_result
from clients.cli.maps import maps_app
from clients.cli.options import Connection, MapRef, QueryOptions, priors_from_text, spread
from clients.errors import not_understood
from clients.evaluation.results import check_can_be_written, write_whole
from clients.wire.requests import read_image
from visloc.errors import VislocError
from visloc.extensions import LOCALIZE_COMMANDS, extensions, load
from visloc.geometry import Camera
from visloc.types import MaskedImage

EXIT_ERROR = 1  # 2 is wrong usage, by convention
EXIT_NOT_LOCALIZED = 3

app = typer.Typer(
    name="localize",
    help="Ask a localization service where photos were taken.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
_out = Console()
_err = Console(stderr=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and exit; errors are one line, not a traceback."""
    try:
        # Commands may write down how they were called.
        app(arguments, obj=tuple(sys.argv[1:] if arguments is None else arguments))
    except VislocError as error:
        _fail(error.code, str(error))
    except OSError as error:  # a full disk, a folder without permission
        _fail("system", str(error))


@app.command()
@spread
def image(
    *,
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", help="The photo to localize.")],
    map_ref: MapRef,
    query: QueryOptions,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL,W,H,PARAMS...",
            help="Intrinsics, such as PINHOLE,640,480,525,525,320,240. Without them the server "
            "uses the focal length in EXIF, or estimates or guesses one.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")] = False,
    priors: Annotated[
        str | None,
        typer.Option(
            metavar="JSON_OR_FILE",
            help="What is known of the pose: position, height, pose, gravity or gnss, as in the "
            "API.",
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(
            help="A picture of the photo's size or aspect, black where the photo does not count."
        ),
    ] = None,
    debug: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.jpg", help="Write a picture of the matches and their mapping photos."
        ),
    ] = None,
    connection: Connection,
) -> None:
    """Localize one photo.

    Exits with 0 when localized, 3 when not localized, 1 on an error, 2 on wrong usage.
    """
    options = query.options
    intrinsics = None if camera is None else Camera.from_text(camera)
    known = None if priors is None else priors_from_text(priors)
    check_can_be_written([] if debug is None else [debug])
    sent = photo if mask is None else MaskedImage(read_image(photo), read_image(mask))
    with connection.client() as client:
        result = client.localize(
            sent, map_ref, intrinsics, options, priors=known, debug=debug is not None
        )
        if as_json:
            typer.echo(json.dumps(result.raw, indent=2))
        else:
            print_result(_out, result)
    if debug is not None:
        if result.debug is None:
            got = "an answer without the picture that was asked for"
            raise not_understood(connection.server, got)
        write_whole(debug, [result.debug.overlay])
        if not as_json:
            print_line(_out, "picture", str(debug))
    if not result.localized:
        raise typer.Exit(EXIT_NOT_LOCALIZED)


app.command("batch")(localize_batch)
app.command()(benchmark)
app.add_typer(maps_app, name="maps")
for _name, _entry in extensions(LOCALIZE_COMMANDS).items():
    app.command(_name)(load(_entry))


def _fail(code: str, message: str) -> NoReturn:
    print_line(_err, f"error [{code}]", message, "red")
    sys.exit(EXIT_ERROR)
