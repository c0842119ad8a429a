"""Our queries in this process, stage by stage, in several ways side by side."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.speed.dataset import Bench
from benchmarks.speed.limits import NETWORKS, megapixels
from benchmarks.speed.machine import num_threads
from visloc.archive import open_map
from visloc.evaluation import pose_error
from visloc.features import LocalFeatureExtractor, make_local_features
from visloc.kapture import Dataset, FileRecord, read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import Extraction, Inference, LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.types import Localized

_ALL_KEYPOINTS = 10**6


@dataclass(frozen=True, slots=True)
class Way:
    """One way to compute features, of the map and of queries; what follows is the same."""

    label: str
    inference: Inference
    extraction: Extraction


TORCH = "plain torch, fp32, `accurate`"
DEFAULT = "`default`"
WAYS: Sequence[Way] = (
    Way(TORCH, Inference.TORCH, Extraction.ACCURATE),
    Way("`accurate`", Inference.AUTO, Extraction.ACCURATE),
    Way(DEFAULT, Inference.AUTO, Extraction.DEFAULT),
    Way("`fast`", Inference.AUTO, Extraction.FAST),
)


class Queries:
    """The ways, warm.

    Args:
        bench: the queries.
        map_folders: the map by how its features were computed; each way has its own.
    """

    def __init__(self, bench: Bench, map_folders: Mapping[Inference, Path]) -> None:
        self._dataset = read_dataset(bench.query)
        self._features = bench.features
        self._extractors: Mapping[Inference, LocalFeatureExtractor] = {
            inference: make_local_features(
                bench.features, bench.weights_dir, inference, num_threads()
            )
            for inference in map_folders
        }
        localizers = {
            inference: Localizer(open_map(map_folders[inference]), extractor)
            for inference, extractor in self._extractors.items()
        }
        self._localizers = {way: localizers[way.inference] for way in WAYS}
        for way in WAYS:
            self._ask(way, self._dataset.images[0], 0)

    def ask_all(self, seed: int) -> dict[str, list[dict[str, Any]]]:
        """Ask every query in every way, one way after the other; the answers by way."""
        answers: dict[str, list[dict[str, Any]]] = {way.label: [] for way in WAYS}
        for record in self._dataset.images:
            for way in WAYS:
                answers[way.label].append(self._ask(way, record, seed))
        return answers

    def describe(self) -> dict[str, dict[str, Any]]:
        """What computes the features of each way, and how many pixels its network looks at."""
        record = self._dataset.images[0]
        rgb = read_photo_file(self._dataset.path_of(record)).rgb
        height, width = rgb.shape[:2]
        described = {}
        for way in WAYS:
            extractor = self._extractors[way.inference]
            pixels = None
            if self._features in NETWORKS:
                found = extractor.extract(
                    rgb, max_keypoints=_ALL_KEYPOINTS, extraction=way.extraction
                )
                pixels = megapixels(NETWORKS[self._features], width, height, found.scales)
            described[way.label] = {
                "computed_with": extractor.computed_with,
                "descriptor_dim": extractor.descriptor_dim,
                "megapixels": pixels,
                "photo": [width, height],
            }
        return described

    def _ask(self, way: Way, record: FileRecord, seed: int) -> dict[str, Any]:
        options = LocalizeOptions(extraction=way.extraction, seed=seed)
        return answer_to(self._localizers[way], self._dataset, record, options)


def answer_to(
    localizer: Localizer, dataset: Dataset, record: FileRecord, options: LocalizeOptions
) -> dict[str, Any]:
    """Ask about one photo: its answer, with the seconds of each stage and the error."""
    camera, truth = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
    started = time.perf_counter()
    photo = read_photo_file(dataset.path_of(record))
    decoded = time.perf_counter()
    answer = localizer.localize(photo, camera, options)
    ended = time.perf_counter()
    error = None
    if isinstance(answer, Localized) and truth is not None:
        error = pose_error(answer.cam_from_world, truth)
    return {
        "name": record.path,
        "total": ended - started,
        "seconds": {"decode": decoded - started, **answer.evidence.seconds},
        "keypoints": answer.evidence.num_keypoints,
        "correspondences": answer.evidence.num_correspondences,
        "inliers": answer.evidence.num_inliers,
        "error": error,
    }
