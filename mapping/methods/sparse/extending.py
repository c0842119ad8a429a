"""More photos in a model whose photos stay where they are."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
from numpy.typing import NDArray

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.adjustment import adjust_some
from mapping.methods.sparse.colmap_scene import ColmapScene, colmap_database
from mapping.methods.sparse.latecomers import Late, place_latecomers
from mapping.methods.sparse.model import MapperConfig, SfmPhoto, SparseModel, without_bad_points
from mapping.methods.sparse.points import cache_options
from mapping.methods.sparse.triangulation import pipeline_options
from mapping.progress import ItemProgress
from mapping.stages.landmarks import Observations
from visloc.pose.reprojection import pose_from_colmap

# Adjusted poses let more matches fit, and these move the poses a little.
_ROUNDS = 3


def with_late_photos(
    photos: Sequence[SfmPhoto],
    describe: Callable[[int], NDArray[np.int8]],
    matches: Sequence[Matches],
    model: SparseModel,
    config: MapperConfig,
    work: Path,
    progress: ItemProgress,
) -> SparseModel:
    """Return a model with the photos that find a place in it late (``place_latecomers``)."""
    late = place_latecomers(photos, describe, matches, model, config, progress)
    extended = extend(photos, model, late, config, work) if late.rows else model
    absent = model.views.count(None)
    progress(absent, absent)
    return extended


def extend(
    photos: Sequence[SfmPhoto], model: SparseModel, late: Late, config: MapperConfig, work: Path
) -> SparseModel:
    """Return a model with the photos that found a place late, and landmarks of their matches.

    Poses and points that they see are adjusted; all other poses, and all cameras, stay.

    Args:
        photos: all, placed or not.
        late: at least one photo.
    """
    rows = [row for row, view in enumerate(late.views) if view is not None]
    number = {row: order for order, row in enumerate(rows)}
    placed = [
        replace(photos[row], camera=view.camera, cam_from_world=view.cam_from_world)
        for row, view in enumerate(late.views)
        if view is not None
    ]
    among = [Matches(number[p.first], number[p.second], p.rows) for p in late.matches]
    with colmap_database(placed, {}, among, work) as (path, scene):
        grown = scene.with_poses(placed)
        _add_points(grown, scene, model, number)
        images = [scene.images[number[row]].image_id for row in late.rows]
        _grow(grown, path, images, pipeline_options(config))
        found = scene.read(grown, placed, (), model.doubts)
        moved = {
            row: pose_from_colmap(grown.image(image).cam_from_world())
            for row, image in zip(late.rows, images, strict=True)
        }
    found = without_bad_points(
        replace(
            found,
            views=tuple(
                replace(view, cam_from_world=moved.get(rows[order], view.cam_from_world))
                for order, view in enumerate(found.views)
                if view is not None
            ),
        ),
        config,
    )
    views = list(late.views)
    for row in late.rows:
        views[row] = found.views[number[row]]
    observations = found.observations
    return replace(
        model,
        views=tuple(views),
        points=found.points,
        observations=replace(observations, views=np.array(rows)[observations.views]),
        angles_deg=found.angles_deg,
    )


def _add_points(
    model: pycolmap.Reconstruction,
    scene: ColmapScene,
    known: SparseModel,
    number: dict[int, int],
) -> None:
    """Give a model of photos with poses the points of another, with their tracks."""
    seen: Observations = known.observations
    order = np.argsort(seen.points, kind="stable")
    starts = np.searchsorted(seen.points[order], np.arange(len(known.points) + 1))
    for point, xyz in enumerate(known.points):
        track = pycolmap.Track()
        for row in order[starts[point] : starts[point + 1]].tolist():
            image = scene.images[number[int(seen.views[row])]].image_id
            track.add_element(image, int(seen.rows[row]))
        model.add_point3D(xyz, track)


def _grow(
    model: pycolmap.Reconstruction,
    path: Path,
    images: Collection[int],
    options: pycolmap.IncrementalPipelineOptions,
) -> None:
    """Triangulate the matches of some images, and adjust these and what they see."""
    with pycolmap.Database.open(path) as database:
        cache = pycolmap.DatabaseCache.create(database, cache_options(options))
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    for _ in range(_ROUNDS):
        for image_id in images:
            mapper.triangulate_image(options.triangulation, image_id)
        mapper.complete_and_merge_tracks(options.triangulation)
        adjust_some(model, images)
        mapper.filter_points(options.mapper)
    mapper.end_reconstruction(discard=False)
