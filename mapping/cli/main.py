"""The ``mapping`` command."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Mapping
from typing import NoReturn

import typer

from mapping.cli.acceptance import use
from mapping.cli.build import build, import_
from mapping.cli.datasets import (
    pairs,
    sample,
)
from mapping.cli.display import ERR
from mapping.cli.from_settings import from_settings
from mapping.cli.maps import anchor, edit, export, inspect, pack, upgrade, verify
from visloc.errors import VislocError
from visloc.extensions import MAPPING_COMMANDS, extensions, load

COMMANDS: Mapping[str, Callable[..., None]] = {
    "build": build,
    "pairs": pairs,
    "import": import_,
    "anchor": anchor,
    "edit": edit,
    "upgrade": upgrade,
    "export": export,
    "pack": pack,
    "inspect": inspect,
    "verify": verify,
    "use": use,
    "sample": sample,
}

app = typer.Typer(
    name="mapping",
    help="Build, inspect and check maps for the localization service.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
for _name, _command in COMMANDS.items():
    app.command(_name)(from_settings(_command))
for _name, _entry in extensions(MAPPING_COMMANDS).items():
    app.command(_name)(from_settings(load(_entry)))


def main() -> None:
    """Run the command; an error is one line, not a traceback."""
    # pycolmap would answer SIGTERM with a stack trace.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        app()
    except VislocError as error:
        for note in getattr(error, "__notes__", ()):
            ERR.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)
        _fail(error.code, str(error))
    except OSError as error:  # a full disk, a folder without permission
        _fail("system", str(error))


def _fail(code: str, message: str) -> NoReturn:
    line = " ".join(message.splitlines())
    ERR.print(f"error [{code}] {line}", markup=False, highlight=False, soft_wrap=True)
    sys.exit(1)


if __name__ == "__main__":
    main()
