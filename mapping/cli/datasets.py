"""Commands about datasets: pairs, features of ours and of others, the sample."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapping.cli.build import CovisibleInOption
from mapping.cli.display import ERR, say, say_notes, say_peak_memory
from mapping.cli.progress import StageProgress
from mapping.cluster.stage_timings import spent_here
from mapping.cluster.storage import map_folder
from mapping.datasets import READERS, write_parts
from mapping.importers.hloc import import_features
from mapping.maps.export_features import export_features
from mapping.options import (
    DatasetArgument,
    InferenceOption,
    LocalFeaturesOption,
    MapsDirOption,
    MaxKeypointsOption,
    WeightsDirOption,
)
from mapping.pipeline.pairs import PairsJob, write_pairs_of_dataset
from mapping.sample import write_sample
from visloc.archive import open_map
from visloc.errors import refuse
from visloc.features import DEFAULT_LOCAL_FEATURES
from visloc.options import Inference


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


def export_features_command(
    dataset: DatasetArgument,
    output: Annotated[Path, typer.Option("--output", help="Folder of the new kapture.")],
    local_features: LocalFeaturesOption = DEFAULT_LOCAL_FEATURES,
    weights_dir: WeightsDirOption = None,
    inference: InferenceOption = Inference.AUTO,
    max_keypoints: MaxKeypointsOption = 5000,
    map_ref: Annotated[
        str | None,
        typer.Option("--map", help="Also export global descriptors by the models of this map."),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Extract features of a dataset into kapture's layout, for other tools."""
    opened = None if map_ref is None else open_map(map_folder(map_ref, maps_dir))
    with StageProgress(ERR) as progress:
        absent = export_features(
            dataset,
            output,
            local_features=local_features,
            weights_dir=weights_dir,
            inference=inference,
            max_keypoints=max_keypoints,
            global_from=opened,
            progress=progress,
        )
    for name in absent:
        ERR.print(f"absent, without features: {name}", markup=False, soft_wrap=True)
    say(f"kapture with features: {output}")


def dataset(
    name: Annotated[str, typer.Argument(metavar="SET", help=f"One of {', '.join(READERS)}.")],
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="The unpacked archive, of one scene.")
    ],
    output: Annotated[
        Path, typer.Option("--output", help="Folder to make, with mapping/ and query/.")
    ],
) -> None:
    """Make mapping and query datasets of a public data set, by its own split.

    Photos are links to the archive, which must stay where it is. There is no reader of InLoc: no
    public source tells how the pose of a cut-out follows from that of its scan. kapture's copy of
    it needs no reader.
    """
    for part, made in write_parts(name, folder, output).items():
        say(f"{len(made.images)} photos: {output / part}")
        say_notes(made.notes)


def import_features_command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE.h5...", help="features.h5, global features and matches.h5 of hloc."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", help="Folder for --features-dir of a build.")],
    type_name: Annotated[
        str, typer.Option("--type", metavar="NAME", help="Name of the features: kapture:NAME.")
    ] = "hloc",
) -> None:
    """Write features and matches of hloc in kapture's layout, for build and localize batch."""
    written, notes = import_features(files, output, type_name)
    local, of_whole, pairs = (written.get(kind, 0) for kind in ("local", "global", "pairs"))
    say(
        f"{local} photos with local features, {of_whole} with global ones, "
        f"{pairs} pairs with matches: {output}"
    )
    say_notes(notes)
    if pairs:
        say(f"next: --matches-dir {output / 'reconstruction' / 'matches' / type_name}")


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
