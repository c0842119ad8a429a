"""Commands about datasets: pairs, rigs, the sample."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapping.cli.build import CovisibleInOption
from mapping.cli.display import ERR, print_rig, say, say_notes, say_peak_memory
from mapping.cli.progress import StageProgress
from mapping.cluster.stage_timings import spent_here
from mapping.cluster.storage import map_folder
from mapping.frames.rig_calibration import calibrate_rig, refuse_known_rigs, write_calibration
from mapping.options import (
    DatasetArgument,
    MapsDirOption,
    names_in,
)
from mapping.pipeline.pairs import PairsJob, write_pairs_of_dataset
from mapping.sample import write_sample
from visloc.archive import open_map
from visloc.errors import refuse
from visloc.kapture import read_dataset


def pairs(
    job: PairsJob,
    covisible_in: CovisibleInOption = None,
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Pair the photos of a dataset without building, for build --pairs-file or other tools.

    Pairing by extracted global features needs a build; pairs.txt of its map has the pairs.
    """
    known = None if covisible_in is None else open_map(map_folder(covisible_in, maps_dir))
    with StageProgress(ERR, if_stopped="nothing was written") as progress:
        count, notes = write_pairs_of_dataset(job, known, progress)
    say(f"{count} pairs: {job.output}")
    say_notes(notes)
    say_peak_memory(spent_here())


def calibrate_rig_command(
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
    print_rig(calibration)
    say(f"rig: {target}")


def sample(
    output: Annotated[Path, typer.Argument(help="Folder to make, with mapping/ and query/.")],
    images: Annotated[int, typer.Option(help="Number of mapping photos.")] = 60,
    seed: Annotated[int, typer.Option(help="Seed of the pictures in the room.")] = 0,
    size: Annotated[str, typer.Option(help="Size of a photo, WxH pixels.")] = "640x480",
) -> None:
    """Make a small synthetic dataset with exact poses."""
    with StageProgress(ERR, if_stopped="nothing was left behind") as progress:
        write_sample(
            output,
            images=images,
            seed=seed,
            size=_parse_size(size),
            progress=lambda done, total: progress("photos", done, total),
        )
    say(f"sample dataset: {output}/mapping and {output}/query")


def _parse_size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise refuse("sample.size", field="--size", got=text)
    return int(width), int(height)
