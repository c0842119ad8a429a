"""Options of all commands that ask a server."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

DEFAULT_SERVER = "http://127.0.0.1:8000"
KEY_VARIABLE = "VISLOC_API_KEY"

Server = Annotated[
    str,
    typer.Option(
        "--server",
        metavar="URL",
        help="http://host:port or grpc://host:port; with TLS https:// or grpcs://.",
    ),
]
ApiKeyFile = Annotated[
    Path | None,
    typer.Option(
        "--api-key-file",
        metavar="FILE",
        help=f"File with the API key; without it, {KEY_VARIABLE} in the environment.",
    ),
]
Ca = Annotated[
    Path | None,
    typer.Option(
        "--ca", metavar="FILE", help="Certificate authorities (PEM) to trust, not the usual ones."
    ),
]
TimeoutS = Annotated[
    float, typer.Option("--timeout", min=0.001, help="Longest wait for an answer, seconds.")
]


def api_key_of(file: Path | None) -> str | None:
    """Return the API key of a file or the environment, None where neither is given.

    Not an option of its own: the arguments of a command can be seen by everybody on the machine.

    Raises:
        OSError: when the file cannot be read.
    """
    if file is not None:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    return os.environ.get(KEY_VARIABLE) or None
