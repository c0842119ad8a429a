"""How well features match between two looks at photos that were held back: the truth is exact."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from visloc.features import LocalFeatureExtractor, make_local_features
from visloc.matching.correspondences import mutual_nearest_neighbours
from visloc.matching.products import round_descriptors
from visloc.options import Extraction, Inference
from visloc_extensions.training.atlas import levels_to_look_at, look, make_atlas
from visloc_extensions.training.augmentation import augment
from visloc_extensions.training.checkpoint import State
from visloc_extensions.training.conditions import draw_conditions
from visloc_extensions.training.export import export
from visloc_extensions.training.homographies import Matrices, moved, random_looks
from visloc_extensions.training.photos import Photo

THRESHOLDS_PX = (1.0, 3.0, 5.0)
SIDE_PX = 320
SEED = 17
_STRENGTH = 1.0  # looks as different as the hardest in training
_CPU = torch.device("cpu")


@dataclass(frozen=True, slots=True)
class Change:
    """What happens to the photos of pairs.

    Attributes:
        night_share: of the photos, at night.
        weather_share: of those that may have weather.
        first_too: whether it happens to first photos; if not, they are unaltered, as in a map.
        second_too: whether it happens to second photos.
    """

    night_share: float
    weather_share: float
    first_too: bool
    second_too: bool = True


CHANGES = {
    "mixed": Change(0.35, 0.7, first_too=True),
    "none": Change(0.0, 0.0, first_too=False, second_too=False),
    "day": Change(0.0, 0.0, first_too=False),
    "night": Change(1.0, 0.0, first_too=False),
    "weather": Change(0.0, 1.0, first_too=False),
}


@dataclass(frozen=True, slots=True)
class Score:
    """Means over all pairs.

    Attributes:
        matching_accuracy: share of the mutual nearest neighbours that are right to within each
            of ``THRESHOLDS_PX``; 0 for a pair without any.
        right_matches: number of those within 3 px.
        repeatability: share of the keypoints of the first image that are seen in the second and
            have a keypoint there within 3 px.
    """

    matching_accuracy: tuple[float, ...]
    right_matches: float
    keypoints: float
    repeatability: float


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two looks at a photo.

    Attributes:
        first: (H, W, 3) uint8.
        second: (H, W, 3) uint8.
        second_from_first: (3, 3) homography of pixels.
    """

    first: NDArray[np.uint8]
    second: NDArray[np.uint8]
    second_from_first: Matrices


def validation_pairs(
    photos: Sequence[Photo], per_photo: int = 1, change: Change = CHANGES["mixed"]
) -> list[Pair]:
    """Make pairs of 320 px that depend on nothing but the photos and their order."""
    pairs = []
    for number, photo in enumerate(photos):
        for repeat in range(per_photo):
            rng = np.random.default_rng([SEED, number, repeat])
            atlas = make_atlas([photo], _CPU)
            looks = np.concatenate(random_looks(rng, atlas.sizes[:, 0], SIDE_PX, _STRENGTH))
            levels = levels_to_look_at(atlas, np.zeros(2, np.int64), looks, SIDE_PX)
            begins, sizes, matrices = (torch.from_numpy(each) for each in levels)
            seen = look(atlas.pixels, begins, sizes, matrices, SIDE_PX)
            shares = change.night_share, change.weather_share
            changed = augment(seen, draw_conditions(rng, 2, _STRENGTH, *shares))
            first = changed[0] if change.first_too else seen[0]
            second = changed[1] if change.second_too else seen[1]
            pairs.append(Pair(_pixels(first), _pixels(second), np.linalg.inv(looks[1]) @ looks[0]))
    return pairs


def _pixels(image: torch.Tensor) -> NDArray[np.uint8]:
    rounded = (image * 255).round().clamp(0, 255).to(torch.uint8)
    return np.ascontiguousarray(rounded.permute(1, 2, 0).cpu().numpy())


def validate(
    extractor: LocalFeatureExtractor,
    pairs: Sequence[Pair],
    *,
    of_first: LocalFeatureExtractor | None = None,
    max_keypoints: int = 1000,
) -> Score:
    """Match each pair by mutual nearest neighbours, and compare with the truth.

    Args:
        extractor: of the second photos, and of the first ones unless they have their own.
        of_first: of the first photos, as when a map has other weights than its queries.
    """
    rows = [_scored((of_first or extractor, extractor), pair, max_keypoints) for pair in pairs]
    means = np.mean(rows, axis=0).tolist()
    count = len(THRESHOLDS_PX)
    return Score(tuple(means[:count]), *means[count:])


def _scored(
    extractors: tuple[LocalFeatureExtractor, LocalFeatureExtractor], pair: Pair, max_keypoints: int
) -> list[float]:
    first, second = (
        extractor.extract(rgb, max_keypoints=max_keypoints, extraction=Extraction.ACCURATE)
        for extractor, rgb in zip(extractors, (pair.first, pair.second), strict=True)
    )
    if not len(first) or not len(second):
        return [0.0] * len(THRESHOLDS_PX) + [0.0, (len(first) + len(second)) / 2, 0.0]
    there = moved(pair.second_from_first, first.keypoints.astype(np.float64))
    gaps = np.linalg.norm(there[:, None] - second.keypoints[None], axis=2)
    in_first, in_second, _ = mutual_nearest_neighbours(
        round_descriptors(first.descriptors), round_descriptors(second.descriptors)
    )
    errors = gaps[in_first, in_second]
    height, width = pair.second.shape[:2]
    inside = ((there >= 0) & (there < [width, height])).all(axis=1)
    accuracy = [float((errors < limit).mean()) if len(errors) else 0.0 for limit in THRESHOLDS_PX]
    return [
        *accuracy,
        float((errors < 3.0).sum()),
        (len(first) + len(second)) / 2,
        float((gaps[inside].min(axis=1) < 3.0).mean()) if inside.any() else 0.0,
    ]


def features_of(state: State) -> LocalFeatureExtractor:
    """Return what ``visloc`` makes of a checkpoint, as it will be shipped."""
    with tempfile.TemporaryDirectory() as folder:
        name = state.settings.architecture
        export(state, Path(folder) / f"{name}.safetensors")
        return make_local_features(name, Path(folder), Inference.TORCH)
