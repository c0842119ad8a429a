"""A pool of worker processes: always warm, replaced when they die, one task at a time each.

Tasks queue by request (``Turn``), not by the time at which they were queued.

Native code can end a process without an exception; only the request in that process is lost. Each
process has a connection of its own, which ends with it, even in the middle of a message: the
standard executor would wait for the rest for ever (docs/decisions/0013-worker-processes.md).
"""

from __future__ import annotations

import asyncio
import atexit
import logging
import pickle
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import Context, ContextVar, copy_context
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from itertools import count as numbers
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from operator import methodcaller
from time import monotonic
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

from service.errors import stopping_error
from service.machine import usable_cores
from service.values import MapFolder, OpenMap, Signals, WorkerSettings
from service.workers import process
from service.workers.tasks import Vision
from visloc.errors import Unavailable, VislocError, refuse

logger = logging.getLogger(__name__)

P = ParamSpec("P")
T = TypeVar("T")

Task = Callable[[Vision], T]

# The module that the fork server loads; not imported here, where it would change what SIGTERM does.
FORK_SERVER = "service.workers.forkserver"
# How often an idle worker is pinged.
_WATCH_S = 1.0
# Pause before a worker that cannot start is tried again.
_RESTART_PAUSE_S = 1.0
# Longest time for a process to begin, and for it to open a map that is in service.
_START_LIMIT_S = 300.0
# How long a process may go on with a task that nobody waits for any more, until its next step
# (decision 0057): more than an ordinary photo takes in all.
_STEP_LIMIT_S = 1.0
_PING = methodcaller(str(Vision.ping))
# The seconds by which a request falls back in the queue for each second that workers spent on it.
# Twice as many as there are sequences at once by default: all together then take at most half of a
# worker from photos that wait.
_SETBACK = 16.0


@dataclass
class Turn:
    """The place of a request in the queue, which its tasks have one after the other.

    A sequence of a few photos takes a dozen tasks. If each queued behind all photos that came
    before it, a queue of five seconds would take a minute.

    The time between two tasks does not count: streams that were silent, and then speak all at once,
    must not overtake the photos that wait.

    Attributes:
        since: when the request began, and later by the time between its tasks, and by what workers
            have spent on them.
    """

    since: float = field(default_factory=monotonic)
    _rested: float = field(init=False)

    def __post_init__(self) -> None:
        self._rested = self.since

    def rank(self) -> float:
        """Return the rank of the next task: the least comes first, none is behind a new request."""
        now = monotonic()
        self.since += now - self._rested
        self._rested = now
        return min(now, self.since)

    def worked(self, seconds: float) -> None:
        """Let the request fall back by what a worker has spent on it."""
        self.since += _SETBACK * seconds
        self._rested = monotonic()


_turn: ContextVar[Turn | None] = ContextVar("turn", default=None)


@contextmanager
def using_turn(turn: Turn) -> Iterator[None]:
    """Give a turn to all that is run in the block, also by tasks of asyncio that begin in it."""
    token = _turn.set(turn)
    try:
        yield
    finally:
        _turn.reset(token)


@dataclass(order=True)
class _Queued:
    """A task, the future of its result, and the worker that runs it now; the least comes first.

    Attributes:
        context: context variables of the request, such as its key.
    """

    rank: float
    number: int
    turn: Turn = field(compare=False)
    task: Task[Any] = field(compare=False)
    answer: asyncio.Future[Any] = field(compare=False)
    worker: _Worker | None = field(default=None, compare=False)
    context: Context = field(default_factory=copy_context, compare=False)


