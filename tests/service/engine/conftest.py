from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.engine.engines import WithEngine, started
from visloc.photos.reading import ImageLimits


@pytest.fixture(scope="module")
def with_engine(built_maps: Path) -> Iterator[WithEngine]:
    """An engine with the map ``room`` and narrow limits, for all tests that leave it as it was."""
    limits = ImageLimits(max_bytes=200_000)
    settings = {"max_queue": 2, "max_batches": 1, "max_instants": 20}
    with started(built_maps, limits=limits, **settings) as with_engine:
        yield with_engine


@pytest.fixture(scope="module")
def with_two_workers(built_maps: Path) -> Iterator[WithEngine]:
    """An engine with the map ``room`` and two worker processes."""
    with started(built_maps, workers=2) as with_engine:
        yield with_engine
