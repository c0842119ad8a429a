"""The landmarks of a map, from points and their observations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from mapping.pairing import Pairs, Scene
from mapping.stages.camera_mask import CameraMask
from mapping.stages.imported_points import ImportedPoints
from visloc.archive import Anchor, Landmarks
from visloc.archive.schema import Doubt
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

# Directions of this many observations are compared at a time: 100 MB.
_MAX_DIRECTIONS = 4_000_000


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A photo's intrinsics and pose."""

    camera: Camera
    cam_from_world: Pose


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Observations of points in photos, one per row.

    Attributes:
        points: (M,) int64 rows of the points.
        views: (M,) int64 rows of the photos.
        rows: (M,) int64 rows of the photo's features.
        pixels: (M, 2) float32.
    """

    points: NDArray[np.int64]
    views: NDArray[np.int64]
    rows: NDArray[np.int64]
    pixels: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Observations:
        """Return some of them."""
        return Observations(
            self.points[index], self.views[index], self.rows[index], self.pixels[index]
        )


@dataclass(frozen=True, slots=True, eq=False)
class MadeLandmarks:
    """The result of a mapping method.

    Attributes:
        photos: (n,) int64 rows of the photos that have a pose in the map.
        landmarks: with observations by these photos, in their order.
        rows: for each of these photos, the rows of its features that observe the landmarks.
        settings: of the method, for the manifest.
        metric: whether a unit of the world is a metre.
        rig_scale: units of the world per unit of the dataset's rigs; None when it is unknown.
        notes: what was left out, one sentence each.
        imported: the points of an imported reconstruction whose photos were matched again.
        pairs: the matched pairs, with their scene.
        doubts: what speaks against putting a map of them into use by itself.
        fixed: masks of what is fixed to the picture, by sensor; ``rows`` are those of the features
            outside them (``LocalFeaturesSource.outside``).
    """

    photos: NDArray[np.int64]
    views: tuple[View, ...]
    landmarks: Landmarks
    rows: tuple[NDArray[np.int64], ...]
    settings: Mapping[str, JsonValue]
    metric: bool
    anchor: Anchor
    notes: tuple[str, ...] = ()
    rig_scale: float | None = 1.0
    imported: ImportedPoints | None = None
    pairs: tuple[Scene, Pairs] | None = None
    doubts: tuple[Doubt, ...] = ()
    fixed: Mapping[str, CameraMask] = field(default_factory=dict)


def assemble_landmarks(
    views: Sequence[View],
    points: NDArray[np.float64],
    observations: Observations,
    *,
    angles_deg: NDArray[np.float32] | None = None,
    colors: NDArray[np.uint8] | None = None,
) -> tuple[Landmarks, list[NDArray[np.int64]]]:
    """Make landmarks of points (P, 3) in the world and their observations by n views.

    Args:
        angles_deg: (P,) largest angle between two rays; NaN if not given.
        colors: (P, 3).

    Returns:
        The landmarks, and for each photo the rows of its features that observe them.
    """
    if (np.diff(observations.views) < 0).any():
        observations = observations.take(np.argsort(observations.views, kind="stable"))
    num_points = len(points)
    seen = np.bincount(observations.points, minlength=num_points)
    errors = reprojection_errors(views, points, observations)
    with np.errstate(invalid="ignore"):
        mean_errors = np.bincount(observations.points, errors, num_points) / seen
    bounds = np.searchsorted(observations.views, np.arange(len(views) + 1))
    origin = _choose_origin(views)
    landmarks = Landmarks(
        origin=origin,
        points=(points - origin).astype(np.float32),
        track_lengths=np.minimum(seen, 65535).astype(np.uint16),
        errors_px=mean_errors.astype(np.float32),
        angles_deg=np.full(num_points, np.nan, np.float32) if angles_deg is None else angles_deg,
        offsets=bounds.astype(np.int64),
        observed=observations.points.astype(np.uint32),
        keypoints=observations.pixels,
        colors=colors,
    )
    return landmarks, [observations.rows[a:b] for a, b in pairwise(bounds.tolist())]


def only_observations(views: Sequence[View], keypoints: Sequence[NDArray[np.float32]]) -> Landmarks:
    """Return what a map without landmarks stores: each keypoint (m_i, 2) of each view."""
    offsets = np.cumsum([0, *map(len, keypoints)])
    return Landmarks(
        origin=_choose_origin(views),
        points=np.empty((0, 3), np.float32),
        track_lengths=np.empty(0, np.uint16),
        errors_px=np.empty(0, np.float32),
        angles_deg=np.empty(0, np.float32),
        offsets=offsets.astype(np.int64),
        observed=np.arange(offsets[-1], dtype=np.uint32),
        keypoints=np.concatenate(keypoints),
    )


def reprojection_errors(
    views: Sequence[View], points: NDArray[np.float64], observations: Observations
) -> NDArray[np.float64]:
    """Return the distances (M,) in pixels of observations from projections; NaN behind a camera."""
    errors = np.empty(len(observations))
    for row, own in rows_by_value(observations.views):
        view = views[row]
        seen_at = project(view.camera, view.cam_from_world.apply(points[observations.points[own]]))
        errors[own] = np.linalg.norm(seen_at - observations.pixels[own], axis=1)
    return errors


def rows_by_value(values: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield each distinct value with the rows that have it."""
    if len(values) == 0:
        return
    order = np.argsort(values, kind="stable")
    distinct, starts = np.unique(values[order], return_index=True)
    yield from zip(distinct.tolist(), np.split(order, starts[1:]), strict=True)


def triangulation_angles(
    views: Sequence[View], points: NDArray[np.float64], observations: Observations
) -> NDArray[np.float32]:
    """Return the largest angle (P,) between two rays to each point, degrees; 0 for one ray."""
    centers = np.array([view.cam_from_world.center for view in views])
    observations = observations.take(np.argsort(observations.points, kind="stable"))
    rays = points[observations.points] - centers[observations.views]
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    rays = np.divide(rays, lengths, out=np.zeros_like(rays), where=lengths > 0)
    counts = np.bincount(observations.points, minlength=len(points))
    starts = np.cumsum(counts) - counts
    angles = np.zeros(len(points), dtype=np.float32)
    for count in np.unique(counts[counts > 1]).tolist():
        chosen = np.flatnonzero(counts == count)
        step = max(1, _MAX_DIRECTIONS // count**2)
        for block in np.split(chosen, range(step, len(chosen), step)):
            directions = rays[starts[block, None] + np.arange(count)]
            cosines = np.einsum("pix,pjx->pij", directions, directions).min(axis=(1, 2))
            angles[block] = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return angles


def _choose_origin(views: Sequence[View]) -> NDArray[np.float64]:
    """Return whole units near the photos if float32 would lose millimetres there, else zeros."""
    center = np.mean([view.cam_from_world.center for view in views], axis=0)
    far_off = np.abs(center).max() > 1000.0
    return np.asarray(np.round(center) if far_off else np.zeros(3), dtype=np.float64)
