"""What tests of several rooms share."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from time import sleep
from typing import Any

from clients import Instant, RigImage
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from service.telemetry.metrics import ServiceState
from visloc.archive import MapStore
from visloc.kapture import read_dataset

START = 1_700_000_000_000  # milliseconds


def quiet(_stage: str, _done: int, _total: int) -> None:
    pass


def copy_map(maps: Path, of: str, map_id: str, version: str) -> None:
    """Publish the current version of a map under another name, not made current."""
    target = maps / map_id / version
    shutil.copytree(MapStore(maps).folder(of), target)
    manifest = json.loads((target / "manifest.json").read_text()) | {
        "id": map_id,
        "version": version,
    }
    (target / "manifest.json").write_text(json.dumps(manifest))


def instants(photos: list[bytes], camera: Any) -> list[Instant]:
    return [
        Instant(START + 100 * i, (RigImage("camera", photo, camera),))
        for i, photo in enumerate(photos)
    ]


def write_study(folder: Path) -> None:
    """Write a dataset of another room: of the same shape, but other pictures, and another rig."""
    write_sample(folder, images=8, size=(256, 192), seed=1)
    for path in folder.rglob("sensors/*.txt"):
        path.write_text(re.sub(r"\brig,", "cart,", path.read_text()))


def add_study(study: Path, maps: Path) -> None:
    """Build the map ``study``, with the features of ``room``."""
    build_map(BuildSettings(study / "mapping", "study", maps, local_features="sift"), quiet)


def build_upright(dataset: Path, map_id: str, maps: Path) -> None:
    """Build a map with XFeat: SIFT would know a turned photo as it is."""
    settings = BuildSettings(
        dataset / "mapping",
        map_id,
        maps,
        method="rgbd",
        local_features="xfeat",
        max_keypoints=1500,
    )
    build_map(settings, quiet)


def photos_of(study: Path) -> list[Any]:
    """Photos of a dataset's queries with their cameras and poses."""
    dataset = read_dataset(study / "query")
    return [
        (
            dataset.path_of(record).read_bytes(),
            dataset.sensors[record.sensor_id].camera,
            dataset.pose(record),
        )
        for record in dataset.images
    ]


def state_of(doors: Any) -> ServiceState:
    async def state() -> ServiceState:
        return doors.server.state()

    loop = doors.server.engine._following.get_loop()
    return asyncio.run_coroutine_threadsafe(state(), loop).result(60)


def busy(state: ServiceState) -> int:
    return state.photos_waiting + state.photos_running


def wait_until(holds: Callable[[], bool]) -> None:
    while not holds():
        sleep(0.005)
