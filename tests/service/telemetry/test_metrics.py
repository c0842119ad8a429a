from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.telemetry.metrics import MAX_MAPS, NO_KEY, OTHER_MAPS, Metrics, ServiceState
from visloc.errors import Overloaded

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def scrape(metrics: Metrics, state: ServiceState | None = None) -> Samples:
    body, content_type = metrics.render(state or ServiceState(ready=True))
    assert content_type.startswith("text/plain; version=0.0.4")
    samples: Samples = {}
    for family in text_string_to_metric_families(body.decode()):
        for sample in family.samples:
            key = (sample.name, frozenset(sample.labels.items()))
            assert key not in samples
            samples[key] = sample.value
    return samples


def value(samples: Samples, name: str, **labels: str) -> float:
    return samples[name, frozenset(labels.items())]


def test_a_request_is_counted_with_its_door_route_and_status() -> None:
    metrics = Metrics()
    metrics.request_started("http")
    assert value(scrape(metrics), "visloc_requests_in_progress", door="http") == 1

    metrics.observe_request("http", "POST /localize", "200", 0.3)

    samples, route = scrape(metrics), {"door": "http", "route": "POST /localize"}
    assert value(samples, "visloc_requests_in_progress", door="http") == 0
    assert value(samples, "visloc_requests_total", **route, status="200") == 1
    assert value(samples, "visloc_request_seconds_sum", **route) == 0.3
    assert value(samples, "visloc_request_seconds_bucket", **route, le="0.25") == 0
    assert value(samples, "visloc_request_seconds_bucket", **route, le="0.5") == 1


def test_answers_are_counted_by_map_and_reason_with_inliers_and_stages() -> None:
    metrics = Metrics()

    metrics.observe_localization("hall", None, 120, {"queued": 0.01, "pose": 0.02})
    metrics.observe_localization("hall", "too_few_inliers", 7, {"queued": 0.03})

    samples = scrape(metrics)
    assert value(samples, "visloc_localizations_total", map="hall", outcome="localized") == 1
    assert value(samples, "visloc_localizations_total", map="hall", outcome="too_few_inliers") == 1
    inliers = "visloc_localization_inliers_sum"
    assert value(samples, inliers, map="hall", localized="true") == 120
    assert value(samples, inliers, map="hall", localized="false") == 7
    assert value(samples, "visloc_stage_seconds_count", stage="queued") == 2
    assert value(samples, "visloc_stage_seconds_sum", stage="queued") == pytest.approx(0.04)
    assert value(samples, "visloc_stage_seconds_count", stage="pose") == 1


def test_a_map_that_localizes_nothing_has_a_share_of_zero_not_none() -> None:
    metrics = Metrics()

    metrics.observe_localization("hall", "no_pose", 0, {})

    name = "visloc_localizations_total"
    assert value(scrape(metrics), name, map="hall", outcome="localized") == 0


def test_errors_are_counted_by_code_and_mistakes_of_the_server_from_zero_on() -> None:
    metrics = Metrics()

    metrics.observe_error("grpc", Overloaded("server.busy", "too many"))

    samples, name = scrape(metrics), "visloc_errors_total"
    assert value(samples, name, door="grpc", code="server.busy", kind="Overloaded") == 1
    mistake = {"code": "server.internal", "kind": "VislocError"}
    for door in ("http", "grpc"):
        assert value(samples, name, door=door, **mistake) == 0


def test_changes_of_maps_uploads_and_worker_deaths_are_counted() -> None:
    metrics = Metrics()

    metrics.observe_map_change("upload", done=True)
    metrics.observe_map_change("delete", done=False)
    metrics.observe_uploaded(1000)
    metrics.observe_uploaded(24)
    metrics.observe_worker_death()
    metrics.observe_worker_ended("robot")
    metrics.observe_worker_ended(None)

    samples, name = scrape(metrics), "visloc_map_changes_total"
    assert value(samples, name, change="upload", result="done") == 1
    assert value(samples, name, change="delete", result="failed") == 1
    assert value(samples, name, change="activate", result="done") == 0
    assert value(samples, "visloc_uploaded_bytes_total") == 1024
    assert value(samples, "visloc_worker_deaths_total") == 1
    assert value(samples, "visloc_workers_ended_total", key="robot") == 1
    assert value(samples, "visloc_workers_ended_total", key=NO_KEY) == 1


