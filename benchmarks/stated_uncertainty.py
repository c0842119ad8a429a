"""How often the truth lies inside the stated uncertainty of the position.

    python -m benchmarks.stated_uncertainty MAPS_DIR MAP QUERIES [--weights-dir DIR]

QUERIES is a kapture dataset with poses in the frame of the map. Every photo is localized in process
with its camera. Prints the median of the position error over the stated standard deviation (the
norm of ``position_std``), and the share of true positions inside the stated 95 % ellipsoid, for the
whole uncertainty and for the photo's part of it.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import typer

from visloc.archive import MapStore
from visloc.evaluation import calibration
from visloc.features import make_global_descriptor, make_local_features
from visloc.images import read_photo_file
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.types import Localized


def main(maps_dir: Path, map_ref: str, queries: Path, weights_dir: Path | None = None) -> None:
    """Compare errors with stated deviations."""
    opened = MapStore(maps_dir).open(map_ref)
    name = opened.manifest.local_features.fingerprint.name
    localizer = Localizer(
        opened,
        make_local_features(name, weights_dir),
        partial(make_global_descriptor, weights_dir=weights_dir),
    )
    dataset = read_dataset(queries)
    whole, of_photo = [], []
    for record in dataset.images:
        truth = dataset.pose(record)
        photo = read_photo_file(dataset.path_of(record))
        camera = dataset.sensors[record.sensor_id].camera
        answer = localizer.localize(photo, camera, LocalizeOptions())
        if truth is None or not isinstance(answer, Localized):
            continue
        whole.append((answer.cam_from_world, answer.covariance, truth))
        of_photo.append((answer.cam_from_world, answer.photo_covariance, truth))
    typer.echo(f"{len(whole)} of {len(dataset.images)} localized with a known pose")
    for name, poses in (("whole", whole), ("photo only", of_photo)):
        held = calibration(poses)
        if held is not None:
            typer.echo(
                f"{name}: error over stated deviation {held.median_ratio:.2f} in the median, "
                f"{held.inside_95:.1%} inside the 95 % ellipsoid"
            )


if __name__ == "__main__":
    typer.run(main)
