from __future__ import annotations

import asyncio

import pytest

from service.grpc.slow_clients import Waiting


def test_the_call_that_has_waited_longest_gives_its_place_to_another() -> None:
    waiting, ended = Waiting(2), list[str]()

    async def call(name: str, message: asyncio.Event) -> None:
        try:
            async with waiting.place(60.0):
                await message.wait()
        except TimeoutError:
            ended.append(name)

    async def play() -> None:
        come, never = asyncio.Event(), asyncio.Event()
        calls = [asyncio.create_task(call("first", never))]
        await asyncio.sleep(0)
        calls.append(asyncio.create_task(call("second", come)))
        await asyncio.sleep(0)
        come.set()  # whose message came gives its place back
        await calls[1]
        for name in ("third", "fourth"):
            calls.append(asyncio.create_task(call(name, never)))
            await asyncio.sleep(0)
        await calls[0]
        assert ended == ["first"]
        for each in calls[2:]:
            each.cancel()

    asyncio.run(play())


def test_a_message_that_does_not_come_is_not_waited_for_longer() -> None:
    async def play() -> None:
        async with Waiting(1).place(0.01):
            await asyncio.sleep(60)

    with pytest.raises(TimeoutError):
        asyncio.run(play())


def test_a_call_whose_time_is_over_just_now_does_not_fail_the_one_that_takes_its_place() -> None:
    async def play() -> None:
        waiting = Waiting(1)

        async def call(patience_s: float) -> None:
            async with waiting.place(patience_s):
                await asyncio.sleep(60)

        over = asyncio.create_task(call(0.0))
        loop, calls = asyncio.get_running_loop(), list[asyncio.Task[None]]()
        # In the turn in which the first one's time is over, before it can give its place back.
        loop.call_soon(lambda: calls.append(asyncio.create_task(call(60.0))))
        for _ in range(5):
            await asyncio.sleep(0)
        assert isinstance(over.exception(), TimeoutError)
        assert not calls[0].done()
        calls[0].cancel()

    asyncio.run(play())
