"""How far a map of ready-made features, and its figures, move by chance and by matching in 8 bits.

    python -m benchmarks.ready_made_rounding virtual_gallery

Builds the map of docs/results.md again and again, each time without another 2 % of the features,
with photos matched in 8 bits, as builds do, and as floats. Localizes the queries in this process.
Prints a table in Markdown: of the median errors over the queries, mean, standard deviation and
range over the draws, and by how much 8 bits are worse in the same draw.
"""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated
from unittest.mock import patch

import numpy as np
import typer
from numpy.typing import NDArray

import mapping.methods.matching.stages
from clients.evaluation.queries import read_queries
from clients.evaluation.readers import FeatureReader
from mapping.methods.sfm_settings import SfmSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.stages.local_features import ReadyMadeFeatures
from mapping.stages.photos import MappingPhoto
from visloc.archive import Map, open_map
from visloc.evaluation import pose_error
from visloc.geometry import PixelOrigin
from visloc.kapture import open_features, open_local_features
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.types import LocalFeatures, Localized, QueryFeatures

LOCAL, GLOBAL = "r2d2_500", "AP-GeM-LM18"
KEPT = 0.98


def main(
    dataset: Annotated[Path, typer.Argument(help="The virtual gallery.")], draws: int = 24
) -> None:
    """Build, localize, print."""
    errors: dict[str, list[NDArray[np.float64]]] = {"8 bits": [], "floats": []}
    for draw in range(draws):
        for name, found in errors.items():
            with thinned(draw), tempfile.TemporaryDirectory() as maps:
                if name == "floats":
                    with matched_as_floats():
                        opened = build(dataset, Path(maps))
                else:
                    opened = build(dataset, Path(maps))
                found.append(median_error(opened, dataset))
    typer.echo("| photos matched in | position, mean | deviation | range | orientation, mean |")
    typer.echo("|---|---|---|---|---|")
    for name, found in errors.items():
        (cm, deg), spread = np.mean(found, axis=0), np.std(found, axis=0)[0]
        low, high = np.min(found, axis=0)[0], np.max(found, axis=0)[0]
        typer.echo(
            f"| {name} | {cm:.2f} cm | {spread:.2f} | {low:.2f} to {high:.2f} | {deg:.3f} deg |"
        )
    worse = np.subtract(errors["8 bits"], errors["floats"])[:, 0]
    of_mean = worse.std(ddof=1) / np.sqrt(len(worse))
    typer.echo(f"\n8 bits are {worse.mean():.2f} cm worse, give or take {of_mean:.2f}")


@contextmanager
def thinned(draw: int) -> Iterator[None]:
    """Leave out some features of every mapping photo."""
    whole = ReadyMadeFeatures.read

    def read(self: ReadyMadeFeatures, photo: MappingPhoto) -> LocalFeatures:
        local = whole(self, photo)
        random = np.random.default_rng([draw, zlib.crc32(photo.name.encode())])
        kept = random.random(len(local)) < KEPT
        return LocalFeatures(
            local.keypoints[kept], local.descriptors[kept], local.scores[kept], local.scales[kept]
        )

    with patch.object(ReadyMadeFeatures, "read", read):
        yield


@contextmanager
def matched_as_floats() -> Iterator[None]:
    """Match mapping photos without rounding their descriptors."""

    def nearest(
        a: NDArray[np.float32], b: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
        similarity = a @ b.T
        best = similarity.argmax(axis=1)
        mutual = np.flatnonzero(similarity.argmax(axis=0)[best] == np.arange(len(a)))
        return mutual, best[mutual], similarity[mutual, best[mutual]]

    with (
        patch.object(
            mapping.methods.matching.stages, "round_descriptors", lambda descriptors: descriptors
        ),
        patch.object(mapping.methods.matching.stages, "mutual_nearest_neighbours", nearest),
    ):
        yield


def build(dataset: Path, maps_dir: Path) -> Map:
    """Build the map in this process."""
    settings = BuildSettings(
        dataset=dataset / "mapping",
        map_id="gallery",
        maps_dir=maps_dir,
        method="sfm",
        local_features=f"kapture:{LOCAL}",
        global_features=(f"kapture:{GLOBAL}",),
        features_dir=dataset,
        pixel_origin=PixelOrigin.CENTER,
        sfm=SfmSettings(pairs=("distance",)),
    )
    return open_map(build_map(settings, lambda *_: None))


def median_error(opened: Map, dataset: Path) -> NDArray[np.float64]:
    """Return the median errors over the queries: centimetres, degrees."""
    source = dataset / "query"
    described = {f"kapture:{GLOBAL}": open_features(source, "global_features", GLOBAL, dataset)}
    files = open_local_features(source, LOCAL, dataset)
    read = FeatureReader(f"kapture:{LOCAL}", *files, described, PixelOrigin.CENTER)
    localizer = Localizer(opened, None)
    errors = []
    for query in read_queries(source, PixelOrigin.CENTER).photos:
        sent = read(query)
        features = QueryFeatures(
            sent.kind,
            np.asarray(sent.keypoints),
            np.asarray(sent.descriptors),
            {name: np.asarray(row) for name, row in sent.global_descriptors.items()},
        )
        assert query.camera is not None
        answer = localizer.localize_features(features, query.camera, LocalizeOptions())
        if isinstance(answer, Localized) and query.truth is not None:
            errors.append(pose_error(answer.cam_from_world, query.truth))
    return np.asarray(np.median(errors, axis=0) * (100.0, 1.0))


if __name__ == "__main__":
    typer.run(main)