class Workers:
    """A fixed number of worker processes behind one queue. Used from one event loop.

    Args:
        limit_s: longest time that one task may take; a process that exceeds it is replaced.
        warm: the maps that may be open; a new process opens those that its predecessor had open,
            while no task waits.
        on_overdue: called for every process that was ended because it went on with a request after
            its deadline, or after its caller had left; in the context of that request.
    """

    def __init__(
        self,
        count: int,
        settings: WorkerSettings,
        *,
        limit_s: float,
        warm: Callable[[], Sequence[MapFolder]],
        on_death: Callable[[], None],
        on_overdue: Callable[[], None],
    ) -> None:
        self._workers = [_Worker(settings) for _ in range(count)]
        self._most_threads = settings.threads
        self._cores = usable_cores()
        self._limit_s = limit_s
        self._warm = warm
        self._on_death = on_death
        self._on_overdue = on_overdue
        self._queue: list[_Queued] = []  # a heap
        self._numbers = numbers()
        self._changed = asyncio.Condition()
        self._serving: list[asyncio.Task[None]] = []
        self._closed = False

    @property
    def count(self) -> int:
        return len(self._workers)

    @property
    def started(self) -> bool:
        return bool(self._serving)

    @property
    def waiting(self) -> int:
        """Tasks that no worker has taken yet."""
        return sum(not queued.answer.done() for queued in self._queue)

    @property
    def running(self) -> int:
        return sum(one.busy for one in self._workers)

    @property
    def alive(self) -> int:
        return sum(one.alive for one in self._workers)

    @property
    def pids(self) -> tuple[int, ...]:
        return tuple(one.pid for one in self._workers if one.alive)

    @property
    def loaded(self) -> dict[str, int]:
        """Bytes of the maps that are open in any process, by ``id@version``."""
        return {ref: size for one in self._workers for ref, size in one.open_maps}

    async def start(self) -> None:
        """Start all processes."""
        await asyncio.gather(*(one.start() for one in self._workers))
        self._serving = [asyncio.create_task(self._serve(one)) for one in self._workers]

    async def run(
        self, method: Callable[Concatenate[Vision, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Run a task in the next free worker. Cancelling the caller cancels the task.

        A task that has not begun is then dropped; a running one ends at its next step. If that
        takes too long, its process is ended.
        """
        if self._closed:  # nobody would ever take it: uploads are verified until then
            raise stopping_error()
        task: Task[T] = methodcaller(str(method), *args, **kwargs)
        queued = self._queued(task, _turn.get() or Turn())
        async with self._changed:
            heappush(self._queue, queued)
            self._changed.notify_all()
        try:
            result: T = await queued.answer
        except asyncio.CancelledError:
            if queued.worker is not None:
                queued.worker.abandon()
            else:
                with suppress(ValueError):  # it has just ended
                    self._queue.remove(queued)
                    heapify(self._queue)
            raise
        return result

    async def run_again_if_killed(
        self, method: Callable[Concatenate[Vision, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Run a task that may be begun twice: if its process dies, once more in another.

        Photos are not tried again: one that ended a process would end the next. Opening a map is,
        because most processes die of something else, and operators rarely repeat a swap.
        """
        try:
            return await self.run(method, *args, **kwargs)
        except Unavailable as error:
            if error.code != "server.worker_died":
                raise
        return await self.run(method, *args, **kwargs)

    async def run_everywhere(
        self, method: Callable[Concatenate[Vision, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> None:
        """Run a task once in every process, before queued tasks; log its errors."""
        task: Task[T] = methodcaller(str(method), *args, **kwargs)
        errands = [self._queued(task, Turn()) for _ in self._workers]
        async with self._changed:
            for one, errand in zip(self._workers, errands, strict=True):
                one.errands.append(errand)
            self._changed.notify_all()
        for found in await asyncio.gather(*(e.answer for e in errands), return_exceptions=True):
            if isinstance(found, BaseException):
                logger.warning("a worker process could not %s: %s", method, found)

    def _queued(self, task: Task[Any], turn: Turn) -> _Queued:
        answer = asyncio.get_running_loop().create_future()
        return _Queued(turn.rank(), next(self._numbers), turn, task, answer)

    async def close(self) -> None:
        """End all processes at once; queued and running tasks raise ``server.stopping``."""
        self._closed = True
        for serving in self._serving:
            serving.cancel()
        if self._serving:
            await asyncio.wait(self._serving)
        for queued in (*self._queue, *(each for one in self._workers for each in one.errands)):
            if not queued.answer.done():
                queued.answer.set_exception(stopping_error())
        await asyncio.gather(*(one.stop() for one in self._workers))

    async def _serve(self, one: _Worker) -> None:
        """Give one process its tasks, and replace it when it dies."""
        while True:
            queued = await self._next(one)
            if queued is not None:
                if not queued.answer.done():
                    await self._work_on(one, queued)
            elif one.unopened:
                await self._open_next(one)
            else:  # idle for a while: is it still there?
                await one.do(self._limit_s, _PING)
            if not one.alive:
                await self._replace(one)

    async def _work_on(self, one: _Worker, queued: _Queued) -> None:
        queued.worker, started = one, monotonic()
        try:
            threads = share_of_cores(self._cores, self.running + 1, self._most_threads)
            result = await one.run(self._limit_s, queued.task, threads)
        except asyncio.CancelledError:
            if not queued.answer.done():
                queued.answer.set_exception(stopping_error())
            raise
        except Exception as error:  # noqa: BLE001  whatever it is, the caller gets it
            if not queued.answer.done():
                queued.answer.set_exception(error)
        else:
            if not queued.answer.done():
                queued.answer.set_result(result)
        finally:
            queued.turn.worked(monotonic() - started)
            queued.worker = None  # it may take another task before the caller sees the result
            if one.overdue:
                queued.context.run(self._note_overdue, one.pid)

    async def _open_next(self, one: _Worker) -> None:
        """Open one of the maps that the process before had open, if it is served still."""
        ref = one.unopened.popleft()
        for version in self._warm():
            if version.ref == ref:
                await one.do(_START_LIMIT_S, methodcaller(str(Vision.warm), version))
                return

    async def _next(self, one: _Worker) -> _Queued | None:
        """Wait for a task; return None when there is none for a while, or now but maps to open."""
        if one.unopened and not (one.errands or self._queue):
            return None
        try:
            async with asyncio.timeout(_WATCH_S), self._changed:
                await self._changed.wait_for(lambda: one.errands or self._queue)
                if not one.is_there:  # the task waits for its successor, or goes to another
                    return None
                return one.errands.popleft() if one.errands else heappop(self._queue)
        except TimeoutError:
            return None

    def _note_overdue(self, pid: int) -> None:
        logger.warning("worker process %s was ended: it went on after its request", pid)
        self._on_overdue()

    async def _replace(self, one: _Worker) -> None:
        if not one.overdue:
            logger.error("worker process %s died; starting another", one.pid)
            self._on_death()
        before = (opened.ref for opened in one.open_maps)
        one.unopened = deque(dict.fromkeys((*before, *one.unopened)))
        while True:
            try:
                await one.start()
            except VislocError as error:
                logger.error("a worker process cannot start: %s", error)  # noqa: TRY400
                await asyncio.sleep(_RESTART_PAUSE_S)
            else:
                logger.info("worker process %s took over", one.pid)
                return


def share_of_cores(cores: int, running: int, most: int) -> int:
    """Return the threads for a task when so many run: a photo alone has all cores.

    Threads beyond the cores would take turns on them, and answer no more photos.
    """
    return max(1, min(most, cores // running))


class _Worker:
    """A worker process and its replacements.

    All that blocks happens in one thread of its own, so that one step begins after the other.
    """

    def __init__(self, settings: WorkerSettings) -> None:
        self._settings = settings
        # Not fork: torch and gRPC hang in a child of a process that has used them. The fork server
        # has loaded the libraries and used none, so that a new process begins at once.
        self._context = get_context("forkserver")
        self._context.set_forkserver_preload([FORK_SERVER])
        # No Events: their locks stay locked when a process is killed while it reads one.
        self._signals = self._context.RawValue(Signals)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="worker")
        self._process: ForkServerProcess | None = None
        self._connection: Connection | None = None
        self.pid = 0
        self.alive = False
        self.busy = False
        self.overdue = False  # it was ended because it went on for too long
        self._overdue_at: asyncio.TimerHandle | None = None
        self.open_maps: tuple[OpenMap, ...] = ()
        self.unopened: deque[str] = deque()  # what processes before had open, not yet in this one
        self.errands: deque[_Queued] = deque()

    @property
    def is_there(self) -> bool:
        """Whether the process lives now; ``alive`` learns of a death from the next task."""
        started = self._process  # the thread may take it away meanwhile
        return started is not None and started.is_alive()

    async def start(self) -> None:
        """Start a process."""
        loop = asyncio.get_running_loop()
        self._kill()
        self.pid, self.alive, self.overdue = 0, True, False
        try:
            # The first process waits for the fork server, which loads libraries first.
            self.pid = await loop.run_in_executor(self._thread, self._begin)
        except (OSError, EOFError) as error:  # no memory or file descriptors for a process
            self.alive = False
            logger.error("no process can be started: %s", error)  # noqa: TRY400
            raise _died() from None
        await self._call(_START_LIMIT_S, _PING, self._settings.threads)

    async def run(self, limit_s: float, task: Task[T], threads: int) -> T:
        """Run a task with so many threads."""
        self.busy = True
        try:
            return await self._call(limit_s, task, threads)
        finally:
            self.busy = False
            if self._overdue_at is not None:
                self._overdue_at.cancel()

    async def do(self, limit_s: float, task: Task[Any]) -> None:
        """Run a task of no request, during which the process does not count as busy."""
        with suppress(VislocError):
            await self._call(limit_s, task, self._settings.threads)

    def abandon(self) -> None:
        """Tell the process that nobody waits for its task, and end it if it goes on."""
        if self.busy:
            self._signals.abandoned = True
            self._end_at(_STEP_LIMIT_S)

    def _end_at(self, seconds: float) -> None:
        self._overdue_at = asyncio.get_running_loop().call_later(seconds, self._end_overdue)

    def _end_overdue(self) -> None:
        if self._signals.opening:  # else a map that takes longer to open never would be
            self._end_at(_STEP_LIMIT_S)
        else:
            self.overdue = True
            self._kill()

    async def stop(self) -> None:
        """End the process, even if it hangs."""
        self._kill()
        await asyncio.get_running_loop().run_in_executor(self._thread, self._end)
        self._thread.shutdown()

    async def _call(self, limit_s: float, task: Task[T], threads: int) -> T:
        loop = asyncio.get_running_loop()
        self._signals.abandoned = self._signals.opening = False
        asked = loop.run_in_executor(self._thread, self._ask, task, threads)
        done, _ = await asyncio.wait({asked}, timeout=limit_s)
        if not done:
            self.overdue = self.busy
            self._kill()
            await asyncio.wait({asked})  # the end of the process ends the connection
            with suppress(Exception):
                asked.result()
            raise refuse(
                "server.deadline",
                "the request took too long; ask for less, or raise request_timeout_s",
                expected=f"at most {limit_s:g} s",
            )
        reply = asked.result()
        if reply is None:
            self.alive = False
            raise _died()
        result, self.open_maps = reply.opened()
        return cast(T, result)

    def _begin(self) -> int:
        """Start a process in place of the one before; in the thread."""
        self._end()
        ours, theirs = self._context.Pipe()
        started = self._context.Process(
            target=process.serve, args=(theirs, self._settings, self._signals)
        )
        try:
            started.start()
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()  # so that the end of the process is the end of the connection
        atexit.register(ours.close)  # an idle process ends with its connection
        self._process, self._connection = started, ours
        assert started.pid is not None
        return started.pid

    def _ask(self, task: Task[Any], threads: int) -> process.Reply | None:
        """Let the process do a task; None if it died; in the thread."""
        message = pickle.dumps((task, threads), pickle.HIGHEST_PROTOCOL)
        try:
            assert self._connection is not None  # started
            self._connection.send_bytes(message)
            reply = self._connection.recv_bytes()
        except (EOFError, OSError):
            return None
        found = pickle.loads(reply)
        assert isinstance(found, process.Reply)
        return found

    def _end(self) -> None:
        """Wait for the end of a killed process; in the thread."""
        ended, connection = self._process, self._connection
        self._process = self._connection = None
        if ended is None or connection is None:
            return
        ended.kill()  # one that began while it was to be stopped
        ended.join()
        ended.close()
        atexit.unregister(connection.close)
        connection.close()

    def _kill(self) -> None:
        self.alive = False
        started = self._process
        if started is not None and started.is_alive():
            started.kill()


def _died() -> VislocError:
    return refuse("server.worker_died")
