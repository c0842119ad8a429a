"""Shared by Bundler and NVM: photo sizes from the files, measurements from the photo's centre."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.importers.model import ImportedImage, ImportedModel
from visloc.errors import refuse
from visloc.kapture import Sensor
from visloc_extensions.importers.tracks import Measurements, keypoints_of, projections

# A measurement agrees with a camera if the point projects this near to it, in image diagonals.
# Reconstructions keep far better ones only; a wrong origin is off by half a diagonal.
_AGREES = 0.01


def note_on_absent(path: Path, photos: Path, names: list[str], kept: list[int]) -> list[str]:
    """Say which photos are absent, and refuse a model without any."""
    absent = sorted(set(range(len(names))) - set(kept))
    if not absent:
        return []
    if not kept:
        raise refuse("import.no_photos", field=str(path), expected=f"{photos / names[0]}")
    some = ", ".join(names[index] for index in absent[:3]) + (", ..." if len(absent) > 3 else "")
    return [f"{len(absent)} of {len(names)} photos are absent and were left out: {some}"]


def kept_measurements(measurements: Measurements, kept: list[int], num_images: int) -> Measurements:
    """Return the measurements in the kept images, by these images' new indices."""
    renumbered = np.full(num_images, -1, np.int64)
    renumbered[kept] = np.arange(len(kept))
    image = renumbered[measurements.image]
    stay = image >= 0
    return Measurements(
        measurements.point[stay], image[stay], measurements.feature[stay], measurements.xy[stay]
    )


def with_measurements(
    path: Path, model: ImportedModel, measurements: Measurements, centers: NDArray[np.float64]
) -> ImportedModel:
    """Return the model with keypoints and observations, unless they contradict its geometry."""
    pixels, notes = _pixels(model.sensors, model.images, model.points, measurements, centers)
    if pixels is None:
        return replace(model, notes=model.notes + notes)
    if not len(measurements):
        return model
    keypoints, observations = keypoints_of(measurements, pixels, len(model.images), str(path))
    images = tuple(
        replace(image, keypoints=k) for image, k in zip(model.images, keypoints, strict=True)
    )
    return replace(model, images=images, observations=observations, notes=model.notes + notes)


def _pixels(
    sensors: Mapping[str, Sensor],
    images: Sequence[ImportedImage],
    points: NDArray[np.float64],
    measurements: Measurements,
    centers: NDArray[np.float64],
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Turn measurements that count from the centre of the image into pixels.

    Bundler and NVM count from the centre by definition, but there are files, the Aachen ones
    among them, that count from the top-left corner. The model's own geometry tells which.

    Args:
        images: the photos; their keypoints are not looked at.
        points: (P, 3) in the world.
        measurements: x to the right and y down from the origin, in pixels.
        centers: (I, 2) of each image, in our pixels.

    Returns:
        The pixels (M, 2) and notes; None if the measurements agree with neither origin.
    """
    if not len(measurements):
        return measurements.xy, ()
    expected = projections(sensors, images, points, measurements)
    diagonals = np.array([math.hypot(*(sensors[i.sensor].image_size or (0, 0))) for i in images])
    allowed = _AGREES * diagonals[measurements.image]
    testable = np.array([sensors[image.sensor].camera is not None for image in images])
    num_testable = max(int(testable[measurements.image].sum()), 1)

    def share_agreeing(pixels: NDArray[np.float64]) -> float:
        errors = np.linalg.norm(pixels - expected, axis=1)
        return float((errors <= allowed).sum() / num_testable)  # NaN does not agree

    from_center = measurements.xy + centers[measurements.image]
    center, corner = share_agreeing(from_center), share_agreeing(measurements.xy)
    if max(center, corner) < 0.5:
        return None, (
            f"the {len(measurements)} measurements were left out: the points project to "
            f"{center:.0%} of them when they count from the centre of the image, and to "
            f"{corner:.0%} when they count from its top-left corner",
        )
    if corner > center:
        return measurements.xy, (
            f"measurements count from the top-left corner: the points project to {corner:.0%} of "
            f"them so, and to {center:.0%} from the centre of the image, as the format has it",
        )
    return from_center, ()
