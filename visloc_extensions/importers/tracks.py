"""Measurements of points in photos, and checks against where the points project."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapping.importers.model import ImportedImage, ImportedModel
from visloc.errors import refuse
from visloc.kapture import Sensor
from visloc.pose.reprojection import project


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """Where points were seen, in the order of the file.

    Attributes:
        point: (M,) int64 index of the point.
        image: (M,) int64 index of the image.
        feature: (M,) int64 number of the feature in its image.
        xy: (M, 2) float64 position; its unit and origin are the reader's matter.
    """

    point: NDArray[np.int64]
    image: NDArray[np.int64]
    feature: NDArray[np.int64]
    xy: NDArray[np.float64]

    @staticmethod
    def from_rows(rows: Sequence[tuple[int, int, int, float, float]]) -> Measurements:
        """Make them of rows: point, image, feature, x, y."""
        indices = np.array([row[:3] for row in rows], np.int64).reshape(-1, 3)
        xy = np.array([row[3:] for row in rows], np.float64).reshape(-1, 2)
        return Measurements(indices[:, 0], indices[:, 1], indices[:, 2], xy)

    def __len__(self) -> int:
        return len(self.point)


def keypoints_of(
    measurements: Measurements, pixels: NDArray[np.float64], num_images: int, where: str
) -> tuple[list[NDArray[np.float32]], NDArray[np.int64]]:
    """Gather the measured features of each image as its keypoints.

    Args:
        pixels: (M, 2) their positions in our pixels.

    Returns:
        Per image (n, 2) keypoints, in the order of the feature numbers, and the observations
        (M, 3): point, image, row of the keypoint.
    """
    pairs = np.column_stack([measurements.image, measurements.feature])
    unique, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    moved = np.flatnonzero(np.abs(pixels[first][inverse] - pixels).max(axis=1, initial=0.0) > 0.01)
    if len(moved):
        image, feature = pairs[moved[0]]
        raise refuse(
            "import.feature_moved",
            field=where,
            got=f"{pixels[first][inverse][moved[0]].tolist()} and {pixels[moved[0]].tolist()}",
            feature=feature,
            image=image,
        )
    starts = np.searchsorted(unique[:, 0], np.arange(num_images + 1))
    positions = pixels[first].astype(np.float32)
    keypoints = [positions[start:end] for start, end in pairwise(starts)]
    rows = inverse - starts[measurements.image]
    return keypoints, np.column_stack([measurements.point, measurements.image, rows])


def projections(
    sensors: Mapping[str, Sensor],
    images: Sequence[ImportedImage],
    points: NDArray[np.float64],
    measurements: Measurements,
) -> NDArray[np.float64]:
    """Return where the measured points (M, 2) should be, in our pixels.

    NaN where the point is behind the image, or the image has no pose or no known camera.
    """
    expected = np.full((len(measurements), 2), np.nan)
    order = np.argsort(measurements.image, kind="stable")
    starts = np.searchsorted(measurements.image[order], np.arange(len(images) + 1))
    for image, (start, end) in zip(images, pairwise(starts), strict=True):
        camera = sensors[image.sensor].camera
        rows = order[start:end]
        if image.cam_from_world is None or camera is None or not len(rows):
            continue
        seen = image.cam_from_world.apply(points[measurements.point[rows]])
        front = seen[:, 2] > 0
        expected[rows[front]] = project(camera, seen[front])
    return expected


def reprojection_errors(model: ImportedModel) -> NDArray[np.float64]:
    """Return how far each observation is from its point's projection, (M,) pixels; NaN as above."""
    point, image, row = model.observations.T
    xy = np.array(
        [_keypoints(model.images[i])[r, :2] for i, r in zip(image, row, strict=True)], np.float64
    ).reshape(-1, 2)
    measurements = Measurements(point, image, row, xy)
    expected = projections(model.sensors, model.images, model.points, measurements)
    errors: NDArray[np.float64] = np.linalg.norm(xy - expected, axis=1)
    return errors


def _keypoints(image: ImportedImage) -> NDArray[np.float32]:
    if image.keypoints is None:
        raise ValueError(f"{image.name} has observations but no keypoints")
    return image.keypoints
