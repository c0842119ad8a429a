"""A sequence over gRPC: instants are sent as the server takes them, answers come in between."""

from __future__ import annotations

import asyncio
import time
from collections.abc import (
    AsyncGenerator,
    AsyncIterable,
    AsyncIterator,
    Callable,
    Coroutine,
    Iterable,
)
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from clients import errors
from clients.transport.grpc_errors import grpc_failure
from clients.transport.messages import instant_message, plain, start_message
from clients.wire.requests import JsonObject, StartSequence
from visloc_api.v1 import localization_pb2 as wire
from visloc_api.words.sequences import Instant


async def stream_answers(
    make_call: Callable[[], Any],  # the stubs do not know that the messages may be written later
    server: str,
    timeout_s: float,
    start: StartSequence,
    instants: AsyncIterable[Instant],
) -> AsyncGenerator[JsonObject, None]:
    """Give the answers of a sequence as plain JSON.

    An error of ``instants`` is raised after the answers to the instants before it, whatever the
    server makes of a sequence that ends there.

    Args:
        timeout_s: longest time without an answer while the server has an instant to work on.
        instants: the first one is taken before anything is sent.
    """
    waiting = aiter(instants)
    first = await anext(waiting, None)
    head = (
        [start_message(start)] if first is None else [start_message(start), instant_message(first)]
    )
    feed = _Feed()
    call = make_call()
    ending = _Ending(call)
    feeding = asyncio.create_task(feed.write(call, head, waiting))
    try:
        while True:
            answer = await _read_patiently(call, feed, server, timeout_s)
            if not isinstance(answer, bytes):  # the end of the stream
                break
            yield _read(server, answer)
    except grpc.aio.AioRpcError as error:
        if feed.failure is None:
            raise grpc_failure(server, timeout_s, ending.error or error) from error
    finally:
        call.cancel()
        feeding.cancel()
        await asyncio.gather(feeding, return_exceptions=True)
    if feed.failure is not None:
        raise feed.failure


class _Ending:
    """The status with which a call ended.

    When a message is written while the server ends the call, grpc.aio mostly has the server's
    status first, and then replaces it with ``INTERNAL`` (https://github.com/grpc/grpc/issues/36066).

    Attributes:
        error: the first status, if it is not ``OK``; None while the call lasts.
    """

    def __init__(self, call: Any) -> None:
        self.error: grpc.aio.AioRpcError | None = None
        call.add_done_callback(self._keep)

    def _keep(self, call: Any) -> None:
        code = _result(call.code())
        if self.error is None and code is not grpc.StatusCode.OK:
            trailing, details = _result(call.trailing_metadata()), _result(call.details())
            self.error = grpc.aio.AioRpcError(code, grpc.aio.Metadata(), trailing, details, None)


def _result(known: Coroutine[Any, Any, Any]) -> Any:
    """Return the result of a coroutine that waits for nothing."""
    try:
        known.send(None)
    except StopIteration as done:
        return done.value
    raise AssertionError("it waits")


class _Feed:
    """Writes instants to a call, and knows which side the other one waits for.

    Attributes:
        waits_since: since when the client waits for the server, by ``time.monotonic``; None while
            the server waits for the caller's next instant.
        failure: what the caller's iterable raised.
    """

    def __init__(self) -> None:
        self.waits_since: float | None = time.monotonic()
        self.failure: Exception | None = None

    async def write(
        self,
        call: Any,
        head: Iterable[wire.LocalizeSequenceRequest],
        instants: AsyncIterable[Instant],
    ) -> None:
        try:
            for message in head:
                await call.write(message.SerializeToString())
            async for content in self._messages(instants):
                await call.write(content)
            await call.done_writing()
        except (grpc.aio.AioRpcError, asyncio.InvalidStateError):
            pass  # the call is over; reading from it tells why

    async def _messages(self, instants: AsyncIterable[Instant]) -> AsyncIterator[bytes]:
        self.waits_since = None
        try:
            async for instant in instants:
                self.waits_since = time.monotonic()
                yield instant_message(instant).SerializeToString()
                self.waits_since = None
        except Exception as error:  # noqa: BLE001 - whatever it is, the caller gets it
            self.failure = error
        self.waits_since = time.monotonic()

    def seconds_left(self, asked_at: float, timeout_s: float) -> float:
        """Return how long to wait at least for an answer that was asked for at a time."""
        if self.waits_since is None:
            return timeout_s
        return max(self.waits_since, asked_at) + timeout_s - time.monotonic()


async def _read_patiently(call: Any, feed: _Feed, server: str, timeout_s: float) -> Any:
    asked_at = time.monotonic()
    reading = asyncio.ensure_future(call.read())
    try:
        while (left := feed.seconds_left(asked_at, timeout_s)) > 0:
            await asyncio.wait({reading}, timeout=left)
            if reading.done():
                return reading.result()
    finally:
        reading.cancel()
    raise feed.failure or errors.timed_out(server, timeout_s)


def _read(server: str, answer: bytes) -> JsonObject:
    try:
        return plain(wire.InstantAnswer.FromString(answer))
    except DecodeError as error:
        raise errors.not_understood(server, str(error)) from error
