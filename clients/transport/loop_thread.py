"""An event loop in a thread of its own, for callers that have none."""

from __future__ import annotations

import asyncio
import os
import threading
import weakref
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from queue import SimpleQueue
from typing import Any, Generic, Protocol, TypeVar

from clients.transport.blocking import Jobs, attended

_END = object()


class _Closeable(Protocol):
    async def close(self) -> None: ...


T = TypeVar("T")
C = TypeVar("C", bound=_Closeable)


class LoopThread(Generic[C]):
    """Waits for the coroutines of a client, which run in a thread with an event loop.

    Safe to call from several threads, and from code that runs in another event loop. The thread
    starts with the first call. It is a daemon and ends with its owner, so that a client that
    nobody closes keeps no process alive. A forked process has no such thread: it makes a client
    and a thread of its own.

    Args:
        make: makes the client, in the caller's thread.
    """

    def __init__(self, make: Callable[[], C]) -> None:
        self._make = make
        self._client = make()
        # Reentrant: a garbage collection within it may end a generator of ``iterate``.
        self._lock = threading.RLock()
        self._running: _Running | None = None
        self._is_closed = False

    @property
    def client(self) -> C:
        """The client, to be called in the loop."""
        with self._lock:
            self._renew_after_fork()
            return self._client

    def run(self, call: Callable[[C], Coroutine[Any, Any, T]]) -> T:
        """Call the client and return what it answers; Ctrl-C cancels the call.

        While it waits, this thread does the blocking work of the call (``run_blocking``).
        """
        jobs: Jobs = SimpleQueue()

        async def attended_call(client: C) -> T:
            try:
                with attended(jobs):
                    return await call(client)
            except (KeyboardInterrupt, SystemExit) as error:  # by a callback: would end the loop
                raise _Exit(error) from None

        future = self._submit(attended_call)
        future.add_done_callback(lambda _: jobs.put(None))
        try:
            while (job := jobs.get()) is not None:
                job()
            return future.result()
        except CancelledError:
            raise RuntimeError("the client was closed during this call") from None
        except _Exit as error:
            raise error.exit from None
        except BaseException:  # also KeyboardInterrupt, which must not leave the request running
            future.cancel()
            raise

    def iterate(self, items: AsyncGenerator[T, None]) -> Iterator[T]:
        """Give the items one by one; leaving early closes the generator."""

        async def take(_: C) -> Any:
            return await anext(items, _END)

        async def close(_: C) -> None:
            await items.aclose()

        try:
            while (item := self.run(take)) is not _END:
                yield item
        finally:
            # Not waited for: the garbage collector may do this in the loop's own thread.
            with suppress(RuntimeError):  # closed: then the generator is closed as well
                self._submit(close, is_waited_for=False)

    def close(self) -> None:
        """Close the client, cancel its calls, and end the thread."""
        with self._lock:
            self._is_closed = True
            running, self._running = self._running, None
        if running is not None and running.pid == os.getpid():
            running.stop()
            running.thread.join()

    def _submit(
        self, call: Callable[[C], Coroutine[Any, Any, T]], *, is_waited_for: bool = True
    ) -> Future[T]:
        # Under the lock, so that no call comes after the loop was told to stop: nobody would
        # answer it.
        with self._lock:
            if self._is_closed:
                raise RuntimeError("the client is closed")
            self._renew_after_fork()
            if self._running is None:
                self._running = _Running(self._client)
                weakref.finalize(self, self._running.stop)
            if is_waited_for and threading.current_thread() is self._running.thread:
                raise RuntimeError(
                    "the client was called by its own callback; use another client there"
                )
            if self._running.loop.is_closed():  # while the interpreter ends
                raise RuntimeError("the client is closed")
            return asyncio.run_coroutine_threadsafe(call(self._client), self._running.loop)

    def _renew_after_fork(self) -> None:
        if self._running is not None and self._running.pid != os.getpid():
            self._running = None
            self._client = self._make()  # connections cannot be shared between processes


class _Exit(Exception):
    """Carries an exception that ends a thread out of the loop."""

    def __init__(self, exit: BaseException) -> None:
        super().__init__()
        self.exit = exit


class _Running:
    """A thread that runs an event loop until it is told to stop."""

    def __init__(self, client: _Closeable) -> None:
        self.pid = os.getpid()
        started: Future[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = Future()
        self.thread = threading.Thread(
            target=asyncio.run, args=(_serve(client, started),), name="visloc-client", daemon=True
        )
        self.thread.start()
        self.loop, self._stopped = started.result()

    def stop(self) -> None:
        """Tell the thread to close the client and end."""
        with suppress(RuntimeError):  # the loop has ended
            self.loop.call_soon_threadsafe(self._stopped.set)


async def _serve(
    client: _Closeable, started: Future[tuple[asyncio.AbstractEventLoop, asyncio.Event]]
) -> None:
    stopped = asyncio.Event()
    started.set_result((asyncio.get_running_loop(), stopped))
    await stopped.wait()
    await client.close()  # asyncio.run then cancels what is still waiting
