"""The command ``mapping calibrate-rig``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from mapping.cli.display import OUT, say, say_notes
from mapping.options import DatasetArgument, names_in
from visloc.kapture import read_dataset
from visloc_extensions.rig_calibration.calibration import (
    OUTLIER_MULTIPLE,
    RigCalibration,
    Spread,
    calibrate_rig,
    refuse_known_rigs,
    write_calibration,
)


def calibrate(
    dataset: DatasetArgument,
    rig: Annotated[str, typer.Option("--rig", metavar="ID", help="Id of the rig.")] = "rig",
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="SENSOR",
            help="Camera whose frame is the rig's frame. Default: the camera that shares most "
            "timestamps with the others.",
        ),
    ] = None,
    cameras: Annotated[
        str | None,
        typer.Option(help="Comma-separated cameras of the rig. Default: all of the dataset."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", help="File to write. Default: rigs.txt of the dataset."),
    ] = None,
) -> None:
    """Estimate the poses of cameras on a rig, from poses of photos with equal timestamps.

    The file is kapture's rigs.txt; maps built from the dataset then contain the rig.
    """
    target = dataset / "sensors" / "rigs.txt" if output is None else output
    refuse_known_rigs(target)
    calibration = calibrate_rig(
        read_dataset(dataset),
        rig=rig,
        reference=reference,
        cameras=None if cameras is None else names_in(cameras),
    )
    write_calibration(calibration, target)
    _print_rig(calibration)
    say(f"rig: {target}")


def _print_rig(calibration: RigCalibration) -> None:
    """Print where the cameras of a rig are, and how well their instants agree."""
    table = Table(
        box=None,
        title=f"rig {escape(calibration.rig)}, its frame is camera {escape(calibration.reference)}",
        title_justify="left",
    )
    for name in ("camera", "through", "instants", "outliers", "degrees", "units", "position"):
        table.add_column(name, justify="right" if name in ("instants", "outliers") else "left")
    for name, camera in calibration.cameras.items():
        position = " ".join(_figure(value) for value in camera.cam_from_rig.center)
        if camera.relative is None or camera.relative_to is None:
            table.add_row(escape(name), "", "", "", "", "", position)
            continue
        found = camera.relative
        table.add_row(
            *(escape(name), escape(camera.relative_to), str(found.instants), str(found.outliers)),
            *(_deviation(found.rotation_deg), _deviation(found.position), position),
        )
    OUT.print(table)
    say(
        "degrees, units: deviation of the instants from the estimate, median / 90 %; "
        f"outliers: instants {OUTLIER_MULTIPLE:g} times further off than the median"
    )
    say_notes(calibration.notes)


def _deviation(spread: Spread) -> str:
    return f"{_figure(spread.median)} / {_figure(spread.p90)}"


def _figure(value: float) -> str:
    """Return four digits, and 0 for round-off."""
    return f"{value:.4g}" if abs(value) > 1e-9 else "0"
