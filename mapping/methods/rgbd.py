"""Landmarks from depth: keypoints lifted to 3D and merged across photos in a voxel grid.

The mapping strategy for RGB-D data of Humenberger et al. 2020, with two changes: depth is looked
up at sub-pixel positions, and a landmark is the mean of the points in its cell instead of the first
of them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, MutableSequence, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from mapping.methods.matching.stages import camera_values, pose_values
from mapping.options import RGBD_PANEL, DepthScaleOption
from mapping.progress import one_step
from mapping.stages.context import BuildContext
from mapping.stages.depth import depth_at, photo_depth
from mapping.stages.landmarks import MadeLandmarks, Observations, View, assemble_landmarks
from mapping.stages.local_features import LocalFeaturesSource
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc.archive import Anchor, Landmarks
from visloc.errors import refuse
from visloc.geometry import Similarity
from visloc.kapture import Dataset
from visloc.pose.reprojection import normalized_rays, project

# Raised when the code of the stage changes what comes out.
_LIFTED_REVISION = 3

# Edge of a voxel over the median depth of the keypoints, before it is rounded: two and a half
# pixels of a picture whose focal length is 500.
_VOXEL_OF_DEPTH = 1 / 200
# Further away than this, over the median depth, a point moves by less than half such a pixel while
# the camera moves by the median depth. It cannot tell positions, and is mostly a code for "none".
_FARTHEST_OF_DEPTH = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class LiftedKeypoints:
    """The keypoints of a photo that have a depth.

    Attributes:
        rows: (m,) int64 rows of the photo's features, strongest first.
        pixels: (m, 2) float32 in the photo.
        points: (m, 3) float64 in the world.
    """

    rows: NDArray[np.int64]
    pixels: NDArray[np.float32]
    points: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DepthSettings:
    """Settings for landmarks from depth."""

    voxel_size: Annotated[
        float | None,
        typer.Option(
            help="Points within one cell of this edge become one landmark, metres. Default: 1/200 "
            "of the median depth of the keypoints, rounded to 1, 2 or 5 times a power of ten.",
            show_default=False,
            rich_help_panel=RGBD_PANEL,
        ),
    ] = None
    depth_scale: DepthScaleOption = 0.001


def landmarks_from_depth(
    context: BuildContext,
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    settings: DepthSettings,
    *,
    metric: bool,
    world_from_dataset: Similarity | None = None,
) -> MadeLandmarks:
    """Lift the keypoints of all photos and merge them.

    Args:
        photos: with poses in the dataset's frame, and depth in its unit.
        settings: the voxel size is in the unit of the world.
        metric: whether a unit of the world is a metre.
        world_from_dataset: None if the dataset's frame is the world.
    """
    work = context.work
    task = _LiftTask(work, dataset.without_records(), context.features, settings.depth_scale)
    context.run("depth", task.lift, photos)
    with one_step(context.progress, "landmarks"):
        lifted = deque(LiftedKeypoints(**work.read(task.key(photo))) for photo in photos)
        if world_from_dataset is not None:
            move = world_from_dataset
            lifted = deque(replace(one, points=move.apply(one.points)) for one in lifted)
            photos = [replace(photo, cam_from_world=move.move(photo.pose)) for photo in photos]
        depth, notes = leave_out_far(photos, lifted)
        voxel_size = settings.voxel_size or rounded_length(depth * _VOXEL_OF_DEPTH)
        # Handed over one by one, so that memory holds few of them twice.
        handed = (lifted.popleft() for _ in photos)
        landmarks, rows = merge_landmarks(photos, handed, voxel_size)
    return MadeLandmarks(
        photos=np.arange(len(photos)),
        views=tuple(View(photo.camera, photo.pose) for photo in photos),
        landmarks=landmarks,
        rows=tuple(rows),
        settings=asdict(replace(settings, voxel_size=voxel_size)),
        metric=metric,
        anchor=Anchor(kind="dataset", images=len(photos)),
        notes=notes,
    )


def refuse_without_depth(dataset: Dataset, photos: Sequence[MappingPhoto]) -> None:
    """Refuse photos of which none has a depth map."""
    if all(photo.depth is None for photo in photos):
        raise refuse("dataset.no_depth", field=str(dataset.root / "sensors" / "records_depth.txt"))


@dataclass(frozen=True, slots=True)
class _LiftTask:
    """A worker's part: one photo."""

    work: WorkFolder
    dataset: Dataset
    features: LocalFeaturesSource
    depth_scale: float

    def key(self, photo: MappingPhoto) -> str:
        return key_of(
            "lifted",
            _LIFTED_REVISION,
            local=self.features.key(photo),
            camera=camera_values(photo.camera),
            pose=pose_values(photo.pose),
            depth=photo.depth
            and [
                photo.depth_sha256,
                *camera_values(photo.depth.camera),
                *pose_values(photo.depth.cam_from_depth),
            ],
            depth_scale=self.depth_scale,
        )

    def lift(self, photo: MappingPhoto) -> None:
        def compute() -> Item:
            keypoints = self.features.read(photo).keypoints
            return asdict(lift_keypoints(self.dataset, photo, keypoints, self.depth_scale))

        self.work.get(self.key(photo), compute)


