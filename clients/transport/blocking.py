"""The caller's files and iterables, read without blocking the event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncGenerator, Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

T = TypeVar("T")
_END = object()

# Work for a thread that waits for a task; None when the task is done.
Jobs = SimpleQueue[Callable[[], None] | None]
_jobs_of: WeakKeyDictionary[asyncio.Task[Any], Jobs] = WeakKeyDictionary()


@contextmanager
def attended(jobs: Jobs) -> Iterator[None]:
    """Let the thread that waits for the current task do its blocking work."""
    task = asyncio.current_task()
    assert task is not None
    _jobs_of[task] = jobs
    try:
        yield
    finally:
        del _jobs_of[task]


async def run_blocking(work: Callable[[], T]) -> T:
    """Run work in the thread that waits for this task; in the loop's pool if none does.

    Callers expect their iterables to be read in their own thread: some can be used in one thread
    only. And Ctrl-C ends what blocks there, but not what blocks in the pool.
    """
    if (jobs := _current_jobs()) is None:
        return await asyncio.to_thread(work)
    done: Future[T] = Future()
    jobs.put(lambda: _do(work, done))
    return await asyncio.wrap_future(done)


async def read_items(items: Iterable[T]) -> AsyncGenerator[T, None]:
    """Give the items, each taken as by ``run_blocking``, or in a thread of its own.

    Not in the loop's pool: the next item may never come, and the process waits for the pool when
    it ends.
    """
    waiting = iter(items)

    def take() -> T | object:
        return next(waiting, _END)

    while True:
        if _current_jobs() is None:
            done: Future[T | object] = Future()
            thread = threading.Thread(
                target=_do_all, args=(take, done), name="visloc-instants", daemon=True
            )
            thread.start()
            item = await asyncio.wrap_future(done)
        else:
            item = await run_blocking(take)
        if item is _END:
            return
        yield item  # type: ignore[misc]  # ``is _END`` does not narrow the type


def _current_jobs() -> Jobs | None:
    task = asyncio.current_task()
    return None if task is None else _jobs_of.get(task)


def _do(work: Callable[[], T], done: Future[T]) -> None:
    if not done.set_running_or_notify_cancel():
        return
    try:
        result = work()
    except Exception as error:  # noqa: BLE001 - raised by run_blocking
        done.set_exception(error)
    else:
        done.set_result(result)


def _do_all(work: Callable[[], T], done: Future[T]) -> None:
    try:
        _do(work, done)
    except BaseException as error:  # noqa: BLE001 - as sys.exit(), which would end the loop
        failure = RuntimeError(f"reading ended with {type(error).__name__}")
        failure.__cause__ = error
        done.set_exception(failure)
