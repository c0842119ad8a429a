"""Commands about data sets, and features of ours and of others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapping.cli.display import ERR, say, say_notes
from mapping.cli.progress import StageProgress
from mapping.cluster.storage import map_folder
from mapping.options import (
    DatasetArgument,
    InferenceOption,
    LocalFeaturesOption,
    MapsDirOption,
    MaxKeypointsOption,
    WeightsDirOption,
)
from visloc.archive import open_map
from visloc.features import DEFAULT_LOCAL_FEATURES
from visloc.options import Inference
from visloc_extensions.research.datasets import READERS, write_parts
from visloc_extensions.research.export_features import export_features
from visloc_extensions.research.hloc import import_features


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
