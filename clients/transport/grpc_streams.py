"""A sequence over gRPC: instants go out as the server takes them, answers come in between."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import (
    AsyncGenerator,
    AsyncIterable,
    AsyncIterator,
    Callable,
    Iterable,
    Iterator,
)
from contextlib import contextmanager
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from clients import errors
from clients.transport.grpc_errors import grpc_failure
from clients.transport.messages import instant_message, plain, start_message
from clients.wire.requests import JsonObject
from clients.wire.rig_requests import SentInstant, SequenceStart
from visloc_api.v1 import localization_pb2 as wire


def stream_answers(
    make_call: Callable[[Iterator[bytes]], Any],  # the stubs do not know all of what it gives
    server: str,
    timeout_s: float,
    start: SequenceStart,
    instants: Iterable[SentInstant],
) -> Iterator[JsonObject]:
    """Give the answers of a sequence as plain JSON.

    What ``instants`` raises is raised after the answers to the instants before, whatever the
    server says of a sequence that ends there.

    Args:
        make_call: of LocalizeSequence.
        server: for errors.
        timeout_s: longest time without an answer, while the server has an instant to work on.
        start: what is sent first.
        instants: the first is taken before anything is sent, the others in another thread, as the
            server takes them.

    Raises:
        VislocError: what the server refused, or ``server.*``.
    """
    waiting = iter(instants)
    head = _head(start, next(waiting, None))
    feed = _Feed()
    call = make_call(feed.messages(head, waiting))
    has_timed_out = threading.Event()

    def give_up() -> None:
        has_timed_out.set()
        call.cancel()

    try:
        while True:
            with _watched(feed, timeout_s, give_up):
                answer = next(call, None)
            if answer is None:
                break
            yield _read(server, answer)
    except grpc.RpcError as error:
        if feed.failure is None:
            if has_timed_out.is_set():
                raise errors.timed_out(server, timeout_s) from error
            raise grpc_failure(server, timeout_s, error) from error
    finally:
        call.cancel()
    if feed.failure is not None:
        raise feed.failure


async def stream_answers_async(
    make_call: Any,  # the stubs do not know that the messages may be written later
    server: str,
    timeout_s: float,
    start: SequenceStart,
    instants: AsyncIterable[SentInstant],
) -> AsyncGenerator[JsonObject, None]:
    """As ``stream_answers``, in an event loop."""
    waiting = aiter(instants)
    head = _head(start, await anext(waiting, None))
    feed = _Feed()
    call: Any = make_call()
    feeding = asyncio.create_task(feed.write(call, head, waiting))
    try:
        while True:
            answer = await _read_patiently(call, feed, server, timeout_s)
            if not isinstance(answer, bytes):  # but EOF
                break
            yield _read(server, answer)
    except grpc.aio.AioRpcError as error:
        if feed.failure is None:
            raise grpc_failure(server, timeout_s, error) from error
    finally:
        call.cancel()
        feeding.cancel()
        await asyncio.gather(feeding, return_exceptions=True)
    if feed.failure is not None:
        raise feed.failure


class _Feed:
    """Hands instants to a call, and tells whose turn it is.

    Attributes:
        waits_since: when the server began to have the next turn, by ``time.monotonic``; None
            while the caller's iterable does.
        failure: what the caller's iterable raised.
    """

    def __init__(self) -> None:
        self.waits_since: float | None = time.monotonic()
        self.failure: Exception | None = None

    def messages(self, head: Iterable[bytes], instants: Iterable[SentInstant]) -> Iterator[bytes]:
        """Give the messages of a call, in the thread that gRPC takes them in."""
        yield from head
        self.waits_since = None
        try:
            for instant in instants:
                self.waits_since = time.monotonic()
                yield instant_message(instant).SerializeToString()
                self.waits_since = None
        except Exception as error:  # noqa: BLE001 - whatever it is, the caller gets it
            self.failure = error
        self.waits_since = time.monotonic()

    async def write(
        self, call: Any, head: Iterable[bytes], instants: AsyncIterable[SentInstant]
    ) -> None:
        """Write the messages of a call."""
        try:
            for message in head:
                await call.write(message)
            async for message in self._messages_async(instants):
                await call.write(message)
            await call.done_writing()
        except (grpc.aio.AioRpcError, asyncio.InvalidStateError):
            pass  # the call is over; reading from it tells why

    async def _messages_async(self, instants: AsyncIterable[SentInstant]) -> AsyncIterator[bytes]:
        self.waits_since = None
        try:
            async for instant in instants:
                self.waits_since = time.monotonic()
                yield instant_message(instant).SerializeToString()
                self.waits_since = None
        except Exception as error:  # noqa: BLE001 - as above
            self.failure = error
        self.waits_since = time.monotonic()

    def seconds_left(self, asked_at: float, timeout_s: float) -> float:
        """Return how long to wait at least for an answer that was asked for at a time."""
        if self.waits_since is None:
            return timeout_s
        return max(self.waits_since, asked_at) + timeout_s - time.monotonic()


def _head(start: SequenceStart, first: SentInstant | None) -> list[bytes]:
    """Return the messages that are known before a call is made."""
    messages = [start_message(start)]
    if first is not None:
        messages.append(instant_message(first))
    return [message.SerializeToString() for message in messages]


@contextmanager
def _watched(feed: _Feed, timeout_s: float, give_up: Callable[[], None]) -> Iterator[None]:
    """Call ``give_up`` when the block takes too long, by the server's fault."""
    asked_at = time.monotonic()
    is_done = threading.Event()

    def watch() -> None:
        while (left := feed.seconds_left(asked_at, timeout_s)) > 0:
            if is_done.wait(left):
                return
        give_up()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_done.set()
        thread.join()


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
