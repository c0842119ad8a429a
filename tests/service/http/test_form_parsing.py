from __future__ import annotations

import asyncio
from collections.abc import Mapping

import pytest

from service.http import bodies as intake
from visloc.errors import InvalidInput


class Clock:
    """A time that only parsing and resting move on."""

    def __init__(self) -> None:
        self.now = 100.0
        self.rests: list[float] = []

    def rest(self, seconds: float) -> None:
        self.rests.append(seconds)
        self.now += seconds


def test_parsing_rests_between_batches_for_as_long_as_it_took(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock()
    monkeypatch.setattr(intake, "monotonic", lambda: clock.now)
    monkeypatch.setattr(intake, "sleep", clock.rest)
    parser = intake._BatchParser()

    def job(text: str | bytes, _files: Mapping[str, bytes]) -> str:
        clock.now += 0.25
        if text == "wrong":
            raise InvalidInput("request.malformed", "not JSON")
        return str(text)

    async def play() -> None:
        assert await parser.parse(job, "first", {}) == "first"
        with pytest.raises(InvalidInput):
            await parser.parse(job, "wrong", {})
        assert await parser.parse(job, "third", {}) == "third"
        assert clock.rests == [0.25, 0.25]
        clock.now += 10.0
        assert await parser.parse(job, "after a while", {}) == "after a while"
        assert clock.rests == [0.25, 0.25]

    asyncio.run(play())
