"""The service's engine in this process, without its doors."""

from __future__ import annotations

from pathlib import Path

from service.engine.engine import Engine
from service.telemetry.metrics import Metrics
from service.values import WorkerSettings
from visloc.archive import MapStore
from visloc.photos.reading import ImageLimits


def engine_of(
    store: MapStore, weights_dir: Path | None, *, workers: int = 1, threads: int = 2
) -> Engine:
    """Return an engine that was not started yet."""
    limits = ImageLimits()
    settings = WorkerSettings(
        weights_dir=weights_dir,
        threads=threads,
        max_loaded_bytes=2**33,
        max_images=16,
        max_instants=1000,
        max_image_bytes=limits.max_bytes,
        max_image_pixels=limits.max_pixels,
    )
    return Engine(store, settings, workers=workers, metrics=Metrics(), on_overdue=lambda: None)
