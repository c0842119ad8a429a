"""How well queries are localized in two versions of a map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.frames.stored_queries import match_stored, solve_stored
from mapping.own_test.held_out import left_out_sets, vanishing
from mapping.stages.photos import read_in_frame
from visloc.archive import Map
from visloc.errors import refuse
from visloc.evaluation import Threshold, median_errors_localized, pose_error
from visloc.features import GlobalDescriptor, LocalFeatureExtractor
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import MapGeometry
from visloc.localization.query.feature_cache import FeatureCache
from visloc.options import LocalizeOptions
from visloc.retrieval.index import retrieve
from visloc.types import Localized
from visloc_extensions.living_maps.pruning.choosing import Kept

# The bins of docs/results.md.
BINS = (Threshold(0.05, 5.0), Threshold(0.25, 2.0), Threshold(0.5, 5.0))
# Photos that are localized in the map without themselves. In larger maps every n-th photo is.
_MAX_HELD_OUT = 100

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Accuracy:
    """How well queries were localized.

    Attributes:
        errors: of those that were localized, units of the world and degrees.
    """

    queries: int
    errors: tuple[tuple[float, float], ...]

    def within(self, threshold: Threshold) -> int:
        """Return how many queries are within a bin."""
        return sum(
            position <= threshold.max_position_error_m
            and angle <= threshold.max_orientation_error_deg
            for position, angle in self.errors
        )

    @property
    def medians(self) -> tuple[float, float]:
        """The median errors of the localized queries; NaN if there are none."""
        return median_errors_localized(self.errors)


def lost(before: Accuracy, after: Accuracy, *, metric: bool) -> int:
    """The most queries that any bin lost, or that are no longer localized."""
    counts = [len(before.errors) - len(after.errors)]
    if metric:
        counts += [before.within(one) - after.within(one) for one in BINS]
    return max(counts)


def of_queries(
    maps: Sequence[Map],
    queries: Path,
    extractor: LocalFeatureExtractor,
    make_descriptor: Callable[[str], GlobalDescriptor],
    progress: Progress,
) -> list[Accuracy]:
    """Localize the posed photos of a dataset in each of some maps with the same local features."""
    dataset = read_dataset(queries)
    records = [record for record in dataset.images if dataset.pose(record) is not None]
    if not records:
        raise refuse("prune.queries", field="--queries", got=str(queries))
    localizers = [Localizer(opened, extractor, make_descriptor) for opened in maps]
    errors: list[list[tuple[float, float]]] = [[] for _ in maps]
    for done, record in enumerate(records):
        progress(done, len(records))
        sensor, truth = dataset.sensors[record.sensor_id], dataset.pose(record)
        assert truth is not None
        assert sensor.image_size is not None  # what a camera has
        photo = read_in_frame(dataset.path_of(record), sensor.image_size, sensor.id)
        found = FeatureCache()
        for localizer, own in zip(localizers, errors, strict=True):
            answer = localizer.localize(photo, sensor.camera, LocalizeOptions(), cache=found)
            if isinstance(answer, Localized):
                own.append(pose_error(answer.cam_from_world, truth))
    progress(len(records), len(records))
    return [Accuracy(len(records), tuple(own)) for own in errors]


def of_held_out_photos(
    before: Map, after: Map, kept: Kept, progress: Progress
) -> tuple[Accuracy, Accuracy]:
    """Localize photos of a map in it and in a part of it, without themselves and those beside them.

    What the whole map keeps of a photo is the query for both.
    """
    stays = np.zeros(len(before.landmarks), np.bool_)
    stays[before.observation_landmarks[kept.observations]] = True
    photo_rows = np.where(kept.images, np.cumsum(kept.images) - 1, -1)
    landmark_rows = np.where(stays, np.cumsum(stays) - 1, -1)
    viewpoints = MapGeometry(before).viewpoints
    geometries = MapGeometry(before), MapGeometry(after)
    chosen = np.linspace(0, len(photo_rows) - 1, min(len(photo_rows), _MAX_HELD_OUT)).astype(int)
    count = 0
    errors: tuple[list[tuple[float, float]], ...] = ([], [])
    for done, image in enumerate(chosen.tolist()):
        progress(done, len(chosen))
        sets = left_out_sets(before, viewpoints, image)
        if not sets:
            continue
        count += 1
        left_out = sets[min(1, len(sets) - 1)]
        gone = vanishing(before, left_out)
        there, gone_there = photo_rows[left_out], landmark_rows[gone]
        for own, geometry, photos, landmarks in (
            (errors[0], geometries[0], left_out, gone),
            (errors[1], geometries[1], there[there >= 0], gone_there[gone_there >= 0]),
        ):
            found = _localized(before, image, geometry, photos, landmarks)
            if found is not None:
                own.append(pose_error(found, viewpoints.pose(image)))
    progress(len(chosen), len(chosen))
    return Accuracy(count, tuple(errors[0])), Accuracy(count, tuple(errors[1]))


def _localized(
    source: Map,
    image: int,
    geometry: MapGeometry,
    left_out: NDArray[np.int64],
    gone: NDArray[np.int64],
) -> Pose | None:
    target = geometry.opened
    remaining = np.ones(len(target.images))
    remaining[left_out] = 0.0
    if not remaining.any():
        return None
    options, rows = LocalizeOptions(), source.global_descriptors
    query = {name: rows[name][image] for name in source.fusion.counted(rows)}
    retrieved = retrieve(query, target.global_descriptors, options.top_k, remaining, source.fusion)
    matched = match_stored(source, image, geometry, retrieved.images.tolist(), gone)
    solved = solve_stored(source, image, geometry, matched, options)
    if solved.answer.refusal is not None or solved.pose is None:
        return None
    return solved.pose.rig_from_world
