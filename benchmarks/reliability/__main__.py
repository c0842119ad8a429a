"""What the service must withstand, one command for each kind of harm (docs/reliability.md).

    python -m benchmarks.reliability soak --seconds 900

Starts the service as users do, on free ports of this machine, and prints a table in Markdown.
Exits with 1 when something that must hold does not.
"""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.reliability.checks import print_checks

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__)


@app.command("soak")
def soak_command(
    seconds: Annotated[float, typer.Option(help="How long.")] = 900.0,
) -> None:
    """Twice the load that it can serve, good and bad, while versions are swapped every 20 s."""
    from benchmarks.reliability.soak import soak

    with tempfile.TemporaryDirectory() as work:
        print_checks("soak", asyncio.run(soak(Path(work), seconds)))


if __name__ == "__main__":
    app()
