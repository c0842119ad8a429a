"""The command ``mapping export-graph``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapping.cli.display import say


def export_graph(
    feature: Annotated[
        str, typer.Argument(help="One of convvlad, faster2d2, gem, r2d2, xfeat.", metavar="FEATURE")
    ],
    weights_dir: Annotated[
        Path,
        typer.Option(
            "--weights-dir",
            envvar="VISLOC_WEIGHTS_DIR",
            help="Folder of network weights, to which the graph is added.",
        ),
    ],
) -> None:
    """Write the graph with which OpenVINO computes a network with weights of your own.

    Without it, torch computes the network. Once per file of weights.
    """
    from visloc_extensions.graphs import export  # torch takes a second to load

    say(f"graph: {export.export_graph(feature, weights_dir)}")
