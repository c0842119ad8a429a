"""Processes that do the vision: always warm, replaced when they die, one task at a time each.

Native code can end a process without an exception; here that costs one request its answer, and
nothing else. Each process is an executor of its own, because the standard one fails all its tasks
when one process dies (docs/decisions/0013-worker-processes.md).
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import ctypes
import logging
import os
import signal
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any, ParamSpec, TypeVar

from service.errors import stopping_error
from service.workers import process as worker
from service.workers.process import Loaded, MapFolder, WorkerSettings
from visloc.errors import VislocError, refuse

logger = logging.getLogger(__name__)

P = ParamSpec("P")
T = TypeVar("T")

# The module that the fork server loads; not imported here, where it would change what SIGTERM does.
FORK_SERVER = "service.workers.forkserver"
# How often an idle worker is asked whether it still lives.
_WATCH_S = 1.0
# Pause before a worker that cannot start is tried again.
_RESTART_PAUSE_S = 1.0
# Longest time for a process to begin and to open the maps that are in service.
_START_LIMIT_S = 300.0


@dataclass(eq=False)
class _Task:
    """Something to do, who waits for it, and who works on it now."""

    work: Callable[[], Any]
    answer: asyncio.Future[Any]
    worker: _Worker | None = None


class Workers:
    """A fixed number of worker processes and the queue before them, first come, first served.

    Used from one event loop.

    Args:
        count: processes.
        settings: what each of them needs to know.
        limit_s: longest time that one task may take; a process that exceeds it is replaced.
        warm: the maps that may be open; a new process opens those that the one before had open.
        on_death: called for every process that died.
    """

    def __init__(
        self,
        count: int,
        settings: WorkerSettings,
        *,
        limit_s: float,
        warm: Callable[[], Sequence[MapFolder]],
        on_death: Callable[[], None],
    ) -> None:
        self._workers = [_Worker(settings) for _ in range(count)]
        self._limit_s = limit_s
        self._warm = warm
        self._on_death = on_death
        self._queue: deque[_Task] = deque()
        self._changed = asyncio.Condition()
        self._serving: list[asyncio.Task[None]] = []

    @property
    def count(self) -> int:
        """Processes, alive or being replaced."""
        return len(self._workers)

    @property
    def started(self) -> bool:
        """Whether ``start`` is done."""
        return bool(self._serving)

    @property
    def waiting(self) -> int:
        """Tasks that nobody works on yet."""
        return sum(not task.answer.done() for task in self._queue)

    @property
    def running(self) -> int:
        """Tasks that are worked on."""
        return sum(one.busy for one in self._workers)

    @property
    def alive(self) -> int:
        """Processes that can take a task."""
        return sum(one.alive for one in self._workers)

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of those that are alive."""
        return tuple(one.pid for one in self._workers if one.alive)

    @property
    def loaded(self) -> dict[str, int]:
        """Bytes of the maps that are open in any process, by ``id@version``."""
        return {ref: size for one in self._workers for ref, size in one.loaded}

    async def start(self) -> None:
        """Start all processes.

        Raises:
            Unavailable: ``server.worker_died`` when one does not even begin.
        """
        await asyncio.gather(*(one.start(()) for one in self._workers))
        self._serving = [asyncio.create_task(self._serve(one)) for one in self._workers]

    async def run(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Do a task in the next free process. Whoever stops waiting gives the task up.

        A task that has not begun is then dropped; one that runs is told, and ends at its next step.

        Raises:
            Unavailable: ``server.worker_died``.
            TimedOut: ``server.deadline`` when it exceeded the limit.
        """
        task = _Task(partial(work, *args, **kwargs), asyncio.get_running_loop().create_future())
        async with self._changed:
            self._queue.append(task)
            self._changed.notify_all()
        try:
            found: T = await task.answer
        except asyncio.CancelledError:
            if task.worker is not None:
                task.worker.abandon()
            else:
                with suppress(ValueError):  # it has just ended
                    self._queue.remove(task)
            raise
        return found

    async def run_everywhere(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> None:
        """Do a task once in every process, before anything else that waits.

        What it raises is logged only.
        """
        loop = asyncio.get_running_loop()
        errands = [
            _Task(partial(work, *args, **kwargs), loop.create_future()) for _ in self._workers
        ]
        async with self._changed:
            for one, errand in zip(self._workers, errands, strict=True):
                one.errands.append(errand)
            self._changed.notify_all()
        for found in await asyncio.gather(*(e.answer for e in errands), return_exceptions=True):
            if isinstance(found, BaseException):
                logger.warning("a worker process could not %s: %s", work.__name__, found)

    async def close(self) -> None:
        """End all processes at once; tasks that wait or run are told that the server ends."""
        for serving in self._serving:
            serving.cancel()
        if self._serving:
            await asyncio.wait(self._serving)
        for task in (*self._queue, *(task for one in self._workers for task in one.errands)):
            if not task.answer.done():
                task.answer.set_exception(stopping_error())
        await asyncio.gather(*(asyncio.to_thread(one.stop) for one in self._workers))

    async def _serve(self, one: _Worker) -> None:
        """Give one process its tasks, and replace it when it dies."""
        while True:
            task = await self._next(one)
            if task is None:  # idle for a while: is it still there?
                with suppress(VislocError):
                    await one.run(self._limit_s, partial(worker.ping))
            elif not task.answer.done():
                await self._work_on(one, task)
            if not one.alive:
                await self._replace(one)

    async def _work_on(self, one: _Worker, task: _Task) -> None:
        task.worker = one
        try:
            found = await one.run(self._limit_s, task.work)
        except asyncio.CancelledError:
            if not task.answer.done():
                task.answer.set_exception(stopping_error())
            raise
        except Exception as error:  # noqa: BLE001  whatever it is, it is the caller's
            if not task.answer.done():
                task.answer.set_exception(error)
        else:
            if not task.answer.done():
                task.answer.set_result(found)
        finally:
            task.worker = None  # which may work on another before the caller hears of it

    async def _next(self, one: _Worker) -> _Task | None:
        """Wait for a task; None when there is none for a while."""
        try:
            async with asyncio.timeout(_WATCH_S), self._changed:
                await self._changed.wait_for(lambda: one.errands or self._queue)
                return one.errands.popleft() if one.errands else self._queue.popleft()
        except TimeoutError:
            return None

    async def _replace(self, one: _Worker) -> None:
        self._on_death()
        while True:
            logger.error("worker process %s died; starting another", one.pid)
            try:
                before = {loaded.ref for loaded in one.loaded}
                await one.start([of for of in self._warm() if of.ref in before])
            except VislocError as error:
                logger.error("a worker process cannot start: %s", error)  # noqa: TRY400
                await asyncio.sleep(_RESTART_PAUSE_S)
            else:
                logger.info("worker process %s took over", one.pid)
                return


class _Worker:
    """One process, or the next that takes its place."""

    def __init__(self, settings: WorkerSettings) -> None:
        self._settings = settings
        # Not fork: torch hangs in a child of a process that has used it, gRPC too. The fork server
        # has loaded the libraries and used none, so that a new process begins in no time.
        self._context = get_context("forkserver")
        self._context.set_forkserver_preload([FORK_SERVER])
        # Not an Event: its lock stays taken when a process is killed that looks at it.
        self._abandoned = self._context.RawValue(ctypes.c_bool, False)
        self._executor: ProcessPoolExecutor | None = None
        self.pid = 0
        self.alive = False
        self.busy = False
        self.loaded: tuple[Loaded, ...] = ()
        self.errands: deque[_Task] = deque()

    async def start(self, maps: Sequence[MapFolder]) -> None:
        """Begin a process and open maps in it; one that cannot be opened is only logged there.

        Raises:
            Unavailable: ``server.worker_died``.
        """
        await asyncio.to_thread(self.stop)
        executor = ProcessPoolExecutor(
            1,
            mp_context=self._context,
            initializer=worker.start,
            initargs=(self._settings, self._abandoned),
        )
        self._executor = executor
        self._abandoned.value = False
        self.pid, self.alive = 0, True
        try:
            # In a thread: the first process waits for the fork server, which loads libraries first.
            first = await asyncio.to_thread(executor.submit, worker.call, os.getpid)
        except (OSError, EOFError) as error:  # no memory or file descriptors for a process
            self.alive = False
            logger.error("no process can be started: %s", error)  # noqa: TRY400
            raise _died() from None
        self.pid = await self._answer_of(first, _START_LIMIT_S)
        await self._call(_START_LIMIT_S, partial(worker.warm, tuple(maps)))

    async def run(self, limit_s: float, work: Callable[[], T]) -> T:
        """Do a task.

        Raises:
            Unavailable: ``server.worker_died``.
            TimedOut: ``server.deadline``; the process is killed.
        """
        self._abandoned.value = False
        self.busy = True
        try:
            return await self._call(limit_s, work)
        finally:
            self.busy = False

    def abandon(self) -> None:
        """Tell the process that nobody waits for its task."""
        if self.busy:
            self._abandoned.value = True

    def stop(self) -> None:
        """End the process, whatever it does."""
        if self.alive:
            self._kill()
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None

    async def _call(self, limit_s: float, work: Callable[[], T]) -> T:
        if self._executor is None or not self.alive:
            raise _died()
        try:
            future = self._executor.submit(worker.call, work)
        except BrokenProcessPool:
            self.alive = False
            raise _died() from None
        return await self._answer_of(future, limit_s)

    async def _answer_of(
        self, running: concurrent.futures.Future[tuple[T, tuple[Loaded, ...]]], limit_s: float
    ) -> T:
        try:
            future = asyncio.wrap_future(running)
            done, _ = await asyncio.wait({future}, timeout=limit_s)
            if not done:
                self._kill()
                await asyncio.wait({future})
                with suppress(BrokenProcessPool):
                    future.result()
                raise refuse(
                    "server.deadline",
                    "the request took too long; ask for less, or raise request_timeout_s",
                    expected=f"at most {limit_s:g} s",
                )
            result, self.loaded = future.result()
        except BrokenProcessPool:
            self.alive = False
            raise _died() from None
        return result

    def _kill(self) -> None:
        self.alive = False
        if self.pid:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)


def _died() -> VislocError:
    return refuse("server.worker_died")