def lift_keypoints(
    dataset: Dataset, photo: MappingPhoto, keypoints: NDArray[np.float32], depth_scale: float
) -> LiftedKeypoints:
    """Lift the keypoints (n, 2) of a photo that have a depth into the world."""
    if photo.depth is None:
        rows = np.empty(0, dtype=np.int64)
        return LiftedKeypoints(rows, keypoints[rows], np.empty((0, 3)))
    depth, seen_by = photo_depth(dataset, photo.depth, photo.camera, depth_scale)
    rays = normalized_rays(photo.camera, keypoints)
    # Both cameras now share one centre and one orientation, not always size and focal length.
    distance = depth_at(depth, project(seen_by, rays)).astype(np.float64)
    rows = np.flatnonzero(np.isfinite(distance) & np.isfinite(rays).all(axis=1))
    points = photo.pose.inverse().apply(rays[rows] * distance[rows, None])
    return LiftedKeypoints(rows, keypoints[rows], points)


def leave_out_far(
    photos: Sequence[MappingPhoto], lifted: MutableSequence[LiftedKeypoints]
) -> tuple[float, tuple[str, ...]]:
    """Leave out keypoints that are too far away to be true, in place.

    Returns:
        The median depth of all in the unit of the photos' poses, and a note on those left out.
    """
    depths = [
        photo.pose.apply(one.points)[:, 2].astype(np.float32)
        for photo, one in zip(photos, lifted, strict=True)
    ]
    of_all = np.concatenate(depths)
    if len(of_all) == 0:
        raise refuse("rgbd.no_landmarks", field="dataset")
    median = float(np.median(of_all))
    farthest = _FARTHEST_OF_DEPTH * median
    num_far = np.count_nonzero(of_all > farthest)
    if num_far == 0:
        return median, ()
    for index, depth in enumerate(depths):
        near, one = depth <= farthest, lifted[index]
        lifted[index] = LiftedKeypoints(one.rows[near], one.pixels[near], one.points[near])
    return median, (
        f"{num_far} of {len(of_all)} keypoints with a depth were left out: they are more than "
        f"{_FARTHEST_OF_DEPTH:g} times as far away as the median, {median:.3g}",
    )


def rounded_length(length: float) -> float:
    """Round to 1, 2 or 5 times a power of ten: scenes that differ a little get the same cells."""
    exponent = math.floor(math.log10(length))
    steps = [float(f"{step}e{exponent}") for step in (1, 2, 5, 10)]
    return min(steps, key=lambda step: abs(math.log(step / length)))


def merge_landmarks(
    photos: Sequence[MappingPhoto], lifted: Iterable[LiftedKeypoints], voxel_size: float
) -> tuple[Landmarks, list[NDArray[np.int64]]]:
    """Merge the lifted keypoints of all photos: one landmark per occupied voxel, at their mean.

    If a photo has several keypoints in a voxel (a corner found at several scales), the strongest
    stays. It takes about 150 bytes of memory per keypoint.

    Args:
        voxel_size: edge of a voxel in the unit of the world.

    Returns:
        The landmarks, and for each photo the rows of its features that observe them.
    """
    points_of, pixels_of, rows_of = zip(
        *((one.points, one.pixels, one.rows) for one in lifted), strict=True
    )
    seen_in = np.repeat(np.arange(len(rows_of)), [len(rows) for rows in rows_of])
    # One after the other, so that memory holds few of them twice.
    points = np.concatenate(points_of)
    del points_of
    pixels = np.concatenate(pixels_of)
    del pixels_of
    rows = np.concatenate(rows_of)
    del rows_of
    # Voxels are counted from near the photos, to keep precision far from the world's origin.
    origin = np.round(np.mean([photo.pose.center for photo in photos], axis=0))
    points -= origin
    landmark, num_landmarks = _voxel_index(points, voxel_size)
    # np.unique returns the first row of each pair, which is the strongest keypoint.
    kept = np.sort(np.unique(landmark * len(photos) + seen_in, return_index=True)[1])
    points, pixels, rows = points[kept], pixels[kept], rows[kept]
    landmark, seen_in = landmark[kept], seen_in[kept]

    tracks = np.bincount(landmark, minlength=num_landmarks)
    mean = np.column_stack(
        [np.bincount(landmark, points[:, axis], num_landmarks) / tracks for axis in range(3)]
    )
    mean += origin
    del points, kept
    views = [View(photo.camera, photo.pose) for photo in photos]
    return assemble_landmarks(views, mean, Observations(landmark, seen_in, rows, pixels))


def _voxel_index(points: NDArray[np.float64], voxel_size: float) -> tuple[NDArray[np.int64], int]:
    """Number the occupied voxels in the order of their cells; return (numbers, how many)."""
    cells = points / voxel_size
    np.floor(cells, out=cells)
    cells -= cells.min(axis=0)
    size = cells.max(axis=0) + 1.0
    if np.prod(size) >= 2**62:
        raise refuse(
            "rgbd.voxel_size",
            field="--voxel-size",
            expected=f"more for an extent of {', '.join(f'{s:g}' for s in size * voxel_size)}",
            got=voxel_size,
        )
    flat = np.zeros(len(cells), dtype=np.int64)
    for axis in range(3):
        flat *= int(size[axis])
        flat += cells[:, axis].astype(np.int64)
    del cells
    occupied, index = np.unique(flat, return_inverse=True)
    return index.astype(np.int64), len(occupied)
