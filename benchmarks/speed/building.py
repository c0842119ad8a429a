"""Building the map in this process, with the time of each stage."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.speed.dataset import Bench
from benchmarks.speed.machine import num_threads
from mapping.methods.sfm_settings import SfmSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import open_map
from visloc.options import Inference

MAP_ID = "bench"
# What is no part of "without extraction": looking for features, and describing whole photos.
# Neither is in the peer's stages that this is compared with.
_LANDMARK_STAGES = ("depth", "landmarks", "pairs", "matches", "verified", "triangulation")
_ARCHIVE_STAGE = "archive"


class Stopwatch:
    """Seconds by stage, from what a build tells of its progress."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Note the time since the last call under the stage."""
        del done, total
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._since
        self._since = now


def build(bench: Bench, maps_dir: Path, inference: Inference = Inference.AUTO) -> dict[str, Any]:
    """Build the map from nothing; the seconds by stage, and what the map holds."""
    shutil.rmtree(maps_dir, ignore_errors=True)
    settings = BuildSettings(
        dataset=bench.mapping,
        map_id=MAP_ID,
        maps_dir=maps_dir,
        method="rgbd" if bench.has_depth else "sfm",
        local_features=bench.features,
        weights_dir=bench.weights_dir,
        inference=inference,
        sfm=SfmSettings(pairs=("distance",)),  # as the peer pairs photos
        workers=num_threads(),
    )
    watch = Stopwatch()
    folder = build_map(settings, watch)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    counts = open_map(folder).manifest.counts.model_dump()
    return {"seconds": watch.seconds, "counts": counts, "bytes": size}


def landmark_seconds(built: Mapping[str, Any]) -> tuple[float, float]:
    """Seconds from features to landmarks, and from landmarks to a published map."""
    seconds = built["seconds"]
    landmarks = sum(seconds.get(stage, 0.0) for stage in _LANDMARK_STAGES)
    return landmarks, seconds[_ARCHIVE_STAGE]
