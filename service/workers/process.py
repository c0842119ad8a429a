"""The entry points of a worker process: started once, then one task after another."""

from __future__ import annotations

import ctypes
import os
import signal
import threading
from collections.abc import Callable
from multiprocessing import parent_process
from typing import TYPE_CHECKING, TypeVar

from service.values import OpenMap, WorkerSettings

if TYPE_CHECKING:
    from service.workers.vision import Vision

T = TypeVar("T")

_vision: Vision | None = None


def start(settings: WorkerSettings, abandoned: ctypes.c_bool) -> None:
    """Initialize the process.

    Args:
        abandoned: shared with the main process, which sets it when nobody waits for the task.
    """
    global _vision
    # Both may reach all processes of a group, and the main process decides when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if settings.configure_logging is not None:
        settings.configure_logging()
    from service.workers.vision import Vision  # not in the main process, which has this module too

    _vision = Vision(settings, abandoned)


def _end_with_parent() -> None:
    """End when the main process was killed; else this one would wait for tasks for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def run(task: Callable[[Vision], T], threads: int) -> tuple[T, tuple[OpenMap, ...]]:
    """Return a task's result, and the maps that are open after it."""
    assert _vision is not None  # start ran
    _vision.use_threads(threads)
    return task(_vision), _vision.open_maps
