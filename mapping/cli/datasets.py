"""Commands about datasets: pairs, the sample."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapping.cli.build import CovisibleInOption
from mapping.cli.display import ERR, say, say_notes, say_peak_memory
from mapping.cli.progress import StageProgress
from mapping.cluster.stage_timings import spent_here
from mapping.cluster.storage import map_folder
from mapping.options import (
    MapsDirOption,
)
from mapping.pipeline.pairs import PairsJob, write_pairs_of_dataset
from mapping.sample import write_sample
from visloc.archive import open_map
from visloc.errors import refuse


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
