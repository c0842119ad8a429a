"""Wall time by stage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from time import perf_counter


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Note how long the block took."""
    start = perf_counter()
    yield
    seconds[stage] = perf_counter() - start


def summed(*parts: Mapping[str, float]) -> dict[str, float]:
    """Add up wall times by stage, in the order in which stages are named first."""
    total: dict[str, float] = {}
    for part in parts:
        for stage, seconds in part.items():
            total[stage] = total.get(stage, 0.0) + seconds
    return total
