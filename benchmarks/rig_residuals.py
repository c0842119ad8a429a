"""Do a rig's cameras agree with its map? (docs/decisions/0020).

    python -m benchmarks.rig_residuals MAPS_DIR MAP DATASET [--weights-dir WEIGHTS]

DATASET holds queries of one rig with true poses. Prints where the estimated poses lie, in the rig's
own frame, and how far landmarks fall from their keypoints under the true poses, by camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.refinement import matched_photos, of_rig
from benchmarks.speed.tables import table
from visloc.options import Solver
from visloc.pose.generalized import estimate_generalized_pose
from visloc.pose.reprojection import project

_MAX_ERROR_PX = 12.0  # of the default preset
_NEAR_PX = 4.0  # landmarks farther off are wrong matches


def main(
    maps_dir: Path,
    map_id: str,
    dataset: Path,
    weights_dir: Annotated[Path | None, typer.Option(help="folder of network weights")] = None,
) -> None:
    """Measure and print."""
    instants = [
        instant
        for _, instant in of_rig(
            dataset, list(matched_photos(maps_dir, dataset, map_id, weights_dir))
        )
    ]
    offsets, residuals = [], []
    for instant in instants:
        found = estimate_generalized_pose(
            instant.views, max_error_px=_MAX_ERROR_PX, seed=0, solver=Solver.PYCOLMAP
        )
        if found is not None:
            offsets.append(instant.truth.apply(found.rig_from_world.center))
        of_cameras = []
        for view in instant.views:
            seen = (view.cam_from_rig @ instant.truth).apply(view.points)
            errors = project(view.camera, seen) - view.pixels
            of_cameras.append(np.median(errors[np.hypot(*errors.T) < _NEAR_PX], axis=0))
        residuals.append(of_cameras)
    rows = [["poses, cm (x, y, z)", _text(100 * np.mean(offsets, axis=0))]]
    rows += [
        [f"camera {camera}, px (x, y)", _text(mean)]
        for camera, mean in enumerate(np.mean(residuals, axis=0), start=1)
    ]
    typer.echo("\n".join(table(["mean offset of", ""], rows)))


def _text(values: np.ndarray) -> str:
    return ", ".join(f"{value:+.2f}" for value in values)


if __name__ == "__main__":
    typer.run(main)
