"""How many threads this process computes with, and how long its steps take."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from time import perf_counter
from types import ModuleType

_VARIABLE = "OMP_NUM_THREADS"  # torch and others read it when they are loaded


def use_threads(count: int) -> None:
    """Set the number of threads; answers do not depend on it.

    OpenVINO keeps those that its networks were compiled with. That costs nothing: its threads do
    not spin while they wait.
    """
    import cv2  # the main process of the service does without it

    cv2.setNumThreads(count)
    os.environ[_VARIABLE] = str(count)
    torch = loaded_torch()
    if torch is not None:  # else it reads the variable when something needs it
        torch.set_num_threads(count)


def count_of_threads() -> int:
    """Return torch's number if it is loaded, else ``OMP_NUM_THREADS``; at most the processors."""
    torch = loaded_torch()
    if torch is not None:
        return int(torch.get_num_threads())
    can_tell = hasattr(os, "sched_getaffinity")
    processors = len(os.sched_getaffinity(0)) if can_tell else os.cpu_count() or 1
    try:
        asked = int(os.environ.get(_VARIABLE, "").partition(",")[0])
    except ValueError:
        return processors
    return min(asked, processors) if asked > 0 else processors


def loaded_torch() -> ModuleType | None:
    """Return torch if anything has loaded it; waits while another thread does."""
    return importlib.import_module("torch") if "torch" in sys.modules else None


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Set the number of threads within the ``with`` block, of one thread of Python at a time."""
    import cv2  # as above

    before, of_opencv, variable = count_of_threads(), cv2.getNumThreads(), os.environ.get(_VARIABLE)
    use_threads(count)
    try:
        yield
    finally:
        use_threads(before)
        cv2.setNumThreads(of_opencv)
        if variable is None:
            os.environ.pop(_VARIABLE, None)
        else:
            os.environ[_VARIABLE] = variable


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