def test_the_number_of_series_is_bounded_however_many_maps_come_and_go() -> None:
    metrics = Metrics()
    for number in range(MAX_MAPS + 50):
        metrics.observe_localization(f"map{number}", None, 50, {})

    samples = scrape(metrics)

    maps = {dict(labels)["map"] for name, labels in samples if name.startswith("visloc_localiza")}
    assert len(maps) == MAX_MAPS + 1
    assert value(samples, "visloc_localizations_total", map=OTHER_MAPS, outcome="localized") == 50
    metrics.observe_localization("map0", None, 50, {})  # those that have a series keep it
    assert (
        value(scrape(metrics), "visloc_localizations_total", map="map0", outcome="localized") == 2
    )


def test_gauges_say_the_state_of_the_moment(tmp_path: Path) -> None:
    state = ServiceState(
        ready=True,
        draining=True,
        photos_waiting=3,
        max_queue=64,
        photos_running=2,
        workers=2,
        worker_pids=(os.getpid(),),
        loaded_maps={("hall", "20260101T000000Z"): 1000, ("yard", "20260102T000000Z"): 2000},
        unusable_maps={"cellar": "map.array"},
        store_reachable=False,
        buffered_bytes=5,
        folders={"maps": tmp_path, "cache": tmp_path / "not" / "yet"},
    )
    metrics = Metrics()

    samples = scrape(metrics, state)

    assert value(samples, "visloc_ready") == 1
    assert value(samples, "visloc_draining") == 1
    assert value(samples, "visloc_photos_waiting") == 3
    assert value(samples, "visloc_max_queue") == 64
    assert value(samples, "visloc_photos_running") == 2
    assert (value(samples, "visloc_workers"), value(samples, "visloc_workers_alive")) == (2, 1)
    loaded = "visloc_loaded_map_bytes"
    assert value(samples, loaded, map="hall", version="20260101T000000Z") == 1000
    assert value(samples, "visloc_map_unusable", map="cellar", code="map.array") == 1
    assert value(samples, "visloc_store_reachable") == 0
    assert value(samples, "visloc_buffered_bytes") == 5
    free = value(samples, "visloc_disk_free_bytes", folder="maps")
    assert free > 0
    assert value(samples, "visloc_disk_free_bytes", folder="cache") == pytest.approx(free, rel=0.01)
    # What is gone, is gone from the next scrape.
    assert not any(name == loaded for name, _ in scrape(metrics))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read as Linux has it")
def test_memory_is_told_by_process_and_kind() -> None:
    samples = scrape(Metrics(), ServiceState(ready=True, worker_pids=(os.getpid(), 2**22 + 1)))

    for process in ("server", "worker-0"):
        own = value(samples, "visloc_resident_memory_bytes", process=process, kind="anonymous")
        assert 2**20 < own < value(samples, "visloc_memory_limit_bytes")
    # The second worker has ended since it was listed.
    assert not any(("process", "worker-1") in labels for _, labels in samples)


def test_two_sets_of_metrics_share_nothing() -> None:
    one, other = Metrics(), Metrics()

    one.observe_worker_death()

    assert value(scrape(other), "visloc_worker_deaths_total") == 0


def test_counting_from_many_threads_loses_nothing() -> None:
    metrics = Metrics()

    def count() -> None:
        for _ in range(500):
            metrics.observe_localization("hall", None, 50, {"pose": 0.1})

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    samples = scrape(metrics)
    assert value(samples, "visloc_localizations_total", map="hall", outcome="localized") == 2000
    assert value(samples, "visloc_stage_seconds_count", stage="pose") == 2000
