"""Open one map, ask it, and tell seconds and memory as JSON: a process of ``benchmarks.scale``.

Queries are the features of photos of the map with noise, and as many keypoints that are nothing,
so that each has a true answer.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.large_map import GLOBAL_NOISE
from visloc.archive import Map, open_map
from visloc.evaluation import pose_error
from visloc.geometry import Pose
from visloc.localization.localizer import Localizer
from visloc.matching.products import start_threads
from visloc.options import LocalizeOptions
from visloc.retrieval.index import retrieve
from visloc.types import Localized, QueryFeatures

# What a query differs by from the photo that it was made from: pixels, and of each component of a
# local descriptor; a global one by as much as photos of the map differ.
PIXEL_NOISE, DESCRIPTOR_NOISE = 0.5, 0.03
MAX_ERROR_M, MAX_ERROR_DEG = 0.1, 1.0
TOP_K = 20


def main(folder: Path, queries: int = 100) -> None:
    """Open the map, ask it ``queries`` times, print."""
    start_threads()  # once in a process, whatever it opens
    started, before = time.perf_counter(), anonymous_mb()
    opened = open_map(folder)
    localizer = Localizer(opened, None)
    seconds_to_open = time.perf_counter() - started
    memory_open = anonymous_mb() - before
    localizer.warm_up()
    retrieval, whole, right = [], [], 0
    random = np.random.default_rng(0)
    for photo in random.integers(0, len(opened.images), queries).tolist():
        features = query_of(opened, photo, random)
        started = time.perf_counter()
        camera = opened.cameras[opened.images[photo].camera]
        answer = localizer.localize_features(features, camera, LocalizeOptions(top_k=TOP_K))
        whole.append(time.perf_counter() - started)
        retrieval.append(answer.evidence.seconds["retrieval"])
        if isinstance(answer, Localized):
            row = opened.image_poses[photo]
            truth = Pose.from_quaternion(row[:4], row[4:])
            metres, degrees = pose_error(answer.cam_from_world, truth)
            right += metres <= MAX_ERROR_M and degrees <= MAX_ERROR_DEG
    memory_after = anonymous_mb()
    typer.echo(
        json.dumps(
            {
                "photos": len(opened.images),
                "observations": opened.manifest.counts.observations,
                "landmarks": opened.manifest.counts.landmarks,
                "bytes": opened.size_bytes + (folder / "manifest.json").stat().st_size,
                "open_s": seconds_to_open,
                "open_mb": memory_open,
                "process_mb": memory_after,
                "retrieval_ms": percentiles_ms(retrieval),
                "query_ms": percentiles_ms(whole),
                "right": right / queries,
                **compared_with_all(opened, min(queries, 50), random),
            }
        )
    )


def query_of(opened: Map, photo: int, random: np.random.Generator) -> QueryFeatures:
    """The features of a photo as another photo from there would show them."""
    _, stored = opened.observations(photo)
    scale = np.float32(opened.manifest.local_features.descriptor_scale)
    descriptors = stored * scale if stored.dtype == np.int8 else stored
    camera = opened.cameras[opened.images[photo].camera]
    size = camera.width, camera.height
    keypoints = opened.keypoints(photo) + random.normal(0, PIXEL_NOISE, (len(descriptors), 2))
    other = descriptors[:, random.permutation(descriptors.shape[1])]
    both = np.concatenate([descriptors, other])
    return QueryFeatures(
        kind=opened.manifest.local_features.fingerprint.name,
        keypoints=np.clip(
            np.concatenate([keypoints, random.uniform(0, size, keypoints.shape)]), 0, size
        ),
        descriptors=both + random.normal(0, DESCRIPTOR_NOISE, both.shape),
        global_descriptors=described(opened, photo, random),
    )


def described(
    opened: Map, photo: int, random: np.random.Generator
) -> Mapping[str, NDArray[np.float32]]:
    """Global descriptors of a photo with noise."""
    query = {}
    for name, rows in opened.global_descriptors.items():
        noise = random.normal(size=rows.values.shape[1])
        noisy = rows[photo] + GLOBAL_NOISE * noise / np.linalg.norm(noise)
        query[name] = (noisy / np.linalg.norm(noisy)).astype(np.float32)
    return query


def compared_with_all(
    opened: Map, queries: int, random: np.random.Generator
) -> dict[str, float | list[float]]:
    """How many of the best photos of an exact search are found, and how long that takes."""
    index = opened.global_descriptors
    every = {name: replace(rows, inverted=None) for name, rows in index.items()}
    seconds, found = [], 0
    for photo in random.integers(0, len(opened.images), queries).tolist():
        query = described(opened, photo, random)
        started = time.perf_counter()
        best = retrieve(query, every, TOP_K)
        seconds.append(time.perf_counter() - started)
        found += len(np.intersect1d(best.images, retrieve(query, index, TOP_K).images))
    most = queries * min(TOP_K, len(opened.images))
    return {"exact_ms": percentiles_ms(seconds), "recall": found / most}


def percentiles_ms(seconds: list[float]) -> list[float]:
    """Median and 95th percentile, in milliseconds."""
    return [float(value) for value in 1e3 * np.percentile(seconds, [50, 95])]


def anonymous_mb() -> float:
    """Memory of this process that is not mapped from files, in 10^6 bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (kib,) = (line.split()[1] for line in lines if line.startswith("RssAnon:"))
    return int(kib) * 1024 / 1e6


if __name__ == "__main__":
    typer.run(main)
