"""Points of photos whose poses are known, triangulated in steps that report progress.

The steps are those of COLMAP's point triangulator, which reports nothing (Schönberger and Frahm,
"Structure-from-Motion Revisited", 2016, sections 4.2 and 4.4). While poses and cameras stay, points
do not depend on each other, so they are adjusted some at a time, and again only when their
observations changed: three quarters of the time of later rounds went into points that stayed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap

from mapping.progress import ItemProgress

# Points that are adjusted at a time: about a second of work.
_BATCH = 10_000


def triangulate_points(
    model: pycolmap.Reconstruction,
    path: Path,
    options: pycolmap.IncrementalPipelineOptions,
    progress: ItemProgress,
) -> None:
    """Give a model of photos with poses the points of their matches.

    Args:
        progress: called with how much is done, in photos: each is counted once when its matches
            are triangulated, once in each adjustment, and once after each of these, when tracks
            are completed and merged.
    """
    images = sorted(model.reg_image_ids())
    rounds = options.ba_global_max_refinements
    total = 2 * len(images) * (1 + rounds)

    def tell(passes: float) -> None:
        # Never all: rounds may follow.
        progress(min(int(len(images) * passes), total - 1), total)

    tell(0)
    with pycolmap.Database.open(path) as database:
        cache = pycolmap.DatabaseCache.create(database, cache_options(options))
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    for done, image_id in enumerate(images, 1):
        mapper.triangulate_image(options.triangulation, image_id)
        tell(done / len(images))
    _complete_and_merge(mapper, options, tell, 1)
    adjusted: dict[int, int] = {}
    for number in range(1, rounds + 1):
        mapper.observation_manager.filter_observations_with_negative_depth()
        observations = model.compute_num_observations()
        lengths = _track_lengths(model)
        extended = mapper.get_modified_points3D()
        points = sorted(
            point
            for point, length in lengths.items()
            if adjusted.get(point) != length or point in extended
        )
        adjusted = lengths
        mapper.clear_modified_points3D()
        for start in range(0, len(points), _BATCH):
            _adjust(model, points[start : start + _BATCH], options)
            tell(2 * number + min(start + _BATCH, len(points)) / len(points))
        changed = _complete_and_merge(mapper, options, tell, 2 * number + 1)
        changed += mapper.filter_points(options.mapper)
        if changed <= options.ba_global_max_refinement_change * observations:
            break
    mapper.end_reconstruction(discard=False)
    progress(total, total)


def _complete_and_merge(
    mapper: pycolmap.IncrementalMapper,
    options: pycolmap.IncrementalPipelineOptions,
    tell: Callable[[float], None],
    passes: int,
) -> int:
    """Complete and merge the tracks of all points; return how many observations changed.

    It tells how many passes over all photos are done, beginning with ``passes``.

    ``mapper.complete_and_merge_tracks`` does so in one call, which lets neither progress nor Ctrl-C
    through: with 300 photos on a busy machine for at most 30 seconds.
    """
    changed = 0
    steps = (mapper.triangulator.complete_tracks, mapper.triangulator.merge_tracks)
    for number, step in enumerate(steps):
        points = sorted(mapper.reconstruction.point3D_ids())
        for start in range(0, len(points), _BATCH):
            changed += step(options.triangulation, set(points[start : start + _BATCH]))
            share = min(start + _BATCH, len(points)) / len(points)
            tell(passes + (number + share) / len(steps))
    return changed


def cache_options(options: pycolmap.IncrementalPipelineOptions) -> pycolmap.DatabaseCacheOptions:
    """Return what to read of a database: all photos, and the pairs with enough matches."""
    cache = pycolmap.DatabaseCacheOptions()
    cache.min_num_matches = options.min_num_matches
    cache.load_all_images = True
    return cache


def _track_lengths(model: pycolmap.Reconstruction) -> dict[int, int]:
    return {number: point.track.length() for number, point in model.points3D.items()}


def _adjust(
    model: pycolmap.Reconstruction,
    points: list[int],
    options: pycolmap.IncrementalPipelineOptions,
) -> None:
    """Move some points to where their reprojection errors are least."""
    adjustment = options.get_global_bundle_adjustment()
    adjustment.print_summary = False
    adjustment.refine_focal_length = adjustment.refine_extra_params = False
    adjustment.refine_rig_from_world = adjustment.refine_sensor_from_rig = False
    adjustment.ceres.solver_options.num_threads = options.num_threads
    config = pycolmap.BundleAdjustmentConfig()
    for point_id in points:
        config.add_variable_point(point_id)
    pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()
