from __future__ import annotations

import asyncio

import pytest

from service.engine.instant_tasks import together


def test_when_one_fails_the_others_have_let_go() -> None:
    held = set[int]()

    async def hold(number: int) -> None:
        held.add(number)
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            held.remove(number)

    async def fail() -> None:
        await asyncio.sleep(0)
        assert held == {1, 2}
        raise ValueError("wrong")

    async def check() -> None:
        with pytest.raises(ValueError, match="wrong"):
            await together([hold(1), fail(), hold(2)])
        assert not held

    asyncio.run(check())
