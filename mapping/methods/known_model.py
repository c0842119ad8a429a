"""Landmarks from a reconstruction that comes with the dataset, such as an imported one.

With the features that the reconstruction was made of, its points are the landmarks. Other features
do not observe its points. Then the photos are matched again, with their poses, in the pairs that
share points of the reconstruction; and its points stay in the map beside the landmarks, so that the
map can be exported as the same reconstruction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapping.methods.sfm import landmarks_from_matches
from mapping.methods.sfm_settings import SfmSettings
from mapping.stages.context import BuildContext
from mapping.stages.imported_points import ImportedPoints
from mapping.stages.landmarks import (
    MadeLandmarks,
    Observations,
    View,
    assemble_landmarks,
    triangulation_angles,
)
from mapping.stages.local_features import ReadyMadeFeatures
from mapping.stages.photos import MappingPhoto
from visloc.archive import Anchor
from visloc.errors import VislocError, refuse
from visloc.geometry import PixelOrigin
from visloc.kapture import Dataset, FeatureSet, Reconstruction, open_features, read_reconstruction


def landmarks_from_reconstruction(
    context: BuildContext,
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    origin: PixelOrigin,
    settings: SfmSettings,
    *,
    metric: bool,
) -> MadeLandmarks:
    """Take the dataset's points as landmarks, or match its photos again.

    Points are taken as they are: no threshold of reprojection error, angle or number of
    observations is applied, since the tool that made them had its own.

    Args:
        origin: of the coordinates of the dataset's keypoints.
        settings: for matching again; the pairs are those that share points.
        metric: whether a unit of the dataset's poses is a metre.
    """
    known = read_reconstruction(dataset.root)
    if known is None or known.keypoints_type is None or len(known.observations) == 0:
        raise _no_points(dataset)
    features, anchor = context.features, Anchor(kind="model", images=len(photos))
    if (
        isinstance(features, ReadyMadeFeatures)
        and features.keypoints.type_name == known.keypoints_type
    ):
        imported, notes = _imported_points(known, features.keypoints, photos, origin)
        return _landmarks_of(imported, photos, anchor, notes, metric=metric)
    keypoints = open_features(dataset.root, "keypoints", known.keypoints_type)
    imported, notes = _imported_points(known, keypoints, photos, origin)
    again = replace(settings, pairs=("covisibility",), covisible_in=None, pairs_file=None)
    (made,) = landmarks_from_matches(context, dataset, photos, (), again, metric=metric)
    return replace(made, anchor=anchor, imported=imported, notes=(*made.notes, *notes))


def _landmarks_of(
    imported: ImportedPoints,
    photos: Sequence[MappingPhoto],
    anchor: Anchor,
    notes: tuple[str, ...],
    *,
    metric: bool,
) -> MadeLandmarks:
    """Take points as landmarks."""
    views = [View(photo.camera, photo.pose) for photo in photos]
    observations = _observations(imported)
    landmarks, rows = assemble_landmarks(
        views,
        imported.points,
        observations,
        angles_deg=triangulation_angles(views, imported.points, observations),
        colors=imported.colors,
    )
    return MadeLandmarks(
        photos=np.arange(len(photos)),
        views=tuple(views),
        landmarks=landmarks,
        rows=tuple(rows),
        settings={},
        metric=metric,
        anchor=anchor,
        notes=notes,
    )


def refuse_without_points(dataset: Dataset) -> None:
    """Refuse a dataset without the files of a reconstruction."""
    folder = dataset.root / "reconstruction"
    if not all((folder / name).is_file() for name in ("points3d.txt", "observations.txt")):
        raise _no_points(dataset)


def _no_points(dataset: Dataset) -> VislocError:
    return refuse("model.no_points", field=str(dataset.root / "reconstruction" / "points3d.txt"))


def _imported_points(
    known: Reconstruction,
    keypoints: FeatureSet,
    photos: Sequence[MappingPhoto],
    origin: PixelOrigin,
) -> tuple[ImportedPoints, tuple[str, ...]]:
    """Return what these photos observe of a reconstruction, in their order, and notes."""
    row_of_name = {photo.name: row for row, photo in enumerate(photos)}
    photo_of_image = np.array([row_of_name.get(name, -1) for name in known.images], dtype=np.int64)
    pixels = [
        (keypoints.read(photo.name)[:, :2] + origin.shift).astype(np.float32)
        if keypoints.has(photo.name)
        else np.empty((0, 2), dtype=np.float32)
        for photo in photos
    ]
    observations = known.observations.copy()
    observations[:, 1] = photo_of_image[known.observations[:, 1]]
    observations = observations[observations[:, 1] >= 0]
    readable = np.array([keypoints.has(photo.name) for photo in photos])[observations[:, 1]]
    lost, observations = observations[~readable], observations[readable]
    _check_rows(observations, np.array([len(one) for one in pixels]), keypoints, photos)
    notes: tuple[str, ...] = ()
    if len(lost):
        blind = np.unique(lost[:, 1])
        notes = (
            f"{len(lost)} observations by {len(blind)} photos without a file of keypoints were "
            f"left out (first {keypoints.label(photos[blind[0]].name)})",
        )
    imported = ImportedPoints(
        points=known.points,
        colors=known.colors,
        keypoint_offsets=np.cumsum([0, *(len(one) for one in pixels)], dtype=np.int64),
        keypoints=np.concatenate(pixels),
        observations=observations,
    )
    return imported, notes


def _check_rows(
    observations: NDArray[np.int64],
    counts: NDArray[np.int64],
    keypoints: FeatureSet,
    photos: Sequence[MappingPhoto],
) -> None:
    beyond = np.flatnonzero(observations[:, 2] >= counts[observations[:, 1]])
    if len(beyond):
        _, photo, row = observations[beyond[0]].tolist()
        raise refuse(
            "kapture.index",
            f"reconstruction/observations.txt has a keypoint of {photos[photo].name} that "
            "this file does not have",
            field=keypoints.label(photos[photo].name),
            expected=f"less than {counts[photo]}",
            got=str(row),
        )


def _observations(imported: ImportedPoints) -> Observations:
    """Return the first observation of each point in each photo."""
    table: NDArray[np.int64] = imported.observations
    order = np.lexsort((table[:, 2], table[:, 0], table[:, 1]))
    table = table[order]
    repeated = np.zeros(len(table), dtype=bool)
    repeated[1:] = (np.diff(table[:, :2], axis=0) == 0).all(axis=1)
    points, views, rows = table[~repeated].T
    return Observations(
        points, views, rows, imported.keypoints[imported.keypoint_offsets[views] + rows]
    )
