"""Short runs of ``python -m benchmarks.reliability`` (docs/reliability.md has the long ones)."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from benchmarks.reliability.checks import Check
from benchmarks.reliability.connections import Strength, connections
from benchmarks.reliability.heavy_requests import heavy_photos
from benchmarks.reliability.kills import kill_service, kill_workers
from benchmarks.reliability.maps import SampleMaps, make_maps
from benchmarks.reliability.siege import siege
from benchmarks.reliability.uploads import full_disk, truncated_upload

pytestmark = pytest.mark.slow
NEEDS_HAPROXY = pytest.mark.skipif(
    shutil.which("haproxy") is None,
    reason="needs HAProxy; on Debian and Ubuntu `make balancer`, as root, installs it",
)


@pytest.fixture(scope="module")
def made_maps(tmp_path_factory: pytest.TempPathFactory) -> SampleMaps:
    """Two maps in two versions each; only to be read."""
    return make_maps(tmp_path_factory.mktemp("reliability"))


@pytest.fixture
def maps(made_maps: SampleMaps, tmp_path: Path) -> SampleMaps:
    """A copy of them that a test may change."""
    return made_maps.copied_to(tmp_path / "maps")


def broken(checks: Sequence[Check]) -> list[Check]:
    """What does not hold, but for how fast the service comes back on a busy machine."""
    assert checks
    return [check for check in checks if not check.holds and not check.is_speed]


def test_a_killed_worker_costs_one_request_and_the_client_retries_safely(
    maps: SampleMaps, tmp_path: Path
) -> None:
    assert broken(asyncio.run(kill_workers(maps, tmp_path, kills=2))) == []


def test_a_killed_service_comes_back_with_all_that_was_published(
    maps: SampleMaps, tmp_path: Path
) -> None:
    assert broken(asyncio.run(kill_service(maps, tmp_path, kills=2))) == []


@NEEDS_HAPROXY
def test_connections_that_are_idle_slow_or_flooding_shut_nobody_out(
    maps: SampleMaps, tmp_path: Path
) -> None:
    assert broken(asyncio.run(connections(maps, tmp_path, Strength(1200, 4)))) == []


@NEEDS_HAPROXY
def test_a_siege_costs_no_answer_and_no_publication(maps: SampleMaps, tmp_path: Path) -> None:
    assert broken(asyncio.run(siege(maps, tmp_path, seconds=60))) == []


def test_photos_that_take_long_keep_no_worker(maps: SampleMaps, tmp_path: Path) -> None:
    assert broken(heavy_photos(maps, tmp_path, deadline_s=0.05)) == []


def test_nothing_stays_of_an_upload_that_breaks(maps: SampleMaps, tmp_path: Path) -> None:
    assert broken(truncated_upload(maps, tmp_path)) == []


def test_a_full_disk_loses_and_tears_nothing(maps: SampleMaps, tmp_path: Path) -> None:
    assert broken(full_disk(maps, tmp_path)) == []
