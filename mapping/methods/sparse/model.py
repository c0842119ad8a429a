"""Sparse models: points with their observations, in photos with poses; and thresholds for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapping.methods.sparse.intrinsics import Doubt
from mapping.stages.landmarks import Observations, View, reprojection_errors, triangulation_angles
from visloc.errors import refuse
from visloc.geometry import Camera, Pose


@dataclass(frozen=True, slots=True)
class MapperConfig:
    """Thresholds of a mapper run.

    Attributes:
        min_num_matches: fewest verified matches of a pair.
        init_min_num_inliers: fewest inliers of the first pair, when poses are estimated.
        abs_pose_min_num_inliers: fewest inliers of a photo that joins, when poses are estimated.
        abs_pose_min_inlier_ratio: least share of inliers of a photo that joins.
        ba_local_max_num_iterations: for bundle adjustment around a photo that joined.
        abs_pose_max_error: largest error of an inlier of a photo that joins, pixels.
        filter_max_reproj_error: pixels; observations further from their point are dropped, and
            matches further from their epipolar line.
        min_track_length: photos that must see a landmark. Not in the paper. COLMAP drops tracks
            of two photos; with known poses that have verified the match they are worth keeping
            (docs/decisions/0008-two-photos-make-a-landmark.md).
        min_angle_deg: between two rays to a landmark; COLMAP's default.
    """

    min_num_matches: int
    init_min_num_inliers: int
    abs_pose_min_num_inliers: int
    abs_pose_min_inlier_ratio: float
    ba_local_max_num_iterations: int
    abs_pose_max_error: float
    filter_max_reproj_error: float
    min_track_length: int
    min_angle_deg: float


# Table 2 of Humenberger et al. 2020.
MAPPER_CONFIGS: Mapping[str, MapperConfig] = {
    "config1": MapperConfig(15, 100, 30, 0.25, 25, 12.0, 4.0, 2, 1.5),
    "config2": MapperConfig(4, 4, 4, 0.05, 50, 20.0, 12.0, 2, 1.5),
}


@dataclass(frozen=True, slots=True, eq=False)
class SfmPhoto:
    """The mapper's view of a photo.

    Attributes:
        timestamp: photos of a rig with equal timestamps were taken together.
        camera: intrinsics, equal for all photos of the sensor.
        camera_known: whether they are more than a guess.
        keypoints: (n, 2) float32.
    """

    name: str
    sensor: str
    timestamp: int
    camera: Camera
    camera_known: bool
    cam_from_world: Pose | None
    keypoints: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class SparseModel:
    """Points with their observations, in photos with poses.

    Attributes:
        views: of each photo that was given; None for those without a pose.
        points: (P, 3) float64.
        observations: of the points; ``views`` are rows of the photos.
        angles_deg: (P,) largest angle between two rays.
        on_rigs: whether known rigs held cameras together; the model then has their unit.
        doubts: by sensor, why refined intrinsics are not believed. Known intrinsics in doubt stayed
            as they were. Photos whose estimated camera is implausible were left out.
        undone: pairs of photos whose matches were not used, as models with them showed two places
            in one.
    """

    views: tuple[View | None, ...]
    points: NDArray[np.float64]
    observations: Observations
    angles_deg: NDArray[np.float32]
    on_rigs: bool
    doubts: Mapping[str, Doubt]
    undone: int = 0


# Stands in for a photo without a pose, which observes nothing.
_NOWHERE = View(Camera("SIMPLE_PINHOLE", 1, 1, (1.0, 0.5, 0.5)), Pose.identity())


def without_bad_points(model: SparseModel, config: MapperConfig) -> SparseModel:
    """Drop the points that miss a threshold."""
    views = [view or _NOWHERE for view in model.views]
    observations = model.observations
    errors = reprojection_errors(views, model.points, observations)
    observations = _once_per_view(observations, errors, config.filter_max_reproj_error)
    angles = triangulation_angles(views, model.points, observations)
    lengths = np.bincount(observations.points, minlength=len(model.points))
    good = (lengths >= config.min_track_length) & (angles >= config.min_angle_deg)
    if not good.any():
        raise refuse(
            "sfm.no_points",
            field="dataset",
            expected=f"points seen by {config.min_track_length} photos and more, from directions "
            f"{config.min_angle_deg} degrees apart; see --pairs and --mapper",
            got=f"{len(model.points)} points, none of them good enough",
        )
    number = np.cumsum(good) - 1
    observations = observations.take(good[observations.points])
    return replace(
        model,
        points=model.points[good],
        observations=replace(observations, points=number[observations.points]),
        angles_deg=angles[good],
    )


def _once_per_view(
    observations: Observations, errors: NDArray[np.float64], max_error: float
) -> Observations:
    """Return the observations within the error; of each point in each photo the best one."""
    order = np.lexsort((errors, observations.views, observations.points))
    order = order[errors[order] <= max_error]
    best = np.ones(len(order), dtype=bool)
    best[1:] = (np.diff(observations.points[order]) != 0) | (
        np.diff(observations.views[order]) != 0
    )
    return observations.take(order[best])
