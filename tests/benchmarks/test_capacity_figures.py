"""What a city takes, of figures that are made up."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import pytest
from rich.console import Console

from benchmarks.capacity import Capacity, City, Costs, Machine, capacity, cell, stage_costs
from mapping.cli.display import print_costs
from mapping.cluster.stage_timings import Spent, StageCost

COSTS = Costs(
    build_core_s={"local_features": 1.5, "matching": 0.5},
    index_core_s=0.002,
    photo_bytes=300e3,
    model_bytes=20e3,
    coarse_bytes=40.0,
    coarse_process_bytes=0.25e9,
    coarse_file_bytes=1e9,
    process_bytes=0.5e9,
    query_core_s=0.7,
    tile_core_s=0.2,
    coarse_core_s=0.1,
    open_core_s=0.3,
    open_bytes=100e6,
    tiles_searched=2.0,
    query_bytes=100e3,
)
CITY = City(photos=1_000_000, tiles=1000, night_h=10, queries_per_s=100)
MACHINE = Machine(cores=16, memory_bytes=64e9, disk_bytes=1e12, network_bytes_per_s=1e9)


def found(**other: float) -> Capacity:
    return capacity(replace(COSTS, **other), CITY, MACHINE)


def test_storage_is_photos_and_models_which_end_at_1024_dimensions() -> None:
    assert found().tile_bytes == 1000 * 300e3 + 999 * 20e3
    assert found().coarse_bytes == 40e6
    large = capacity(COSTS, replace(CITY, tiles=100), MACHINE)
    assert large.tile_bytes == 10_000 * 300e3 + 1024 * 20e3


def test_machines_build_in_a_night_and_one_is_the_least() -> None:
    assert found().build_core_s == 2e6
    assert found().build_machines == 4  # 2e6 / (16 * 36 000) = 3.5
    assert found(build_core_s={"all": 1e-6}).build_machines == 1
    assert found().index_core_s == 2000


def test_a_query_pays_for_its_index_and_every_tile() -> None:
    assert found().query_core_s == pytest.approx(0.7 + 0.1 + 0.2)
    assert found(tiles_searched=5.0).query_core_s == pytest.approx(0.7 + 0.1 + 0.8)
    assert found().replicas == 7  # 100 / 16


def test_workers_that_cannot_hold_the_city_open_their_tiles_again() -> None:
    some = found()
    assert some.replica_bytes == 16 * (0.5e9 + 0.25e9) + 1e9
    # 51 GB for 16 workers, 100 MB for each tile of 1000.
    assert some.open_share == pytest.approx(51e9 / 16 / 100e6 / 1000)
    assert some.open_file_bytes == pytest.approx(51e9 / 100e6 * some.tile_bytes)
    assert some.opening_core_s == pytest.approx(2 * (1 - some.open_share) * 0.3)
    assert some.replicas_opening == math.ceil(100 * (1.0 + some.opening_core_s) / 16) > 7
    roomy = found(open_bytes=1.0)
    assert (roomy.open_share, roomy.opening_core_s) == (1.0, 0.0)
    assert roomy.open_file_bytes == 1000 * roomy.tile_bytes  # workers share them
    assert roomy.replicas_opening == roomy.replicas
    full = capacity(COSTS, CITY, replace(MACHINE, memory_bytes=1e9))
    assert full.open_share == 0.0


def test_disk_and_network_hold_and_bring_what_they_can() -> None:
    some = found()
    tiles_bytes = 1000 * some.tile_bytes
    assert some.disk_share == 1.0
    assert some.fill_s == pytest.approx(tiles_bytes / 1e9)
    assert some.received_share == pytest.approx(100 / 7 * 100e3 / 1e9)
    small = capacity(COSTS, CITY, replace(MACHINE, disk_bytes=tiles_bytes / 4))
    assert small.disk_share == pytest.approx(0.25)
    assert small.fill_s == pytest.approx(tiles_bytes / 4 / 1e9)


def test_costs_are_read_from_what_a_build_prints() -> None:
    text = io.StringIO()
    out = Console(file=text, width=80)
    out.print(" photos           50 by 2 cameras")
    costs = [
        StageCost("local features", 50, 40.0, Spent(75.0, 0)),
        StageCost("between", None, 1.0, Spent(2.5, 2**20)),
        StageCost("in all", None, 41.0, Spent(77.5, 2**20)),
    ]
    print_costs(out, costs)
    assert stage_costs(text.getvalue()) == (50, {"local features": 1.5, "between": 0.05})
    with pytest.raises(ValueError, match="no table of costs"):
        stage_costs("photos 50\n")


def test_numbers_are_read_from_the_chapter_the_row_and_the_column() -> None:
    text = """# All

## One

| s | fast | all |
|---|---|---|
| pose | 0.1 | 12 345.5 (1.0 to 2.0) |

## Two

| s | all |
|---|---|
| pose | 7 |
"""
    assert cell(text, "One", "pose", "all") == 12345.5
    assert cell(text, "Two", "pose", "all") == 7
    for wrong in (("Three", "pose", "all"), ("Two", "pose", "fast"), ("One", "rest", "all")):
        with pytest.raises(ValueError, match="no cell"):
            cell(text, *wrong)
