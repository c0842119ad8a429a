"""Our refinement of poses beside PoseLib's, from the same starts (docs/decisions/0047).

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.refinement MAPS_DIR DATA_DIR

DATA_DIR holds the datasets with the maps' names. Matches each query once, then searches with each
of five seeds and refines what was found in three ways. Prints a table in Markdown.

- ours: ``visloc.pose.refinement``
- PoseLib, then ours: PoseLib's refinement on the inliers of the start, ours from what it found
- PoseLib: again and again, on the inliers of the pose before, until they stay the same
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import poselib
import typer

from benchmarks.speed.tables import table
from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.pose.covariance import pose_covariance
from visloc.pose.refinement import LOSS_SCALE_PX, RefinedPose, refine
from visloc.pose.reprojection import MatchedView, reprojection_errors
from visloc.pose.search import search_with_pycolmap

_MAX_ERROR_PX = 12.0  # of the default preset
_SEEDS = range(5)
_MOST_ROUNDS = 6
# Smaller tolerances take three times as long and end a thousandth of a standard deviation nearer.
_POSELIB = {
    "loss_type": "CAUCHY",
    "loss_scale": LOSS_SCALE_PX,
    "max_iterations": 100,
    "gradient_tol": 1e-4,
    "step_tol": 1e-4,
}
# Map, and whether the photos of an instant are taken together.
_CASES = (
    *(("redkitchen", False), ("castle", False)),
    *(("kitti_curve", False), ("kitti_curve", True), ("gardenspoint", False)),
)

Way = Callable[[Sequence[MatchedView], Pose], RefinedPose | None]


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """The matches of one instant, relative to the map's origin, and the rig's true pose."""

    views: list[MatchedView]
    truth: Pose


def main(
    maps_dir: Path,
    data_dir: Path,
    weights_dir: Annotated[Path | None, typer.Option(help="folder of network weights")] = None,
) -> None:
    """Measure and print."""
    rows: list[list[str]] = []
    for map_id, with_rig in _CASES:
        instants = list(matched_photos(maps_dir, data_dir / map_id / "query", map_id, weights_dir))
        if with_rig:
            instants = list(of_rig(data_dir / map_id / "query", instants))
        name = f"{map_id}, a rig" if with_rig else map_id
        rows += _compared(name, [instant for _, instant in instants])
    head = ["queries", "refined by", "processor ms", "median cm", "median deg", "moved, std"]
    typer.echo("\n".join(table(head, rows)))


def matched_photos(
    maps_dir: Path, query: Path, map_id: str, weights_dir: Path | None
) -> Iterator[tuple[tuple[int, str], Instant]]:
    """Yield the matches of each photo with its time and its camera."""
    opened = MapStore(maps_dir).open(map_id)
    name = opened.manifest.local_features.fingerprint.name
    localizer = Localizer(opened, make_local_features(name, weights_dir))
    dataset, origin = read_dataset(query), localizer.geometry.origin
    for record in dataset.images:
        camera, truth = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        photo = read_photo_file(dataset.path_of(record))
        look = localizer.look(photo, camera, LocalizeOptions())
        if truth is None or len(look.matches.pixels) == 0:
            continue
        matches = look.matches
        view = MatchedView(look.camera, Pose.identity(), matches.pixels, matches.points)
        local = Pose(truth.rotation, truth.translation + truth.rotation @ origin)
        yield (record.timestamp, record.sensor_id), Instant([view], local)


def of_rig(
    query: Path, photos: Sequence[tuple[tuple[int, str], Instant]]
) -> Iterator[tuple[tuple[int, str], Instant]]:
    """Yield the instants of the dataset's only rig."""
    (rig,) = read_dataset(query).rigs.values()
    by_time = defaultdict(list)
    for (timestamp, sensor), photo in photos:
        cam_from_rig = rig[sensor]
        assert cam_from_rig is not None
        view = photo.views[0]
        seen = MatchedView(view.camera, cam_from_rig, view.pixels, view.points)
        by_time[timestamp].append((seen, cam_from_rig.inverse() @ photo.truth))
    for timestamp, seen_by in by_time.items():
        yield (timestamp, ""), Instant([view for view, _ in seen_by], seen_by[0][1])


