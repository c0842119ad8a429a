"""``mapping pairs``: a pairs file without a build."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from mapping.methods.scenes import find_pairs, make_scene
from mapping.methods.sfm_settings import PairsOption, SfmSettings
from mapping.options import DatasetArgument, FeaturesDirOption, Names, PixelOriginOption
from mapping.pairing import PAIRINGS, POSED_PAIRINGS, PairSettings, write_pairs
from mapping.pipeline.checks import check_names
from mapping.progress import Progress, one_step
from mapping.stages.global_features import read_global_features
from mapping.stages.outputs import refuse_existing
from mapping.stages.photos import collect_photos
from visloc.archive import Map
from visloc.geometry import PixelOrigin
from visloc.kapture import read_dataset


@dataclass(frozen=True, slots=True)
class PairsJob:
    """The options of ``mapping pairs``."""

    dataset: DatasetArgument
    output: Annotated[Path, typer.Option("--output", help="The pairs file to write.")]
    pairs: PairsOption = ("distance",)
    pairing: PairSettings = field(default_factory=PairSettings)
    global_features: Annotated[
        Names,
        typer.Option(help="retrieval: kapture:TYPE features of the dataset, comma-separated."),
    ] = ()
    features_dir: FeaturesDirOption = None
    pixel_origin: PixelOriginOption = PixelOrigin.CORNER


def write_pairs_of_dataset(
    job: PairsJob, covisible_in: Map | None, progress: Progress
) -> tuple[int, list[str]]:
    """Pair the photos of a dataset and write the pairs file.

    Pairings by pose leave out photos without a pose or a camera, like a build with given poses. The
    other pairings take all photos. The photos themselves need not exist.

    Returns:
        The number of pairs, and notes on the photos that were left out.
    """
    refuse_existing(job.output, "pairs.exists")
    check_names("--pairs", job.pairs, tuple(PAIRINGS))
    dataset = read_dataset(job.dataset).with_pixels_from(job.pixel_origin)
    photos, notes = collect_photos(
        dataset,
        posed=not POSED_PAIRINGS.isdisjoint(job.pairs),
        with_files=False,
        progress=partial(progress, "photos"),
    )
    described = [
        read_global_features(dataset, name, job.features_dir, photos)
        for name in job.global_features
    ]
    settings = SfmSettings(pairs=job.pairs, pairing=job.pairing, covisible_in=covisible_in)
    scene = make_scene(dataset, photos, described, settings)
    with one_step(progress, "pairs"):
        found = find_pairs(scene, settings)
    write_pairs(job.output, scene, found)
    return len(found), notes
