"""Prometheus metrics: counters of events and gauges of the current state.

Nothing here is global. No label holds a caller's words: routes are templates, codes and stages are
the service's own, maps are those that answered.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import generate_latest

import visloc
from service.machine import memory_limit
from service.telemetry.process_memory import resident_memory
from visloc.errors import VislocError

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
LOCALIZED = "localized"
# Maps after the first MAX_MAPS share one label, so that uploads cannot fill Prometheus.
MAX_MAPS = 200
OTHER_MAPS = "(others)"
# The label of callers without a key, which a service without keys has.
NO_KEY = "(none)"

_HELP = "help"
LabelsT = TypeVar("LabelsT", bound=tuple[str, ...])

_REQUEST_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
_STAGE_BUCKETS = (0.001, 0.0025, 0.005, *_REQUEST_BUCKETS[:-1])
_INLIER_BUCKETS = (0, 10, 20, 30, 50, 75, 100, 150, 250, 500, 1000, 2500)


def _gauge_field(help_text: str) -> Any:
    """Declare a number of ``ServiceState`` that is a gauge of the same name."""
    return field(default=0, metadata={_HELP: help_text})


@dataclass(frozen=True, slots=True)
class ServiceState:
    """The service at one moment.

    Attributes:
        loaded_maps: bytes of each map that is open in a worker, by (id, version).
        unusable_maps: the error code of each map that exists and cannot be served, by id.
        certificate_ends: when the TLS certificate expires, seconds since 1970; None without TLS.
        folders: on disks that may fill up, by purpose: ``maps``, ``cache``.
    """

    ready: bool = _gauge_field("1 when maps and networks are warm.")
    draining: bool = _gauge_field("1 while running requests end and no new ones are accepted.")
    photos_waiting: int = _gauge_field("Photos waiting for a worker.")
    max_queue: int = _gauge_field("Limit of photos waiting.")
    photos_running: int = _gauge_field("Photos being processed.")
    batches_running: int = _gauge_field("Rigs and sequences being served.")
    max_batches: int = _gauge_field("Limit of rigs and sequences served at once.")
    workers: int = _gauge_field("Worker processes wanted.")
    max_loaded_bytes: int = _gauge_field("Limit of bytes of open maps per worker.")
    store_reachable: bool = _gauge_field("1 when the store of the maps answers.")
    buffered_bytes: int = _gauge_field("Bytes of requests that are arriving.")
    max_buffered_bytes: int = _gauge_field("Limit of bytes of arriving requests.")
    connections: int = _gauge_field("Open HTTP connections.")
    max_connections: int = _gauge_field("Limit of open connections.")
    worker_pids: tuple[int, ...] = ()
    loaded_maps: Mapping[tuple[str, str], int] = field(default_factory=dict)
    unusable_maps: Mapping[str, str] = field(default_factory=dict)
    certificate_ends: float | None = None
    folders: Mapping[str, Path] = field(default_factory=dict)


class Metrics:
    """Counts events. Its methods are cheap and may be called from any thread."""

    def __init__(self) -> None:
        self._registry = registry = CollectorRegistry()
        self._maps: set[str] = set()
        counter = partial(Counter, registry=registry)
        histogram = partial(Histogram, registry=registry)
        ProcessCollector(registry=registry)
        self._requests = counter(
            "visloc_requests",
            "Finished requests by status; CANCELLED: the caller left.",
            ("door", "route", "status"),
        )
        self._request_seconds = histogram(
            "visloc_request_seconds",
            "Time from the head of a request to the end of its answer.",
            ("door", "route"),
            buckets=_REQUEST_BUCKETS,
        )
        self._in_progress = Gauge(
            "visloc_requests_in_progress", "Unfinished requests.", ("door",), registry=registry
        )
        self._errors = counter(
            "visloc_errors",
            "Requests answered with an error, by its code and kind.",
            ("door", "code", "kind"),
        )
        self._localizations = counter(
            "visloc_localizations",
            "Answered photos and instants: localized, or the reason why not.",
            ("map", "outcome"),
        )
        self._inliers = histogram(
            "visloc_localization_inliers",
            "Inliers of the best pose, accepted (localized=true) or not.",
            ("map", "localized"),
            buckets=_INLIER_BUCKETS,
        )
        self._stage_seconds = histogram(
            "visloc_stage_seconds",
            "Time that a photo or an instant spent in a stage.",
            ("stage",),
            buckets=_STAGE_BUCKETS,
        )
        self._tiles_searched = histogram(
            "visloc_tiles_searched",
            "Maps of a set that were searched for a photo, again in other turns, or an instant.",
            buckets=(1, 2, 3, 4, 5),
        )
        self._map_changes = counter(
            "visloc_map_changes",
            "Uploads, activations and deletions of map versions, by result.",
            ("change", "result"),
        )
        self._uploaded_bytes = counter(
            "visloc_uploaded_bytes", "Bytes of packed maps received, kept or not."
        )
        self._worker_deaths = counter(
            "visloc_worker_deaths", "Worker processes that died by themselves and were replaced."
        )
        self._workers_ended = counter(
            "visloc_workers_ended",
            "Worker processes ended, and replaced, because they went on with a request after its"
            " deadline or after its caller had left, by API key.",
            ("key",),
        )
        self._start_at_zero()

    def _start_at_zero(self) -> None:
        """Create series whose first event must count: a rate misses a series that starts at 1."""
        for door in ("http", "grpc"):
            self._in_progress.labels(door)
            self._errors.labels(door, "server.internal", VislocError.__name__)
        for change in ("upload", "activate", "delete"):
            for result in ("done", "failed"):
                self._map_changes.labels(change, result)

    def request_started(self, door: str) -> None:
        """Count a request that came in through ``http`` or ``grpc``."""
        self._in_progress.labels(door).inc()

    def observe_request(self, door: str, route: str, status: str, seconds: float) -> None:
        """Count a request that ended.

        Args:
            route: the template of its path or the name of its method, never the path itself.
            status: the HTTP status, the name of the gRPC status, or ``CANCELLED``.
            seconds: its duration.
        """
        self._in_progress.labels(door).dec()
        self._requests.labels(door, route, status).inc()
        self._request_seconds.labels(door, route).observe(seconds)

    def observe_error(self, door: str, error: VislocError) -> None:
        self._errors.labels(door, error.code, type(error).__name__).inc()

    def observe_localization(
        self, map_id: str, reason: str | None, inliers: int, seconds: Mapping[str, float]
    ) -> None:
        """Count the answer to a photo or an instant.

        Args:
            reason: why there is no pose, a ``visloc.types.Reason``; None when there is one.
            inliers: of the best pose, accepted or not.
        """
        if map_id not in self._maps:
            if len(self._maps) < MAX_MAPS:
                self._maps.add(map_id)
                self._localizations.labels(map_id, LOCALIZED)
            else:
                map_id = OTHER_MAPS
        self._localizations.labels(map_id, reason or LOCALIZED).inc()
        self._inliers.labels(map_id, str(reason is None).lower()).observe(inliers)
        for stage, duration in seconds.items():
            self._stage_seconds.labels(stage).observe(duration)

    def observe_tiles(self, searched: int) -> None:
        """Count the maps of a set that were searched for a photo or an instant."""
        self._tiles_searched.observe(searched)

    def observe_map_change(self, change: str, done: bool) -> None:
        """Count an ``upload``, ``activate`` or ``delete`` of a map version."""
        self._map_changes.labels(change, "done" if done else "failed").inc()

    def observe_uploaded(self, num_bytes: int) -> None:
        self._uploaded_bytes.inc(num_bytes)

    def observe_worker_death(self) -> None:
        self._worker_deaths.inc()

    def observe_worker_ended(self, key: str | None) -> None:
        """Count a worker process that was ended because of a request with this API key."""
        self._workers_ended.labels(key or NO_KEY).inc()

    def render(self, state: ServiceState) -> tuple[bytes, str]:
        """Return the text of a scrape and its content type. Reads disks: not for the event loop."""
        return generate_latest(_Scrape(self._registry, state)), CONTENT_TYPE


@dataclass(frozen=True, slots=True)
class _Scrape:
    """Events and state together, in the shape that ``generate_latest`` expects of a registry."""

    registry: CollectorRegistry
    state: ServiceState

    def collect(self) -> Iterator[Metric]:
        for metric in self.registry.collect():
            # The times at which series began would double their number.
            metric.samples = [s for s in metric.samples if not s.name.endswith("_created")]
            if metric.samples:
                yield metric
        yield from _gauges_of(self.state)


def _gauges_of(state: ServiceState) -> Iterator[Metric]:
    yield _gauge(
        "build_info", "Always 1; the version is a label.", {(visloc.__version__,): 1}, "version"
    )
    for number in fields(state):
        if help_text := number.metadata.get(_HELP):
            yield _gauge(number.name, help_text, {(): getattr(state, number.name)})
    yield _gauge("workers_alive", "Worker processes alive.", {(): len(state.worker_pids)})
    yield _gauge(
        "loaded_map_bytes",
        "Bytes of a map that is open in a worker, most of them mapped and shared.",
        state.loaded_maps,
        *("map", "version"),
    )
    yield _gauge(
        "map_unusable",
        "1 for a map that exists and cannot be served; the error code is a label.",
        dict.fromkeys(state.unusable_maps.items(), 1),
        *("map", "code"),
    )
    yield _gauge(
        "resident_memory_bytes",
        "Memory of a process: its own (anonymous), and files that it has mapped (file).",
        resident_memory(state.worker_pids),
        *("process", "kind"),
    )
    if state.certificate_ends is not None:
        yield _gauge(
            "certificate_ends_timestamp_seconds",
            "When the TLS certificate in use expires, seconds since 1970.",
            {(): state.certificate_ends},
        )
    limit = memory_limit()
    if limit is not None:
        yield _gauge("memory_limit_bytes", "Memory of the container or machine.", {(): limit})
    yield _gauge(
        "disk_free_bytes",
        "Free bytes on the disk of a folder.",
        {(name,): shutil.disk_usage(path).free for name, path in _existing(state.folders)},
        "folder",
    )


def _gauge(name: str, help_text: str, values: Mapping[LabelsT, float], *labels: str) -> Metric:
    family = GaugeMetricFamily(f"visloc_{name}", help_text, labels=labels)
    for label_values, value in values.items():
        family.add_metric(label_values, value)
    return family


def _existing(folders: Mapping[str, Path]) -> Iterator[tuple[str, Path]]:
    """Give the folders; for a missing one, the nearest parent, on whose disk it will be made."""
    for name, path in folders.items():
        absolute = path.absolute()
        yield name, next(p for p in (absolute, *absolute.parents) if p.exists())
