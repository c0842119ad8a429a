"""What Prometheus scrapes: counters that the doors and the engine raise, gauges of one moment.

Nothing here is global, and no label takes a caller's words: routes are templates, codes and stages
are the service's own, maps are those that answered.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import generate_latest

import visloc
from service.telemetry.process_memory import memory_limit, resident_memory
from visloc.errors import VislocError

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
LOCALIZED = "localized"
# The label of the maps after the first MAX_MAPS: uploading maps must not fill Prometheus.
MAX_MAPS = 200
OTHER_MAPS = "(others)"

_REQUEST_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
_STAGE_BUCKETS = (
    0.001,
    0.0025,
    0.005,
    0.01,
    0.025,
    0.05,
    0.1,
    0.25,
    0.5,
    1.0,
    2.5,
    5.0,
    10.0,
    30.0,
)
_INLIER_BUCKETS = (0, 10, 20, 30, 50, 75, 100, 150, 250, 500, 1000, 2500)


@dataclass(frozen=True, slots=True)
class ServiceState:
    """The service at one moment.

    Attributes:
        ready: what ``/readyz`` says.
        draining: whether it ends what runs and accepts nothing new.
        photos_waiting: for a worker.
        max_queue: places for those.
        photos_running: being worked on.
        batches_running: rigs and sequences.
        max_batches: places for those.
        workers: that there should be.
        worker_pids: of those that live.
        loaded_maps: bytes of each map that is open in a worker, by id and version.
        max_loaded_bytes: room for open maps of one worker.
        unusable_maps: the code of why a map that is there is not served, by id.
        store_reachable: whether the maps' store answers; a folder always does.
        buffered_bytes: of requests that are arriving.
        max_buffered_bytes: room for those.
        connections: that are open, of HTTP.
        max_connections: places for those.
        folders: whose disks may fill, by what they are for: ``maps``, ``cache``.
    """

    ready: bool
    draining: bool = False
    photos_waiting: int = 0
    max_queue: int = 0
    photos_running: int = 0
    batches_running: int = 0
    max_batches: int = 0
    workers: int = 0
    worker_pids: tuple[int, ...] = ()
    loaded_maps: Mapping[tuple[str, str], int] = field(default_factory=dict)
    max_loaded_bytes: int = 0
    unusable_maps: Mapping[str, str] = field(default_factory=dict)
    store_reachable: bool = True
    buffered_bytes: int = 0
    max_buffered_bytes: int = 0
    connections: int = 0
    max_connections: int = 0
    folders: Mapping[str, Path] = field(default_factory=dict)


class Metrics:
    """Counts what happens. Its methods are cheap and may be called from any thread."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._maps: set[str] = set()
        ProcessCollector(registry=self._registry)
        self._requests = Counter(
            "visloc_requests",
            "Requests that ended, by status; CANCELLED: the caller left.",
            ("door", "route", "status"),
            registry=self._registry,
        )
        self._request_seconds = Histogram(
            "visloc_request_seconds",
            "Time from a request's head to the end of its answer.",
            ("door", "route"),
            buckets=_REQUEST_BUCKETS,
            registry=self._registry,
        )
        self._in_progress = Gauge(
            "visloc_requests_in_progress",
            "Requests that have not ended.",
            ("door",),
            registry=self._registry,
        )
        self._errors = Counter(
            "visloc_errors",
            "Requests that were answered with an error, by its code and kind.",
            ("door", "code", "kind"),
            registry=self._registry,
        )
        self._localizations = Counter(
            "visloc_localizations",
            "Photos and instants that were answered: localized, or why not.",
            ("map", "outcome"),
            registry=self._registry,
        )
        self._inliers = Histogram(
            "visloc_localization_inliers",
            "Inliers of the best pose, accepted (localized=true) or not.",
            ("map", "localized"),
            buckets=_INLIER_BUCKETS,
            registry=self._registry,
        )
        self._stage_seconds = Histogram(
            "visloc_stage_seconds",
            "Time that a photo or an instant spent in a stage.",
            ("stage",),
            buckets=_STAGE_BUCKETS,
            registry=self._registry,
        )
        self._tiles_searched = Histogram(
            "visloc_tiles_searched",
            "Maps of a set that were searched for a photo or an instant.",
            buckets=(1, 2, 3, 4, 5),
            registry=self._registry,
        )
        self._map_changes = Counter(
            "visloc_map_changes",
            "Uploads, activations and deletions of map versions, by how they ended.",
            ("change", "result"),
            registry=self._registry,
        )
        self._uploaded_bytes = Counter(
            "visloc_uploaded_bytes",
            "Bytes of packed maps that arrived, kept or not.",
            registry=self._registry,
        )
        self._worker_deaths = Counter(
            "visloc_worker_deaths",
            "Worker processes that ended unasked and were replaced.",
            registry=self._registry,
        )
        # A rate sees the first of something only when it was 0 before.
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
            door: ``http`` or ``grpc``.
            route: the template of its path or the name of its method, never the path itself.
            status: the HTTP status, the name of the gRPC status, or ``CANCELLED``.
            seconds: how long it took.
        """
        self._in_progress.labels(door).dec()
        self._requests.labels(door, route, status).inc()
        self._request_seconds.labels(door, route).observe(seconds)

    def observe_error(self, door: str, error: VislocError) -> None:
        """Count an error that a caller was told."""
        self._errors.labels(door, error.code, type(error).__name__).inc()

    def observe_localization(
        self,
        map_id: str,
        localized: bool,
        reason: str | None,
        inliers: int,
        seconds: Mapping[str, float],
    ) -> None:
        """Count the answer to a photo or an instant.

        Args:
            map_id: the map that gave it: one that exists.
            localized: whether it is a pose.
            reason: a ``visloc.types.Reason`` when it is none.
            inliers: of the best pose, refused or not.
            seconds: by stage.
        """
        if map_id not in self._maps:
            if len(self._maps) < MAX_MAPS:
                self._maps.add(map_id)
                self._localizations.labels(map_id, LOCALIZED)
            else:
                map_id = OTHER_MAPS
        self._localizations.labels(map_id, LOCALIZED if localized else reason or "unknown").inc()
        self._inliers.labels(map_id, str(localized).lower()).observe(inliers)
        for stage, duration in seconds.items():
            self._stage_seconds.labels(stage).observe(duration)

    def observe_tiles(self, searched: int) -> None:
        """Count the maps of a set that were searched for a photo or an instant."""
        self._tiles_searched.observe(searched)

    def observe_map_change(self, change: str, done: bool) -> None:
        """Count an ``upload``, ``activate`` or ``delete`` of a map's version."""
        self._map_changes.labels(change, "done" if done else "failed").inc()

    def observe_uploaded(self, num_bytes: int) -> None:
        """Count bytes of a packed map that arrived."""
        self._uploaded_bytes.inc(num_bytes)

    def observe_worker_death(self) -> None:
        """Count a worker process that ended unasked."""
        self._worker_deaths.inc()

    def render(self, state: ServiceState) -> tuple[bytes, str]:
        """Return the text of a scrape and its content type. Reads disks: not for the event loop."""
        return generate_latest(_Scrape(self._registry, state)), CONTENT_TYPE


