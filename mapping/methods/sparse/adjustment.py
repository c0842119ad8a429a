"""Bundle adjustment, and how well it determines focal lengths."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
from numpy.typing import NDArray

from mapping.frames.anchor import align_poses
from mapping.methods.sparse.colmap_calls import quiet
from mapping.methods.sparse.colmap_scene import ColmapScene
from mapping.methods.sparse.intrinsics import STEP
from mapping.methods.sparse.model import SfmPhoto
from mapping.progress import ItemProgress, not_told, part_of
from visloc.pose.reprojection import pose_from_colmap

REFINABLE = ("poses", "points", "intrinsics")
# Fewer photos of a camera do not tell its principal point; in lenses it lies nearer to the middle
# than this share of the longer side.
_MANY_PHOTOS, _MAX_SHIFT = 30, 0.02
# Scale of the robust loss. Where errors change by a smaller share in a step, camera centres move by
# less than a thousandth of what is known of them, however many steps follow.
_LOSS_SCALE_PX, _LEAST_CHANGE = 1.0, 1e-6
# Most steps of an adjustment of a finished model.
_MOST_STEPS = 100
# Most steps between two reports of progress. Of large models fewer: of 300 photos that see the same
# room, with 300 000 observations, four steps and their preparation take three and a half seconds.
_STEPS, _OBSERVED_IN_STEPS = 10, 1_200_000
# Models of fewer photos are adjusted more closely while they grow, as in COLMAP.
_FEW_PHOTOS, _CLOSER = 10, 10.0
# A step that went as foreseen lets the next one go further by the first factor. One that failed is
# taken back, and the next is shorter by the second; if that fails too, by its square (Ceres).
_FURTHER, _SHORTER = 3.0, 2.0


def refine_model(
    model: pycolmap.Reconstruction,
    photos: Sequence[SfmPhoto],
    scene: ColmapScene,
    refine: Sequence[str],
    held: Collection[str],
    progress: ItemProgress,
) -> None:
    """Adjust points, and also the poses and intrinsics that ``refine`` names.

    Refined poses are aligned to the given ones again. Intrinsics of the sensors ``held`` stay.
    ``progress`` is in steps.
    """
    poses = "poses" in refine
    options = _robust_options(poses=poses, intrinsics="intrinsics" in refine)
    with quiet():
        constant = {scene.camera_ids[sensor] for sensor in held}
        _adjust(model, options, constant, progress, poses=poses)
        if poses:
            given = [photo.cam_from_world for photo in photos if photo.cam_from_world is not None]
            moved = [
                pose_from_colmap(model.image(image.image_id).cam_from_world())
                for image in scene.images
            ]
            back = align_poses(moved, given)
            if scene.on_rigs:  # they fix the scale
                back = replace(back, scale=1.0)
            model.transform(
                pycolmap.Sim3d(back.scale, pycolmap.Rotation3d(back.rotation), back.translation)
            )


def error_rises(
    model: pycolmap.Reconstruction,
    camera_ids: Collection[int],
    progress: ItemProgress,
    *,
    poses: bool,
) -> dict[int, float]:
    """Return by camera how reprojection errors rise as focal lengths change and all else adapts.

    All cameras change at once, by ``STEP``: in a scene that determines none of them, each would
    still be determined by the others.

    Returns:
        Pixels: the root of the rise of the mean squared error.
    """
    before, after = pycolmap.Reconstruction(model), pycolmap.Reconstruction(model)
    others = set(model.cameras) - set(camera_ids)
    with quiet():
        for number, (copy, step) in enumerate(((before, 0.0), (after, STEP))):
            for camera_id in camera_ids:
                camera = copy.camera(camera_id)
                for index in camera.focal_length_idxs():
                    camera.params[index] *= 1 + step
            options = _options(poses=poses, intrinsics=True)
            options.refine_focal_length = False
            _adjust(copy, options, others, part_of(progress, number, 2), poses=poses)
    progress(2 * _MOST_STEPS, 2 * _MOST_STEPS)
    errors = _squared_errors(before), _squared_errors(after)
    return {
        camera_id: math.sqrt(max(errors[1].get(camera_id, 0.0) - errors[0].get(camera_id, 0.0), 0))
        for camera_id in camera_ids
    }


def adjusted_robustly(
    model: pycolmap.Reconstruction, camera_ids: Collection[int], progress: ItemProgress
) -> pycolmap.Reconstruction:
    """Return a model adjusted once more, with a loss that wrong matches hardly move.

    The mapper adjusts all photos by squared errors. Of the matches that fit the geometry of their
    two photos to a few pixels, one in twenty is wrong; squared, they outweigh the others, and bend
    a model of few photos by centimetres in a room (docs/results.md).
    Members of rigs do not move in them.

    A principal point that is two pixels off bends the paths of cameras too. It is refined last, of
    cameras with many photos: before, it would take up errors of poses. It stays when one moves
    further than in lenses.

    Args:
        camera_ids: of the cameras whose intrinsics may change.
    """
    adjusted = pycolmap.Reconstruction(model)
    options = _robust_options(poses=True, intrinsics=True)
    constant = set(model.cameras) - set(camera_ids)
    with quiet():
        _adjust(adjusted, options, constant, part_of(progress, 0, 2), poses=True)
    adjusted = _with_principal_points(adjusted, camera_ids, part_of(progress, 1, 2))
    progress(2 * _MOST_STEPS, 2 * _MOST_STEPS)
    return adjusted


def adjust_growing(
    mapper: pycolmap.IncrementalMapper,
    options: pycolmap.BundleAdjustmentOptions,
    constant: Collection[int],
    progress: ItemProgress,
) -> None:
    """Adjust all photos of a model that grows, by squared errors.

    What ``mapper.adjust_global_bundle`` does, which reports nothing until it ends.

    Args:
        options: as the pipeline has them.
    """
    model, solver = mapper.reconstruction, options.ceres.solver_options
    mapper.observation_manager.filter_observations_with_negative_depth()
    most = solver.max_num_iterations
    if model.num_reg_frames() < _FEW_PHOTOS:
        most *= 2
        solver.gradient_tolerance /= _CLOSER
    _adjust(model, options, constant, progress, poses=True, most=most)


def rig_length(rigs: Iterable[pycolmap.Rig]) -> float:
    """Return the summed distances of cameras from the first of their rigs, 0 without a baseline."""
    poses = (pose for rig in rigs for pose in rig.non_ref_sensors.values() if pose is not None)
    return math.fsum(float(np.linalg.norm(pose.translation)) for pose in poses)


def adjust_some(model: pycolmap.Reconstruction, image_ids: Collection[int]) -> None:
    """Adjust the poses of some images and the points that they see, robustly; all else stays."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in image_ids:
        config.add_image(image_id)
        config.set_constant_cam_intrinsics(model.image(image_id).camera_id)
        for seen in model.image(image_id).get_observation_points2D():
            if not config.has_variable_point(seen.point3D_id):
                config.add_variable_point(seen.point3D_id)
    with quiet():
        _solve(model, _robust_options(poses=True, intrinsics=False), config, not_told)


