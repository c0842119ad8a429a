"""Messages that take long to parse: their order, and what stays of them."""

from __future__ import annotations

import asyncio
import gc
import weakref
from functools import partial
from threading import Event

import pytest

from service.api import parsing
from service.api.parsing import OneByOne
from visloc.errors import Overloaded

MIB = 2**20


class Message:
    """Something that can be seen to be released."""


def test_it_rests_between_messages_for_as_long_as_the_last_one_took(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, begun = [100.0], list[float]()

    def rest(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(parsing, "monotonic", lambda: now[0])
    monkeypatch.setattr(parsing, "sleep", rest)
    queue = OneByOne()

    def parse(text: str) -> str:
        begun.append(now[0])
        now[0] += 0.25
        if text == "wrong":
            raise ValueError("this is none")
        return text

    async def play() -> None:
        assert await queue.run(partial(parse, "first"), 1) == "first"
        with pytest.raises(ValueError, match="this is none"):
            await queue.run(partial(parse, "wrong"), 1)
        assert await queue.run(partial(parse, "third"), 1) == "third"

    asyncio.run(play())

    assert begun == [100.0, 100.5, 101.0]


def test_a_small_message_overtakes_large_ones_that_wait() -> None:
    queue, free, parsed = OneByOne(), Event(), list[str]()

    async def play() -> None:
        running = asyncio.create_task(queue.run(free.wait, 0))
        await asyncio.sleep(0)
        sizes = {"large": 64 * MIB, "larger": 128 * MIB, "small": 1000}
        waiting = [
            asyncio.create_task(queue.run(lambda name=name: parsed.append(name), size))
            for name, size in sizes.items()
        ]
        await asyncio.sleep(0)
        free.set()
        await asyncio.gather(running, *waiting)

    asyncio.run(play())

    assert parsed == ["small", "large", "larger"]


def test_a_message_whose_caller_left_is_not_parsed() -> None:
    queue, free, parsed = OneByOne(), Event(), list[str]()

    async def play() -> None:
        running = asyncio.create_task(queue.run(free.wait, 0))
        await asyncio.sleep(0)
        leaving = asyncio.create_task(queue.run(lambda: parsed.append("left"), 1))
        staying = asyncio.create_task(queue.run(lambda: parsed.append("stayed"), 2))
        await asyncio.sleep(0)
        leaving.cancel()
        free.set()
        await asyncio.gather(running, staying)

    asyncio.run(play())

    assert parsed == ["stayed"]


def test_more_than_there_is_room_for_is_refused_until_there_is_again() -> None:
    queue, free = OneByOne(), Event()

    async def play() -> None:
        running = asyncio.create_task(queue.run(free.wait, 0))
        waiting = [asyncio.create_task(queue.run(lambda: None, 256 * MIB)) for _ in range(2)]
        await asyncio.sleep(0)
        with pytest.raises(Overloaded):
            await queue.run(lambda: None, 1)
        free.set()
        await asyncio.gather(running, *waiting)
        await queue.run(lambda: None, 256 * MIB)

    asyncio.run(play())


def test_it_goes_on_after_a_panic_of_a_parser() -> None:
    class Panic(BaseException):
        """Like pyo3's PanicException, it is no Exception."""

    queue = OneByOne()

    def panic() -> None:
        raise Panic

    async def play() -> None:
        async with asyncio.timeout(10):
            with pytest.raises(Panic):
                await queue.run(panic, 1)
            assert await queue.run(lambda: "parsed", 1) == "parsed"

    asyncio.run(play())


def test_nothing_of_a_refused_message_stays() -> None:
    queue, messages = OneByOne(), list["weakref.ref[Message]"]()

    def parse() -> None:
        message = Message()
        messages.append(weakref.ref(message))
        raise ValueError("this is none")

    async def play() -> None:
        with pytest.raises(ValueError, match="this is none"):
            await queue.run(parse, 1)
        assert messages[0]() is None

    gc.disable()
    try:
        asyncio.run(play())
    finally:
        gc.enable()
