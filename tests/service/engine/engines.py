"""Engines for tests, and what is asked of them."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar

from service.engine.engine import Engine
from service.telemetry.metrics import Metrics
from service.telemetry.observer import Observer
from service.values import RigJob, WorkerSettings, photo_job
from service.workers.tasks import Vision
from visloc.archive import MapStore
from visloc.geometry import Camera
from visloc.options import LocalizeOptions
from visloc.photos.reading import ImageLimits

T = TypeVar("T")


class Query(Protocol):
    image: bytes
    camera: Camera


LIMITS = ImageLimits()


def make(
    maps_dir: Path, *, limits: ImageLimits = LIMITS, max_instants: int = 1000, **settings: Any
) -> Engine:
    of_workers = WorkerSettings(
        weights_dir=None,
        threads=1,
        max_loaded_bytes=settings.pop("max_loaded_bytes", 2**30),
        max_images=16,
        max_instants=max_instants,
        max_image_bytes=limits.max_bytes,
        max_image_pixels=limits.max_pixels,
    )
    observer = Observer(Metrics())
    return Engine(
        MapStore(maps_dir),
        of_workers,
        metrics=observer.metrics,
        on_overdue=observer.worker_ended,
        **settings,
    )


async def until(happened: Callable[[], bool], seconds: float = 20.0) -> None:
    async with asyncio.timeout(seconds):
        while not happened():
            await asyncio.sleep(0.02)


@asynccontextmanager
async def held_back(engine: Engine) -> AsyncIterator[None]:
    """Stop the worker processes for a while, as a busy machine does."""
    # Each has just answered, so none is being pinged, and the next task is the next it takes.
    await engine.workers.run_everywhere(Vision.ping)
    pids = engine.workers.pids
    try:
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        yield
    finally:
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


def run(coroutine: Coroutine[Any, Any, T]) -> T:
    return asyncio.run(coroutine)


Play = Callable[[Engine], Coroutine[Any, Any, None]]
WithEngine = Callable[[Play], None]


@contextmanager
def started(maps_dir: Path, **settings: Any) -> Iterator[WithEngine]:
    """Start an engine, and give what plays with it."""
    with asyncio.Runner() as runner:
        engine = make(maps_dir, **settings)
        runner.run(engine.start())
        try:
            yield lambda play: runner.run(play(engine))
        finally:
            runner.run(engine.close())


def job_for(query: Query, ref: str = "room") -> RigJob:
    return photo_job((ref,), query.image, query.camera, LocalizeOptions())


def publish(maps_dir: Path, version: str, map_id: str = "room") -> None:
    """Make a copy of the current version and switch to it."""
    source = MapStore(maps_dir).folder("room")
    target = maps_dir / map_id / version
    shutil.copytree(source, target)
    manifest = json.loads((target / "manifest.json").read_text())
    manifest |= {"id": map_id, "version": version}
    (target / "manifest.json").write_text(json.dumps(manifest))
    (maps_dir / map_id / "current").write_text(version)