def _with_principal_points(
    model: pycolmap.Reconstruction, camera_ids: Collection[int], progress: ItemProgress
) -> pycolmap.Reconstruction:
    photos = Counter(model.image(image_id).camera_id for image_id in model.reg_image_ids())
    free = {camera_id for camera_id in camera_ids if photos[camera_id] >= _MANY_PHOTOS}
    if not free:
        return model
    adjusted = pycolmap.Reconstruction(model)
    options = _robust_options(poses=True, intrinsics=True)
    options.refine_principal_point = True
    with quiet():
        _adjust(adjusted, options, set(model.cameras) - free, progress, poses=True)
    for camera_id in free:
        before, after = model.camera(camera_id), adjusted.camera(camera_id)
        moved = math.hypot(
            *(after.params[i] - before.params[i] for i in before.principal_point_idxs())
        )
        if not moved <= _MAX_SHIFT * max(before.width, before.height):
            return model
    return adjusted


def _squared_errors(model: pycolmap.Reconstruction) -> dict[int, float]:
    """Return by camera the mean squared reprojection error in its photos."""
    sums: dict[int, NDArray[np.float64]] = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        seen = image.get_observation_points2D()
        if not seen:
            continue
        points = np.array([model.point3D(point.point3D_id).xyz for point in seen])
        pixels = np.array([point.xy for point in seen])
        projected = np.asarray(
            model.camera(image.camera_id).img_from_cam(image.cam_from_world() * points)
        )
        squared = np.sum((projected - pixels) ** 2, axis=1)
        squared = squared[np.isfinite(squared)]
        total = sums.setdefault(image.camera_id, np.zeros(2))
        total += squared.sum(), len(squared)
    return {camera_id: total / count for camera_id, (total, count) in sums.items() if count}


def _options(*, poses: bool, intrinsics: bool) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_rig_from_world = poses
    options.refine_sensor_from_rig = False
    options.refine_focal_length = options.refine_extra_params = intrinsics
    options.ceres.solver_options.num_threads = 1  # like the mapper
    return options


def _robust_options(*, poses: bool, intrinsics: bool) -> pycolmap.BundleAdjustmentOptions:
    options = _options(poses=poses, intrinsics=intrinsics)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS_SCALE_PX
    options.ceres.solver_options.function_tolerance = _LEAST_CHANGE
    return options


def _adjust(
    model: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    constant: Collection[int],
    progress: ItemProgress,
    *,
    poses: bool,
    most: int = _MOST_STEPS,
) -> None:
    """Adjust a model in so many steps; intrinsics of the cameras ``constant`` stay."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for camera_id in constant:
        config.set_constant_cam_intrinsics(camera_id)
    if poses and rig_length(
        model.rigs.values()
    ):  # two fixed frames would contradict the rigs' unit
        config.set_constant_rig_from_world_pose(min(model.reg_frame_ids()))
    elif poses:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    _solve(model, options, config, progress, most)


def _solve(
    model: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    config: pycolmap.BundleAdjustmentConfig,
    progress: ItemProgress,
    most: int = _MOST_STEPS,
) -> None:
    """Solve a few steps at a time.

    pycolmap reports nothing, and lets no thread run meanwhile, so that neither progress nor Ctrl-C
    is seen. Nothing is lost between the steps but how far one may go, which is handed on.
    """
    solver = options.ceres.solver_options
    steps = max(1, min(_STEPS, _OBSERVED_IN_STEPS // max(1, model.compute_num_observations())))
    solver.max_num_iterations = steps
    for done in range(0, most, steps):
        progress(done, most)
        # pycolmap.bundle_adjustment prints to stderr regardless of options.
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
        summary = adjuster.solve()
        if summary.termination_type != pycolmap.BundleAdjustmentTerminationType.NO_CONVERGENCE:
            break
        assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
        # Steps that failed count: others of the same length would fail in the same way.
        failed = summary.ceres_summary.num_unsuccessful_steps
        gone = summary.ceres_summary.num_successful_steps - 1  # the first is where they began
        radius = solver.initial_trust_region_radius * _FURTHER**gone
        radius /= _SHORTER ** (failed * (failed + 1) // 2)
        bounds = solver.min_trust_region_radius, solver.max_trust_region_radius
        solver.initial_trust_region_radius = float(np.clip(radius, *bounds))
    progress(most, most)
