"""How often the truth lies inside the stated uncertainty of the position.

    python -m benchmarks.stated_uncertainty MAPS_DIR MAP QUERIES [--weights-dir DIR]

QUERIES is a kapture dataset with poses in the frame of the map. Every photo is localized in process
with its camera. Prints the median of the position error over the stated standard deviation (the
norm of ``position_std``), and the share of true positions inside the stated 95 % ellipsoid.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import typer
from scipy.stats import chi2

from visloc.archive import MapStore
from visloc.features import make_global_descriptor, make_local_features
from visloc.images import read_photo_file
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.pose.centre import position_covariance
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
    ratios, inside = [], []
    for record in dataset.images:
        truth = dataset.pose(record)
        photo = read_photo_file(dataset.path_of(record))
        camera = dataset.sensors[record.sensor_id].camera
        answer = localizer.localize(photo, camera, LocalizeOptions())
        if truth is None or not isinstance(answer, Localized):
            continue
        error = answer.cam_from_world.center - truth.center
        covariance = position_covariance(answer.cam_from_world, answer.covariance)
        ratios.append(np.linalg.norm(error) / np.linalg.norm(answer.position_std))
        inside.append(error @ np.linalg.solve(covariance, error) <= chi2.ppf(0.95, 3))
    typer.echo(
        f"{len(ratios)} of {len(dataset.images)} localized with a known pose: error over stated "
        f"deviation {np.median(ratios):.1f} in the median, {np.mean(inside):.0%} inside the 95 % "
        "ellipsoid"
    )


if __name__ == "__main__":
    typer.run(main)
