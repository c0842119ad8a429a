from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator

import pytest

from service.api.deadlines import TimeLimit, each_within, time_limit_of, within
from visloc.errors import TimedOut


def test_a_caller_may_allow_less_than_the_server_and_not_more() -> None:
    assert time_limit_of(None, 60.0) == TimeLimit(60.0)
    assert time_limit_of("2.5", 60.0) == TimeLimit(2.5, is_callers=True)
    assert time_limit_of("60", 60.0) == time_limit_of("1e9", 60.0) == TimeLimit(60.0)


@pytest.mark.parametrize(
    ("limit", "code"),
    [
        (TimeLimit(0.01), "server.deadline"),
        (TimeLimit(0.01, is_callers=True), "request.deadline"),
    ],
)
def test_the_code_tells_whose_limit_it_was(limit: TimeLimit, code: str) -> None:
    async def forever() -> AsyncGenerator[int]:
        yield 1
        await asyncio.sleep(60)

    async def wait() -> None:
        async with within(limit):
            await asyncio.sleep(60)

    async def wait_for_each() -> None:
        async for _ in each_within(limit, forever()):
            pass

    for waits in (wait, wait_for_each):
        with pytest.raises(TimedOut) as caught:
            asyncio.run(waits())
        assert caught.value.code == code
