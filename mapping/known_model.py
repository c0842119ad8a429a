"""Landmarks from the points that the dataset brings along: an imported reconstruction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapping.features import LocalFeaturesSource, Progress, ReadyMadeFeatures
from mapping.landmarks import (
    MadeLandmarks,
    Observations,
    View,
    assemble_landmarks,
    triangulation_angles,
)
from mapping.photos import MappingPhoto
from visloc.archive import Anchor
from visloc.errors import DatasetError
from visloc.geometry import PixelOrigin
from visloc.kapture import Dataset, FeatureSet, Reconstruction, open_features, read_reconstruction

# A keypoint of ours this close to where the reconstruction saw a point is taken for that point.
MAX_DISTANCE_PX = 2.0


def landmarks_from_reconstruction(
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    features: LocalFeaturesSource,
    origin: PixelOrigin,
    metric: bool,
    progress: Progress,
) -> MadeLandmarks:
    """Take the dataset's points as landmarks, and give them descriptors.

    With the ready-made features that the points were made of, every sighting has its descriptor.
    With other features, a sighting gets that of the nearest keypoint within ``MAX_DISTANCE_PX``,
    and is left out without one. All points stay, in their order, also those that no feature of
    ours sees: so the map can be exported as the reconstruction that it was.

    Raises:
        DatasetError: ``model.no_points``, ``model.no_sightings``, and what reading raises.
    """
    known = read_reconstruction(dataset.root)
    if known is None or known.keypoints_type is None or len(known.observations) == 0:
        raise DatasetError(
            "model.no_points",
            "the dataset has no points with observations",
            field=str(dataset.root / "reconstruction" / "points3d.txt"),
            expected="points3d.txt and observations.txt, as mapping import writes them; "
            "without, use --method sfm",
        )
    keypoints = open_features(dataset.root, "keypoints", known.keypoints_type)
    sightings = _sightings(keypoints, photos, known, origin)
    same = (
        isinstance(features, ReadyMadeFeatures)
        and features.keypoints.type_name == known.keypoints_type
    )
    found = []
    for row, photo in enumerate(photos):
        own = sightings.take(sightings.views == row)
        found.append(own if same else _nearest(own, features.read(photo).keypoints))
        progress("landmarks", row + 1, len(photos))
    observations = Observations(
        *(
            np.concatenate([getattr(one, name) for one in found])
            for name in ("points", "views", "rows", "pixels")
        )
    )
    if len(observations) == 0:
        raise DatasetError(
            "model.no_sightings",
            "no point of the reconstruction is where the features see anything",
            field=str(dataset.root / "reconstruction" / "observations.txt"),
            expected=f"sightings within {MAX_DISTANCE_PX} px of keypoints of "
            f"{features.fingerprint.name}; check --pixel-origin, or use --method sfm",
        )
    views = [View(photo.camera, photo.pose) for photo in photos]
    landmarks, rows = assemble_landmarks(
        views,
        known.points,
        observations,
        track_lengths=np.bincount(sightings.points, minlength=len(known.points)),
        angles_deg=triangulation_angles(views, known.points, sightings),
        colors=known.colors,
    )
    unseen = len(known.points) - len(np.unique(observations.points))
    notes = (
        f"{unseen} of {len(known.points)} points are kept, but no feature sees them",
        f"{len(observations)} of {len(sightings)} sightings have a descriptor",
    )
    return MadeLandmarks(
        photos=np.arange(len(photos)),
        views=tuple(views),
        landmarks=landmarks,
        rows=tuple(rows),
        settings={"max_distance_px": MAX_DISTANCE_PX},
        metric=metric,
        anchor=Anchor(kind="model", images=len(photos)),
        notes=notes if unseen or len(observations) < len(sightings) else (),
    )


def _sightings(
    keypoints: FeatureSet,
    photos: Sequence[MappingPhoto],
    known: Reconstruction,
    origin: PixelOrigin,
) -> Observations:
    """The reconstruction's own observations by these photos, at its own keypoints."""
    row_of_name = {photo.name: row for row, photo in enumerate(photos)}
    views = np.array([row_of_name.get(name, -1) for name in known.images], dtype=np.int64)
    found = []
    for image in np.unique(known.observations[:, 1]).tolist():
        if views[image] < 0:
            continue
        own = known.observations[known.observations[:, 1] == image]
        pixels = keypoints.read(known.images[image])[:, :2]
        # A photo may see a point twice; the first time counts.
        _, first = np.unique(own[:, 0], return_index=True)
        own = own[np.sort(first)]
        seen_at = (pixels[own[:, 2]] + origin.shift).astype(np.float32)
        row = np.full(len(own), views[image], dtype=np.int64)
        found.append(Observations(own[:, 0], row, own[:, 2], seen_at))
    if not found:
        empty = np.empty(0, dtype=np.int64)
        return Observations(empty, empty, empty, np.empty((0, 2), dtype=np.float32))
    return Observations(
        *(
            np.concatenate([getattr(one, name) for one in found])
            for name in ("points", "views", "rows", "pixels")
        )
    )


def _nearest(sightings: Observations, keypoints: NDArray[np.float32]) -> Observations:
    """Sightings moved to the nearest keypoint, each keypoint used once, by the nearest sighting."""
    if len(sightings) == 0 or len(keypoints) == 0:
        return sightings.take(np.zeros(len(sightings), dtype=bool))
    nearest = cKDTree(keypoints).query(sightings.pixels, distance_upper_bound=MAX_DISTANCE_PX)
    distance, row = np.asarray(nearest[0]), np.asarray(nearest[1], dtype=np.int64)
    order = np.lexsort((sightings.points, distance))
    order = order[np.isfinite(distance[order])]
    _, first = np.unique(row[order], return_index=True)
    kept = np.sort(order[first])
    return Observations(
        sightings.points[kept], sightings.views[kept], row[kept], keypoints[row[kept]]
    )
