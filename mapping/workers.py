"""Worker processes: the same task for many items, in any order."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from types import TracebackType
from typing import TypeVar

import cv2

from visloc.errors import Unavailable

T = TypeVar("T")

# Processes of a build unless told otherwise: more than this few machines have memory for.
DEFAULT_WORKERS = min(os.cpu_count() or 1, 8)

# Each library would otherwise start as many threads as there are processors, in every worker. They
# read these when they are loaded; torch reads the first.
_THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)

# Items that travel together: few, so that progress is seen, and all workers have work to the end.
_MAX_BATCH, _MIN_BATCHES = 16, 200


class Workers:
    """Does work in ``count`` processes, which end with the ``with`` block; one means this process.

    Every process uses one thread, so that their number does not change what comes out. Where a task
    of this process is the first to load torch, it uses all: for products of whole numbers, which
    are the same with any number of threads.

    A task and its items travel to other processes: the task is a module's function, a method of a
    dataclass or a ``functools.partial`` of one, and leaves its result in the work folder.
    """

    def __init__(self, count: int) -> None:
        # A forked child of a process that has used torch hangs.
        spawn = multiprocessing.get_context("spawn")
        self._pool = (
            ProcessPoolExecutor(count, mp_context=spawn, initializer=_start_worker)
            if count > 1
            else None
        )

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def run(
        self, task: Callable[[T], object], items: Sequence[T], progress: Callable[[int, int], None]
    ) -> None:
        """Do the task for every item; tell the progress after each.

        Raises:
            Unavailable: ``build.worker_died``.
            Exception: what the task raised first; waiting items are dropped.
        """
        progress(0, len(items))
        if self._pool is None:
            with _one_thread_here():
                for done, item in enumerate(items, 1):
                    task(item)
                    progress(done, len(items))
            return
        try:
            # A task can hold a whole dataset: many items share one journey of it.
            size = max(1, min(_MAX_BATCH, len(items) // _MIN_BATCHES))
            batches = [items[start : start + size] for start in range(0, len(items), size)]
            with _one_thread_each(), _interrupted_later():
                futures = [self._pool.submit(_do_all, task, batch) for batch in batches]
            done = 0
            for future in as_completed(futures):
                done += future.result()
                progress(done, len(items))
        except BrokenProcessPool as error:
            raise Unavailable(
                "build.worker_died",
                "a worker process ended: it was killed, or there was not enough memory; "
                "finished work is kept, the same command resumes",
                field="--workers",
            ) from error


def _do_all(task: Callable[[T], object], items: Sequence[T]) -> int:
    for item in items:
        task(item)
    return len(items)


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A worker of a build that was killed would wait for work forever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@contextmanager
def _interrupted_later() -> Iterator[None]:
    """Let Ctrl-C wait while processes start: half a start would end in a traceback.

    The processes that start meanwhile never hear of it: it is the parent's to handle.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: caught.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, before)
    if caught:
        raise KeyboardInterrupt


@contextmanager
def _one_thread_here() -> Iterator[None]:
    """Compute as a worker does: networks differ in the last bits with the number of threads."""
    # A network that torch computes was made before, with torch. Without one it would take seconds
    # to load for nothing; matching may load it later.
    torch = sys.modules.get("torch")
    before = cv2.getNumThreads(), torch.get_num_threads() if torch else 0
    cv2.setNumThreads(1)
    if torch:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before[0])
        if torch:
            torch.set_num_threads(before[1])


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that start meanwhile use one thread in libraries that read the environment."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
