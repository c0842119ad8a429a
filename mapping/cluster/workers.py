"""Worker processes of this machine."""

from __future__ import annotations

import multiprocessing
import multiprocessing.util
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from threadpoolctl import threadpool_limits

from mapping.cluster.stage_timings import Spent, spent_here
from mapping.progress import ItemProgress, Progress
from visloc.errors import refuse
from visloc.runtime.threads import threads, use_threads

S = TypeVar("S")
T = TypeVar("T")

# Few machines have memory for more than eight processes of a build.
DEFAULT_WORKERS = min(os.cpu_count() or 1, 8)

# Without these, each library starts as many threads as there are processors, in every worker.
# Libraries read them when they are loaded; torch reads the first.
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}

_FORK_SERVER = "mapping.pipeline.forkserver"

# The server's socket lies below the folder of temporary files. Its path has at most 107 bytes, of
# which multiprocessing appends 32.
_LONGEST_TEMPORARY = 70

# Items sent together: few, so that progress shows and all workers stay busy to the end.
_MAX_BATCH, _MIN_BATCHES = 16, 200


class Workers:
    """An ``Executor`` of ``count`` processes, which end with the ``with`` block; 1: this process.

    A single item is done in this process as well: Ctrl-C then ends it at once, and it can report
    progress. Every process uses one thread, so that their number does not change the result.
    """

    def __init__(self, count: int) -> None:
        self._pool = (
            ProcessPoolExecutor(
                count,
                mp_context=_start_method(),
                initializer=_start_worker,
                initargs=(_own_sockets(),),
            )
            if count > 1
            else None
        )
        self._spent = Spent()

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    @property
    def spent(self) -> Spent:
        return self._spent

    def run(self, task: Callable[[T], object], items: Sequence[T], progress: ItemProgress) -> None:
        progress(0, len(items))
        if self._pool is None or len(items) == 1:
            with one_thread_here():
                for done, item in enumerate(items, 1):
                    task(item)
                    progress(done, len(items))
            return
        self._finish(self._pool, partial(_no_result, task), in_batches(items), len(items), progress)

    def run_here(
        self, task: Callable[[T], S], items: Sequence[T], progress: ItemProgress
    ) -> list[S]:
        progress(0, len(items))
        if self._pool is None:
            results = []
            with one_thread_here():
                for done, item in enumerate(items, 1):
                    results.append(task(item))
                    progress(done, len(items))
            return results
        return self._finish(self._pool, partial(_one_result, task), items, len(items), progress)

    def run_one(
        self,
        task: Callable[[T, Progress], object],
        item: T,
        stage: str,  # noqa: ARG002  the task reports its own
        progress: Progress,
    ) -> None:
        with one_thread_here():
            task(item, progress)

    def _finish(
        self,
        pool: ProcessPoolExecutor,
        work: Callable[[T], tuple[S, int, Spent]],
        parts: Sequence[T],
        total: int,
        progress: ItemProgress,
    ) -> list[S]:
        """Do parts of a stage, each of so many items; return their results in their order."""
        try:
            with _one_thread_each(), _interrupted_later():
                futures = [pool.submit(work, part) for part in parts]
            done = 0
            for future in as_completed(futures):
                _, count, spent = future.result()
                done += count
                self._spent += spent
                progress(done, total)
        except BrokenProcessPool as error:
            raise refuse("build.worker_died", field="--workers") from error
        return [future.result()[0] for future in futures]


THIS_PROCESS = Workers(1)
"""Does everything in this process."""


def _start_method() -> multiprocessing.context.BaseContext:
    """Return a way to start processes: forks of a server that has loaded what they need.

    Loading takes seconds of each process otherwise, and its memory is shared. The server computes
    nothing: a forked child of a process that has used torch hangs. Where no server can listen, each
    process loads what it needs itself.
    """
    if len(os.fsencode(tempfile.gettempdir())) > _LONGEST_TEMPORARY:
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_FORK_SERVER])
    return context


def in_batches(items: Sequence[T]) -> list[Sequence[T]]:
    """Return the items in batches, to pickle the task less often."""
    size = max(1, min(_MAX_BATCH, len(items) // _MIN_BATCHES))
    return [items[start : start + size] for start in range(0, len(items), size)]


def do_batch(task: Callable[[T], object], items: Sequence[T]) -> tuple[int, Spent]:
    """Do a task for items in this process; return their number and the resources used."""
    before = spent_here()
    for item in items:
        task(item)
    return len(items), spent_here() - before


def _no_result(task: Callable[[T], object], items: Sequence[T]) -> tuple[None, int, Spent]:
    return (None, *do_batch(task, items))


def _one_result(task: Callable[[T], S], item: T) -> tuple[S, int, Spent]:
    before = spent_here()
    result = task(item)
    return result, 1, spent_here() - before


def _own_sockets() -> str | None:
    """Return the folder of this process's sockets; None in a child, which uses its parent's."""
    is_child = multiprocessing.parent_process() is not None
    return None if is_child else multiprocessing.util.get_temp_dir()


def _start_worker(sockets: str | None) -> None:
    """Begin a worker of a build that has a folder of sockets of its own, or None."""
    import pycolmap  # noqa: F401  loaded before its handler, which prints stack traces, is replaced

    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    threading.Thread(target=_end_with_parent, args=(sockets,), daemon=True).start()
    use_threads(1)


def _end_with_parent(sockets: str | None) -> None:
    """End a worker whose build was killed; it would wait for work forever.

    A build that is killed cannot remove its folder of sockets. The folder does not lie in the work
    folder: paths of sockets are short, and shared disks hold none.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    if sockets is not None:
        shutil.rmtree(sockets, ignore_errors=True)  # another worker may be faster
    os._exit(1)


@contextmanager
def _interrupted_later() -> Iterator[None]:
    """Delay Ctrl-C while processes start: half a start would end in a traceback.

    The new processes never receive it: the parent handles it.
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
def one_thread_here() -> Iterator[None]:
    """Compute like a worker: the number of threads changes the last bits of results."""
    with threads(1), threadpool_limits(1, user_api="blas"):  # of NumPy and SciPy
        yield


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Give processes that start meanwhile an environment for one thread."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