@dataclass(frozen=True, slots=True)
class _Scrape:
    """All that is known, in the shape that ``generate_latest`` asks a registry for."""

    registry: CollectorRegistry
    state: ServiceState

    def collect(self) -> Iterator[Metric]:
        for metric in self.registry.collect():
            # When a series began helps nobody here, and would double their number.
            metric.samples = [s for s in metric.samples if not s.name.endswith("_created")]
            if metric.samples:
                yield metric
        yield from _gauges_of(self.state)


def _gauges_of(state: ServiceState) -> Iterator[Metric]:
    yield _gauge(
        "visloc_build_info",
        "Always 1; the version is a label.",
        ("version",),
        [((visloc.__version__,), 1)],
    )
    for name, help_text, value in (
        ("ready", "1 when maps and networks are warm.", state.ready),
        ("draining", "1 when it ends what runs and accepts nothing new.", state.draining),
        ("photos_waiting", "Photos that wait for a worker.", state.photos_waiting),
        ("max_queue", "Photos that may wait.", state.max_queue),
        ("photos_running", "Photos that are being worked on.", state.photos_running),
        ("batches_running", "Rigs and sequences that are being served.", state.batches_running),
        ("max_batches", "Rigs and sequences that may be served at once.", state.max_batches),
        ("workers", "Worker processes that there should be.", state.workers),
        ("workers_alive", "Worker processes that live.", len(state.worker_pids)),
        ("max_loaded_bytes", "Room for open maps.", state.max_loaded_bytes),
        ("store_reachable", "1 when the store of the maps answers.", state.store_reachable),
        ("buffered_bytes", "Bytes of requests that are arriving.", state.buffered_bytes),
        ("max_buffered_bytes", "Room for requests that are arriving.", state.max_buffered_bytes),
        ("connections", "Open connections of HTTP.", state.connections),
        ("max_connections", "Connections that may be open at once.", state.max_connections),
    ):
        yield GaugeMetricFamily(f"visloc_{name}", help_text, value=float(value))
    yield _gauge(
        "visloc_loaded_map_bytes",
        "Bytes of a map that is open in a worker, most of them mapped and shared.",
        ("map", "version"),
        state.loaded_maps.items(),
    )
    yield _gauge(
        "visloc_map_unusable",
        "1 for a map that is there and cannot be served, with the code of why.",
        ("map", "code"),
        (((map_id, code), 1) for map_id, code in state.unusable_maps.items()),
    )
    yield _gauge(
        "visloc_resident_memory_bytes",
        "Memory of a process: its own (anonymous), and files that it has mapped (file).",
        ("process", "kind"),
        resident_memory(state.worker_pids).items(),
    )
    limit = memory_limit()
    if limit is not None:
        yield GaugeMetricFamily(
            "visloc_memory_limit_bytes", "Memory that there is for all of it.", value=limit
        )
    yield _gauge(
        "visloc_disk_free_bytes",
        "Room on the disk of a folder.",
        ("folder",),
        (((name,), shutil.disk_usage(path).free) for name, path in _existing(state.folders)),
    )


def _gauge(
    name: str,
    help_text: str,
    labels: tuple[str, ...],
    values: Iterable[tuple[tuple[str, ...], float]],
) -> Metric:
    family = GaugeMetricFamily(name, help_text, labels=labels)
    for label_values, value in values:
        family.add_metric(label_values, value)
    return family


def _existing(folders: Mapping[str, Path]) -> Iterator[tuple[str, Path]]:
    """The folders; one that is not there yet will be made on the disk of the nearest above it."""
    for name, path in folders.items():
        absolute = path.absolute()
        yield name, next(p for p in (absolute, *absolute.parents) if p.exists())
