"""Maps of any size without photos, from the descriptors of a real one (``benchmarks.scale``).

A large map is a street of places, ten metres apart. Each place has the photos, the landmarks and
the tracks of the real map; its descriptors are the real ones with their dimensions permuted, so
that every place looks different, and noise, so that nothing is there twice. Global descriptors have
as many dimensions as the real ones would have in a map of that size: a place shares one direction,
within it photos look alike as in the real map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.archive import (
    GlobalFeatures,
    ImageRecord,
    Landmarks,
    Map,
    MapContent,
    pose_row,
    write_map,
)
from visloc.features.descriptors.vlad import VOCABULARY_SIZE
from visloc.features.descriptors.whitening import WHITENING_MAX_DIMS
from visloc.geometry import Pose

PITCH_M = 10.0
# Of one component of a descriptor, beside what the same landmark's descriptors differ anyway.
LOCAL_NOISE = 0.02
# Whole global descriptors: how far a photo of one place is from that of another, relative to how
# far places are apart, and what noise adds to the length of one.
PLACE_SHARE = 1.0
GLOBAL_NOISE = 0.2
# Places whose descriptors are made anew; the others are these, with their dimensions rotated.
_NUM_VARIANTS = 8
_VLAD_DIMS = VOCABULARY_SIZE * 128


@dataclass(frozen=True, eq=False)
class Place:
    """What is repeated: photos of the real map with some of their observations.

    Attributes:
        photos: rows of the real map's photos.
        landmarks: rows of its landmarks.
        offsets: (p + 1,) of the next three, by photo.
        observed: rows of ``landmarks``.
        keypoints: (m, 2) pixels.
        descriptors: (m, D) float32.
    """

    photos: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    offsets: NDArray[np.int64]
    observed: NDArray[np.int64]
    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]


def choose_place(source: Map, per_photo: int, num_photos: int, seed: int = 0) -> Place:
    """Choose landmarks with all their observations, so many that photos have ``per_photo``."""
    random = np.random.default_rng(seed)
    photos = np.arange(min(num_photos, len(source.images)))
    stop = source.observation_offsets[len(photos)]
    observed = source.observation_landmarks[:stop].astype(np.int64)
    seen = np.bincount(observed, minlength=len(source.landmarks))
    order = random.permutation(np.flatnonzero(seen))
    enough = int(np.searchsorted(np.cumsum(seen[order]), per_photo * len(photos))) + 1
    landmarks = np.sort(order[:enough])
    kept = np.flatnonzero(np.isin(observed, landmarks))
    scale = np.float32(source.manifest.local_features.descriptor_scale)
    keypoints = np.concatenate([source.keypoints(int(photo)) for photo in photos])
    return Place(
        photos,
        landmarks,
        np.searchsorted(kept, source.observation_offsets[: len(photos) + 1]),
        np.searchsorted(landmarks, observed[kept]),
        keypoints[kept],
        source.observation_descriptors[kept].astype(np.float32) * scale,
    )


def write_large_map(
    source: Map, folder: Path, work: Path, num_photos: int, per_photo: int = 500
) -> None:
    """Write a map; no more than a few hundred megabytes of it are ever in memory.

    Args:
        source: the real map.
        folder: where to; new.
        work: an empty folder for arrays on their way.
        num_photos: of the new map.
        per_photo: observations of a photo, on average.
    """
    place = choose_place(source, per_photo, num_photos)
    num_places = -(-num_photos // len(place.photos))
    last = num_photos - (num_places - 1) * len(place.photos)  # photos of the last place
    manifest = source.manifest
    folder.mkdir()
    write_map(
        folder,
        MapContent(
            metric=True,
            method="generated",
            settings={"from": source.ref, "per_photo": per_photo},
            notes=("generated from the descriptors of another map",),
            cameras=source.cameras,
            rigs={},
            images=_images(source, place, num_photos),
            image_poses=_poses(source, place, num_photos),
            landmarks=_landmarks(source, place, work, num_places, last),
            local_fingerprint=manifest.local_features.fingerprint,
            max_keypoints=manifest.local_features.max_keypoints,
            descriptor_dim=manifest.local_features.descriptor_dim,
            descriptors=lambda: _descriptors(place, num_places, last),
            global_features=tuple(
                _global(source, place, work, name, num_photos) for name in source.global_descriptors
            ),
        ),
        map_id=f"generated-{num_photos}",
        version="v1",
        created="2026-01-01T00:00:00+00:00",
    )


def _images(source: Map, place: Place, num_photos: int) -> tuple[ImageRecord, ...]:
    records = [source.images[int(photo)] for photo in place.photos]
    made = []
    for row in range(num_photos):
        number, photo = divmod(row, len(records))
        record = records[photo]
        name = f"place-{number:05d}/{record.name}"
        made.append(ImageRecord(name=name, camera=record.camera, timestamp=row))
    return tuple(made)


def _poses(source: Map, place: Place, num_photos: int) -> NDArray[np.float64]:
    rows = source.image_poses[place.photos]
    poses = [Pose.from_quaternion(row[:4], row[4:]) for row in rows]
    made = []
    for row in range(num_photos):
        number, photo = divmod(row, len(poses))
        pose, shift = poses[photo], np.array([PITCH_M * number, 0.0, 0.0])
        made.append(pose_row(Pose(pose.rotation, pose.translation - pose.rotation @ shift)))
    return np.array(made)


def _landmarks(source: Map, place: Place, work: Path, num_places: int, last: int) -> Landmarks:
    num_points, num_last = len(place.landmarks), int(place.offsets[last])
    num_observed = (num_places - 1) * len(place.observed) + num_last
    points = _mapped(work / "points.npy", np.float32, (num_places * num_points, 3))
    observed = _mapped(work / "observed.npy", np.uint32, (num_observed,))
    keypoints = _mapped(work / "keypoints.npy", np.float32, (num_observed, 2))
    for number in range(num_places):
        shift = np.array([PITCH_M * number, 0, 0], np.float32)
        points[number * num_points :][:num_points] = source.landmarks[place.landmarks] + shift
        count = num_last if number == num_places - 1 else len(place.observed)
        rows = slice(number * len(place.observed), number * len(place.observed) + count)
        observed[rows] = place.observed[:count] + number * num_points
        keypoints[rows] = place.keypoints[:count]
    counts = np.tile(np.diff(place.offsets), num_places)[: (num_places - 1) * len(place.photos)]
    counts = np.concatenate([counts, np.diff(place.offsets)[:last]])

    def repeated(values: NDArray[Any]) -> NDArray[Any]:
        return np.tile(values[place.landmarks], num_places)

    return Landmarks(
        origin=np.array(source.manifest.world.origin),
        points=points,
        track_lengths=repeated(source.track_lengths),
        errors_px=repeated(source.errors_px),
        angles_deg=repeated(source.angles_deg),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        observed=observed,
        keypoints=keypoints,
    )


def _descriptors(place: Place, num_places: int, last: int) -> Iterator[NDArray[np.float32]]:
    """The descriptors of one place after the other; the same whenever they are asked for."""
    dim = place.descriptors.shape[1]
    variants = []
    for seed in range(min(_NUM_VARIANTS, num_places)):
        random = np.random.default_rng(seed)
        noise = random.normal(0, LOCAL_NOISE, place.descriptors.shape)
        rows = place.descriptors[:, random.permutation(dim)] + noise.astype(np.float32)
        variants.append(_unit(rows))
    for number in range(num_places):
        rows = variants[number % _NUM_VARIANTS]
        rotated = np.roll(rows, 17 * (number // _NUM_VARIANTS), axis=1)
        yield rotated[: place.offsets[last]] if number == num_places - 1 else rotated


def _global(source: Map, place: Place, work: Path, name: str, num_photos: int) -> GlobalFeatures:
    """Rows and a model of as many dimensions as whitening leaves in a map of that size."""
    random = np.random.default_rng(1)
    real = source.global_descriptors[name][place.photos]
    dim = max(min(num_photos - 1, WHITENING_MAX_DIMS), real.shape[1])
    rows = _mapped(work / f"{name}.npy", np.float32, (num_photos, dim))
    for start in range(0, num_photos, len(real)):
        block = rows[start : start + len(real)]
        # The real rows turned into a subspace of this place: cosines stay as they are.
        columns = random.permutation(dim)[: real.shape[1]]
        turned = np.zeros((len(block), dim), np.float32)
        turned[:, columns] = real[: len(block)] * random.choice([-1, 1], real.shape[1])
        center = _unit(random.normal(size=(1, dim)).astype(np.float32))
        noise = _unit(random.normal(size=block.shape).astype(np.float32))
        block[:] = _unit(PLACE_SHARE * center + turned + GLOBAL_NOISE * noise)
    record = next(r for r in source.manifest.global_features if r.fingerprint.name == name)
    model = dict(source.global_models[name])
    if "axes" in model:
        axes = random.normal(0, 1 / 128, (len(model["mean"]), dim))
        model["axes"] = axes.astype(np.float32)
    return GlobalFeatures(record.fingerprint, rows, model)


def _mapped(path: Path, dtype: type[np.generic], shape: tuple[int, ...]) -> NDArray[Any]:
    return np.lib.format.open_memmap(path, "w+", np.dtype(dtype), shape)


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)