def _compared(name: str, instants: Sequence[Instant]) -> Iterator[list[str]]:
    seconds: dict[str, float] = defaultdict(float)
    errors: dict[str, list[tuple[float, float]]] = defaultdict(list)
    moved: dict[str, list[float]] = defaultdict(list)
    count = 0
    for seed in _SEEDS:
        for instant in instants:
            found = search_with_pycolmap(instant.views, max_error_px=_MAX_ERROR_PX, seed=seed)
            ours = _ours(instant.views, found[0]) if found else None
            if ours is None:
                continue
            count += 1
            for way, refined in _WAYS.items():
                began = time.process_time()
                pose = refined(instant.views, found[0])
                seconds[way] += time.process_time() - began
                if pose is None:
                    errors[way].append((np.inf, np.inf))
                    continue
                errors[way].append(pose_error(pose.rig_from_world, instant.truth))
                moved[way].append(_moved(instant.views, ours, pose))
    for way in _WAYS:
        metres, degrees = np.median(errors[way], axis=0)
        yield [
            *(name, way, f"{seconds[way] / count * 1e3:.1f}"),
            *(f"{metres * 100:.3f}", f"{degrees:.4f}", f"{np.percentile(moved[way], 90):.3f}"),
        ]


def _moved(views: Sequence[MatchedView], ours: RefinedPose, pose: RefinedPose) -> float:
    """How far another pose lies from ours, in standard deviations of the position."""
    kept = [view.selected(mask) for view, mask in zip(views, ours.inliers, strict=True)]
    covariance = pose_covariance(kept, ours.rig_from_world, LOSS_SCALE_PX)
    if covariance is None:
        return 0.0
    far = float(np.linalg.norm(pose.rig_from_world.center - ours.rig_from_world.center))
    return far / float(np.sqrt(np.trace(covariance.whole[3:, 3:])))


def _ours(views: Sequence[MatchedView], start: Pose) -> RefinedPose | None:
    return refine(views, start, max_error_px=_MAX_ERROR_PX)


def _poselib_then_ours(views: Sequence[MatchedView], start: Pose) -> RefinedPose | None:
    return _ours(views, _poselib_once(views, start)[0])


def _poselib_alone(views: Sequence[MatchedView], start: Pose) -> RefinedPose | None:
    pose, inliers = _poselib_once(views, start)
    for _ in range(_MOST_ROUNDS):
        pose, now = _poselib_once(views, pose)
        if all((a == b).all() for a, b in zip(inliers, now, strict=True)):
            break
        inliers = now
    return RefinedPose(pose, 1.0, tuple(inliers), loss=np.nan, mean_loss=np.nan)


def _poselib_once(
    views: Sequence[MatchedView], start: Pose
) -> tuple[Pose, list[np.ndarray[tuple[int], np.dtype[np.bool_]]]]:
    """Return PoseLib's pose from the inliers of a start, and these."""
    inliers = [np.asarray(reprojection_errors(v, start) <= _MAX_ERROR_PX) for v in views]
    kept = [view.selected(mask) for view, mask in zip(views, inliers, strict=True)]
    if len(kept) == 1:
        found, _ = poselib.refine_absolute_pose(
            kept[0].pixels, kept[0].points, _made(start), _camera(kept[0]), _POSELIB
        )
    else:
        found, _ = poselib.refine_generalized_absolute_pose(
            [view.pixels for view in kept],
            [view.points for view in kept],
            _made(start),
            [_made(view.cam_from_rig) for view in kept],
            [_camera(view) for view in kept],
            _POSELIB,
        )
    matrix = np.array(found.Rt, dtype=np.float64)
    return Pose(matrix[:, :3], matrix[:, 3]), inliers


def _made(pose: Pose) -> poselib.CameraPose:
    made = poselib.CameraPose()
    made.R, made.t = pose.rotation, pose.translation
    return made


def _camera(view: MatchedView) -> dict[str, object]:
    camera = view.camera
    size = {"width": camera.width, "height": camera.height}
    return {"model": camera.model, **size, "params": list(camera.params)}


_WAYS: dict[str, Way] = {
    "ours": _ours,
    "PoseLib, then ours": _poselib_then_ours,
    "PoseLib": _poselib_alone,
}


if __name__ == "__main__":
    typer.run(main)
