"""Messages that take long to parse, one after the other in a thread of their own."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from itertools import count
from queue import PriorityQueue
from threading import Lock, Thread
from time import monotonic, sleep
from traceback import clear_frames
from typing import Any, TypeVar

from visloc.errors import refuse

T = TypeVar("T")

# Messages that wait, as they came. Over HTTP, bodies that arrive are counted with them before.
_MAX_WAITING_BYTES = 512 * 2**20
# A message is overtaken by what comes before it could have come at this rate.
_RANK_BYTES_PER_S = 16 * 2**20


@dataclass(order=True)
class _Waiting:
    """A message that waits for its turn; the least rank comes first."""

    rank: float
    number: int
    parse: Callable[[], Any] = field(compare=False)
    parsed: Future[Any] = field(compare=False)
    size: int = field(compare=False)


class OneByOne:
    """Parses large messages in one thread, and rests after each for as long as it took.

    Parsing holds Python's lock for some hundredths of a second at a time. Answering any other
    request takes several turns of the event loop, and each turn would wait for every thread that
    parses. So there is one, for both APIs. Small messages come before large ones: a message counts
    as if it had come later, by a second for every 16 MiB. No message waits for ever, because what
    comes after that is behind it.
    """

    def __init__(self) -> None:
        self._waiting: PriorityQueue[_Waiting] = PriorityQueue()
        self._numbers = count()
        self._thread: Thread | None = None
        self._lock, self._bytes = Lock(), 0

    async def run(self, parse: Callable[[], T], size: int) -> T:
        """Return what ``parse`` returns; raises what it raises.

        Args:
            parse: is not called when the caller is cancelled before its turn.
            size: of the message, bytes.
        """
        # Without a variable for what holds the error: they would hold each other, and the message.
        return await asyncio.wrap_future(self._enqueued(parse, size))

    def _enqueued(self, parse: Callable[[], T], size: int) -> Future[T]:
        if self._thread is None:
            self._thread = Thread(target=self._work, name="parsing", daemon=True)
            self._thread.start()
        self._count(size)
        parsed: Future[T] = Future()
        rank = monotonic() + size / _RANK_BYTES_PER_S
        self._waiting.put(_Waiting(rank, next(self._numbers), parse, parsed, size))
        return parsed

    def _work(self) -> None:
        while True:
            sleep(self._parse_next())

    def _parse_next(self) -> float:
        """Parse the next message; return the seconds that it took."""
        each = self._waiting.get()
        self._count(-each.size)
        if not each.parsed.set_running_or_notify_cancel():
            return 0.0
        started = monotonic()
        try:
            each.parsed.set_result(each.parse())
        # The caller that waits gets the error. A panic of a library in Rust is no Exception, and
        # would end the only thread.
        except BaseException as error:  # noqa: BLE001 - see above
            clear_frames(error.__traceback__)  # which hold the message
            each.parsed.set_exception(error)
        finally:
            del each  # of this frame too, which the error holds
        return monotonic() - started

    def _count(self, size: int) -> None:
        with self._lock:
            if size > 0 and self._bytes + size > _MAX_WAITING_BYTES:
                raise refuse("server.busy", "too many bytes wait to be parsed; try again shortly")
            self._bytes += size


ONE_BY_ONE = OneByOne()
