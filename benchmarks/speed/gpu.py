"""The networks and the whole query on a CUDA GPU, where there is one."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.speed.dataset import Bench
from visloc.archive import open_map
from visloc.features import make_local_features
from visloc.images import read_photo_file
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import Inference, LocalizeOptions

_SIZES = ((640, 480), (1024, 768), (1600, 1200))
_REPEATS = 20
_AT_ONCE = 8


def measure_gpu(bench: Bench, map_folder: Path) -> dict[str, Any]:
    """Seconds of r2d2 and faster2d2 by size of the photo, and of the whole query of the map."""
    dataset = read_dataset(bench.query)
    photos = [read_photo_file(dataset.path_of(record)) for record in dataset.images]
    extraction = []
    for name in ("r2d2", "faster2d2"):
        extractor = make_local_features(name, bench.weights_dir, Inference.TORCH)
        for width, height in _SIZES:
            rgb = np.asarray(cv2.resize(photos[0].rgb, (width, height)), np.uint8)
            seconds = []
            for _ in range(_REPEATS + 3):  # the first ones choose kernels
                torch.cuda.synchronize()
                started = time.perf_counter()
                extractor.extract(rgb, max_keypoints=5000)
                torch.cuda.synchronize()
                seconds.append(time.perf_counter() - started)
            row = {"network": name, "width": width, "height": height}
            extraction.append({**row, "seconds": float(np.median(seconds[3:]))})
    extractor = make_local_features(bench.features, bench.weights_dir, Inference.TORCH)
    localizer = Localizer(open_map(map_folder), extractor)
    cameras = [dataset.sensors[record.sensor_id].camera for record in dataset.images]

    def ask(number: int) -> float:
        started = time.perf_counter()
        localizer.localize(photos[number], cameras[number], LocalizeOptions())
        return time.perf_counter() - started

    for _ in range(2):  # the first time warms up
        latencies = [ask(number) for number in range(len(photos))]
    started = time.perf_counter()
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        list(pool.map(ask, range(len(photos))))
    return {
        "extraction": extraction,
        "query_p50": float(np.median(latencies)),
        "queries_per_second": len(photos) / (time.perf_counter() - started),
    }
