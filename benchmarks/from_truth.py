"""Does a query's true pose fit what maps of different local features see from it?

    python -m benchmarks.from_truth QUERIES --maps-dir MAPS --map NAME... [--photo NAME...]

Refines the pose of each query from its truth on the matches of each map, and prints how far it
moves in the camera's axes. Where features that have nothing in common move it by the same, the
truth is off, or the map's photos beside it are; not the features.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.speed.tables import table
from visloc.archive import MapStore
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc.localization.acceptance.gates import registration_for
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.pose.generalized import refine_generalized_pose
from visloc.pose.motion import moved_origin
from visloc.pose.reprojection import MatchedView

OPTIONS = LocalizeOptions()


def main(
    queries: Annotated[Path, typer.Argument(help="A kapture dataset with poses.")],
    maps_dir: Annotated[Path, typer.Option(help="A store of maps.")],
    maps: Annotated[list[str], typer.Option("--map", help="Maps with metres as unit.")],
    photos: Annotated[list[str] | None, typer.Option("--photo", help="All if left out.")] = None,
    weights_dir: Annotated[Path | None, typer.Option(help="Folder of network weights.")] = None,
) -> None:
    """Measure and print."""
    dataset, store = read_dataset(queries), MapStore(maps_dir)
    rows = []
    for name in maps:
        opened = store.open(name)
        kind = opened.manifest.local_features.fingerprint.name
        localizer = Localizer(opened, make_local_features(kind, weights_dir))
        for record in dataset.images:
            if photos and record.path not in photos:
                continue
            camera = dataset.sensors[record.sensor_id].camera
            look = localizer.look(read_photo_file(dataset.path_of(record)), camera, OPTIONS)
            known = dataset.pose(record)
            if known is None:
                raise typer.BadParameter(f"{record.path}: no pose in {queries}")
            truth = moved_origin(known, -localizer.geometry.origin)
            view = MatchedView(
                look.camera, Pose.identity(), look.matches.pixels, look.matches.points
            )
            threshold = registration_for(OPTIONS, [look.camera]).max_error_px
            found = refine_generalized_pose([view], truth, max_error_px=threshold)
            if found is not None:
                moved = truth.rotation @ (found.rig_from_world.center - truth.center)
                cm = [f"{100 * value:.1f}" for value in moved]
                rows.append([record.path, name, kind, str(found.num_inliers), *cm])
    heads = ["photo", "map", "features", "inliers", "right, cm", "down, cm", "ahead, cm"]
    typer.echo("\n".join(table(heads, sorted(rows))))


if __name__ == "__main__":
    typer.run(main)
