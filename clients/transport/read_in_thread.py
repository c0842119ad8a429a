"""Reading an iterable of the caller without blocking the event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncGenerator, Iterable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")
_END = object()


async def read_in_thread(items: Iterable[T]) -> AsyncGenerator[T, None]:
    """Give the items, each taken in a thread of its own.

    Not a thread of the loop's pool: the next item may never come, and the process waits for the
    pool when it ends.
    """
    waiting = iter(items)
    while True:
        taken: Future[T | object] = Future()
        taken.set_running_or_notify_cancel()  # from here on it cannot be cancelled

        def take(taken: Future[T | object] = taken) -> None:
            try:
                taken.set_result(next(waiting, _END))
            except BaseException as error:  # noqa: BLE001 - raised below
                taken.set_exception(error)

        threading.Thread(target=take, name="visloc-instants", daemon=True).start()
        item = await asyncio.wrap_future(taken)
        if item is _END:
            return
        yield item  # type: ignore[misc]
