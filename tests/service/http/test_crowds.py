"""Requests that do not arrive while others like them hold most connections."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from service.http import acceptor as crowds
from service.http.acceptor import Patient


def part(body: bytes, *, more: bool) -> dict[str, object]:
    return {"type": "http.request", "body": body, "more_body": more}


GONE = {"type": "http.disconnect"}


def seen_by_app(*messages: dict[str, object], crowded: bool = True) -> list[Any]:
    """What an app gets of a request of these messages, after which nothing comes."""
    waiting, seen = list(messages), []

    async def receive() -> Any:
        if not waiting:
            await asyncio.sleep(3600)
        return waiting.pop(0)

    async def app(_: Any, receive: Any, __: Any) -> None:
        seen.append("begun")
        while len(seen) <= len(messages):
            seen.append(await receive())
            if not seen[-1].get("more_body"):
                return

    async def play() -> None:
        connections: Any = SimpleNamespace(is_crowded=crowded)
        patient = Patient(app, connections)
        async with asyncio.timeout(5):
            await patient({"type": "http"}, receive, receive)  # type: ignore[arg-type]

    asyncio.run(play())
    return seen


def test_a_request_that_has_come_is_seen_as_it_came() -> None:
    parts = [part(b"ab", more=True), part(b"c", more=False)]
    assert seen_by_app(*parts) == ["begun", *parts]


def test_a_request_without_a_body_is_seen() -> None:
    assert seen_by_app(part(b"", more=False)) == ["begun", part(b"", more=False)]


def test_an_app_does_not_see_whose_connection_is_closed_before() -> None:
    assert seen_by_app(part(b"a", more=True), GONE) == []


def test_where_there_is_room_the_app_sees_it_at_once() -> None:
    parts = [part(b"a", more=True), GONE]
    assert seen_by_app(*parts, crowded=False) == ["begun", *parts]


def test_a_large_body_that_comes_is_seen_before_its_end() -> None:
    parts = [part(bytes(65536), more=True), GONE]
    assert seen_by_app(*parts) == ["begun", *parts]


def test_a_slow_body_is_seen_at_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crowds, "_ENOUGH_S", 0.01)
    seen, come = [], [part(b"a", more=True)]

    async def receive() -> Any:
        if not come:
            await asyncio.sleep(3600)
        return come.pop(0)

    async def app(_: Any, receive: Any, __: Any) -> None:
        seen.append(await receive())

    async def play() -> None:
        connections: Any = SimpleNamespace(is_crowded=True)
        await Patient(app, connections)({"type": "http"}, receive, receive)  # type: ignore[arg-type]

    asyncio.run(play())
    assert seen == [part(b"a", more=True)]
