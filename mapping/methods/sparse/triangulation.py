"""Points from verified matches through pycolmap, with known poses or together with them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap

from mapping.methods.matching.stages import Matches, matches_among
from mapping.methods.sparse.adjustment import (
    adjusted_robustly,
    error_rises,
    refine_model,
    rig_length,
)
from mapping.methods.sparse.colmap_scene import ColmapScene, Rigs, colmap_database
from mapping.methods.sparse.incremental import largest_model
from mapping.methods.sparse.intrinsics import (
    Doubt,
    doubt_of,
    is_plausible,
    names_by_sensor,
    no_lens,
)
from mapping.methods.sparse.look_alikes import without_look_alikes
from mapping.methods.sparse.model import MapperConfig, SfmPhoto, SparseModel, without_bad_points
from mapping.methods.sparse.points import triangulate_points
from mapping.methods.sparse.thinning import thin
from mapping.progress import ItemProgress, Progress, not_told
from visloc.errors import VislocError, refuse

# Stages of a build.
LOOK_ALIKES, MAPPING = "look-alike pairs", "incremental mapping"
ADJUSTMENT, TRIANGULATION, READING = "adjustment", "triangulation", "points of the model"
# Least median angle between the rays of the two photos that the mapper begins with. With COLMAP's
# 16 degrees they may be far apart and share few matches, and their errors spread to other photos.
_FIRST_ANGLE_DEG = 4.0
# All photos are adjusted together when the model has grown by this factor. With COLMAP's 1.1, twice
# as many times: poses of castle and of most films of the painted room were as good
# (docs/performance.md#builds).
_GROWTH = 1.25
# Models of few photos are adjusted as often as COLMAP does: nothing beside them holds a photo that
# went astray between two adjustments, and they cost seconds (docs/performance.md#builds).
_FEW_PHOTOS, _GROWTH_OF_FEW = 50, 1.1
# After so many models that put cameras in doubt, no camera with a prior is refined any more.
_MAX_JUDGEMENTS = 3


def triangulate(
    photos: Sequence[SfmPhoto],
    rigs: Rigs,
    matches: Sequence[Matches],
    config: MapperConfig,
    refine: Sequence[str],
    work: Path,
    progress: Progress,
) -> SparseModel:
    """Triangulate points with the poses of the photos.

    Args:
        refine: names of ``REFINABLE``: what bundle adjustment may change afterwards. Refined poses
            are aligned to the given ones again. Intrinsics in doubt (``SparseModel.doubts``) stay.
        progress: of the stages ``TRIANGULATION``, as ``triangulate_points``, ``READING``, in
            points, and where something is refined ``ADJUSTMENT``, in steps of bundle adjustments.
    """
    adjusting = partial(progress, ADJUSTMENT)
    with colmap_database(photos, rigs, matches, work) as (path, scene):
        options = pipeline_options(config)

        def solve(held: Collection[str]) -> pycolmap.Reconstruction:
            model = scene.with_poses(photos)
            triangulate_points(model, path, options, partial(progress, TRIANGULATION))
            if refine:
                refine_model(model, photos, scene, refine, held, adjusting)
            return model

        refined = set(scene.cameras) if "intrinsics" in refine else set()
        result, doubts = solve_with_priors(
            solve, scene, photos, refined, adjusting, poses="poses" in refine
        )
    found = scene.read(result, photos, refine, doubts, partial(progress, READING))
    return without_bad_points(found, config)


def reconstruct(
    photos: Sequence[SfmPhoto],
    rigs: Rigs,
    matches: Sequence[Matches],
    config: MapperConfig,
    refine: Sequence[str],
    work: Path,
    progress: Progress,
    *,
    filtered: bool = True,
) -> SparseModel:
    """Find poses and points by incremental mapping, in an arbitrary frame.

    The unit is that of the rigs, where they hold cameras apart, else arbitrary.

    Known intrinsics stay unless ``refine`` names them, and also if they are in doubt
    (``SparseModel.doubts``). If ``filtered``, pairs that seem to show two places are not used
    (``mapping.methods.sparse.look_alikes``). Of several models that do not connect, the largest is
    taken.
    The stages of ``progress`` are ``LOOK_ALIKES``, in pairs, ``MAPPING`` as ``largest_model``,
    ``ADJUSTMENT`` in steps of bundle adjustments, and those of ``triangulate``.
    """
    if filtered:
        matches = without_look_alikes(photos, matches, partial(progress, LOOK_ALIKES))
    adjusting = partial(progress, ADJUSTMENT)
    with colmap_database(photos, rigs, thin(photos, matches), work) as (path, scene):
        known = {photo.sensor for photo in photos if photo.camera_known}
        constant = set() if "intrinsics" in refine else known

        def options_with(doubts: Mapping[str, Doubt]) -> pycolmap.IncrementalPipelineOptions:
            options = pipeline_options(config)
            options.constant_cameras = {
                scene.camera_ids[sensor] for sensor in constant | (doubts.keys() & known)
            }
            left_out = doubts.keys() - known
            options.image_names = [p.name for p in photos if p.sensor not in left_out]
            growth = _GROWTH_OF_FEW if len(options.image_names) < _FEW_PHOTOS else _GROWTH
            options.ba_global_frames_ratio = options.ba_global_points_ratio = growth
            return options

        def solve(doubts: Mapping[str, Doubt]) -> pycolmap.Reconstruction:
            left_out = doubts.keys() - known
            model = largest_model(path, options_with(doubts), partial(progress, MAPPING))
            if model is None:
                raise _no_model(photos, matches, doubts, left_out)
            return model

        refined = scene.cameras.keys() - constant
        result, doubts = solve_with_priors(solve, scene, photos, refined, adjusting, poses=True)
        sure = {scene.camera_ids[sensor] for sensor in refined - doubts.keys()}
        result = adjusted_robustly(result, sure, adjusting)
        if length := rig_length(scene.rigs):  # the mapper normalizes its model, rigs and all
            unit = length / rig_length(result.rigs.values())
            result.transform(pycolmap.Sim3d(unit, pycolmap.Rotation3d(), np.zeros(3)))
        found = scene.read(result, photos, ("poses", "intrinsics"), doubts)
    return _with_all_points(found, photos, rigs, matches, config, work, progress)


def _no_model(
    photos: Sequence[SfmPhoto],
    matches: Sequence[Matches],
    doubts: Mapping[str, Doubt],
    left_out: Collection[str],
) -> VislocError:
    """Return why there is no model, without the photos of the sensors left out."""
    if left_out:
        names = names_by_sensor((photo.sensor, photo.name) for photo in photos)
        return no_lens({sensor: doubts[sensor] for sensor in left_out}, names)
    return refuse(
        "sfm.no_model",
        "no two photos could be placed relative to each other with their known focal length"
        if doubts
        else None,
        field="dataset",
        expected="photos that overlap; see --pairs and --mapper",
        got=f"{len(photos)} photos, {len(matches)} pairs with verified matches",
    )


def _with_all_points(
    found: SparseModel,
    photos: Sequence[SfmPhoto],
    rigs: Rigs,
    matches: Sequence[Matches],
    config: MapperConfig,
    work: Path,
    progress: Progress,
) -> SparseModel:
    """Triangulate all matches with the poses and cameras that a part of them gave."""
    rows = [row for row, view in enumerate(found.views) if view is not None]
    placed = [
        replace(photos[row], camera=view.camera, cam_from_world=view.cam_from_world)
        for row, view in enumerate(found.views)
        if view is not None
    ]
    among = matches_among(rows, matches)
    # On rigs, if at all, as in the model: they have its unit.
    made = triangulate(placed, rigs if found.on_rigs else {}, among, config, (), work, progress)
    views = np.array(rows)[made.observations.views]
    return replace(
        made,
        views=found.views,
        observations=replace(made.observations, views=views),
        on_rigs=found.on_rigs,
        doubts=found.doubts,
    )


def solve_with_priors(
    solve: Callable[[dict[str, Doubt]], pycolmap.Reconstruction],
    scene: ColmapScene,
    photos: Sequence[SfmPhoto],
    refined: Collection[str],
    progress: ItemProgress = not_told,
    *,
    poses: bool,
) -> tuple[pycolmap.Reconstruction, dict[str, Doubt]]:
    """Solve, and solve again without refining the cameras in doubt.

    After ``_MAX_JUDGEMENTS`` such rounds all sensors with a prior keep it. From then on, each round
    leaves out at least one sensor without a prior. So ``solve`` is called at most
    ``_MAX_JUDGEMENTS`` + 1 times, and once more for each sensor without a prior.

    Args:
        solve: makes a model, given doubts. Sensors in doubt that have a prior keep it; photos of
            the others are left out.
        progress: of judging the cameras, in steps of bundle adjustments.

    Returns:
        The model, and all doubts. Sensors without a prior that are merely undetermined are in both.
    """
    priors = {p.sensor: p.camera.focal_length if p.camera_known else None for p in photos}
    doubts: dict[str, Doubt] = {}
    for judgements in count(1):
        model = solve(doubts)
        free = _free_cameras(model, scene, refined, doubts)
        found = _judge(model, free, priors, progress, poses=poses)
        again = {
            sensor: doubt
            for sensor, doubt in found.items()
            if priors[sensor] is not None or doubt.reason == "implausible"
        }
        if not again:
            break
        doubts |= again
        if judgements == _MAX_JUDGEMENTS:
            focal = {s: float(model.camera(c).mean_focal_length()) for c, s in free.items()}
            # Also those without a photo in this model: they may have one in the next.
            doubts |= {
                sensor: Doubt("unsettled", focal.get(sensor, math.nan))
                for sensor in refined
                if sensor not in doubts and priors[sensor] is not None
            }
    return model, doubts | found


def _free_cameras(
    model: pycolmap.Reconstruction,
    scene: ColmapScene,
    refined: Collection[str],
    doubts: Collection[str],
) -> dict[int, str]:
    """Return the sensors, by camera id, whose intrinsics a model refined."""
    used = {model.image(image_id).camera_id for image_id in model.reg_image_ids()}
    return {
        camera_id: sensor
        for sensor, camera_id in scene.camera_ids.items()
        if sensor in refined and sensor not in doubts and camera_id in used
    }


def _judge(
    model: pycolmap.Reconstruction,
    free: Mapping[int, str],
    priors: Mapping[str, float | None],
    progress: ItemProgress,
    *,
    poses: bool,
) -> dict[str, Doubt]:
    """Return the doubts about refined cameras, by sensor."""
    sound = [camera_id for camera_id in free if is_plausible(model.camera(camera_id))]
    rises = error_rises(model, sound, progress, poses=poses) if sound else {}
    return {
        sensor: doubt
        for camera_id, sensor in free.items()
        if (doubt := doubt_of(model.camera(camera_id), priors[sensor], rises.get(camera_id)))
    }


def pipeline_options(config: MapperConfig) -> pycolmap.IncrementalPipelineOptions:
    """Return pycolmap's options for a mapper run: equal inputs give equal bits."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.num_threads = 1  # sums of several threads differ in the last bits
    options.extract_colors = False
    options.min_num_matches = config.min_num_matches
    options.ba_local_max_num_iterations = config.ba_local_max_num_iterations
    options.ba_refine_principal_point = False
    options.ba_refine_sensor_from_rig = False
    options.min_model_size = 2
    mapper, triangulation = options.mapper, options.triangulation
    mapper.random_seed = triangulation.random_seed = 0
    mapper.init_min_num_inliers = config.init_min_num_inliers
    mapper.init_min_tri_angle = _FIRST_ANGLE_DEG
    mapper.abs_pose_min_num_inliers = config.abs_pose_min_num_inliers
    mapper.abs_pose_min_inlier_ratio = config.abs_pose_min_inlier_ratio
    mapper.abs_pose_max_error = config.abs_pose_max_error
    mapper.filter_max_reproj_error = config.filter_max_reproj_error
    mapper.filter_min_tri_angle = triangulation.min_angle = config.min_angle_deg
    triangulation.merge_max_reproj_error = config.filter_max_reproj_error
    triangulation.complete_max_reproj_error = config.filter_max_reproj_error
    triangulation.ignore_two_view_tracks = config.min_track_length > 2
    return options
