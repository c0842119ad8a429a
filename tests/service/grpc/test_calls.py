from __future__ import annotations

import asyncio
import gc
import weakref
from collections.abc import Iterator
from contextlib import suppress

import grpc
import pytest

from service.grpc.calls import behaviour_of, handler_like
from service.grpc.envelope import Context
from visloc.errors import InvalidInput


class Message:
    """What a call was sent."""


@pytest.fixture
def no_garbage_collection() -> Iterator[None]:
    gc.disable()
    yield
    gc.enable()


async def refuse(message: Message, context: Context) -> None:
    def check(given: Message) -> None:
        raise InvalidInput("request.invalid", f"not {type(given)}")

    try:
        await asyncio.to_thread(check, message)
    except InvalidInput as error:
        await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))


async def answer(message: Message, _: Context) -> bytes:
    await asyncio.sleep(0)
    return type(message).__name__.encode()


@pytest.mark.usefixtures("no_garbage_collection")
@pytest.mark.parametrize("method", [answer, refuse])
def test_the_message_of_a_call_that_has_ended_is_forgotten_at_once(method: object) -> None:
    received: list[weakref.ref[Message]] = []

    def parse(_: bytes) -> Message:
        message = Message()
        received.append(weakref.ref(message))
        return message

    handler = grpc.unary_unary_rpc_method_handler(method, parse)
    # As often as there are interceptors.
    for _ in range(2):
        handler = handler_like(handler, behaviour_of(handler))

    async def call_often() -> None:
        server = grpc.aio.server()
        server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler("test.Test", {"Call": handler}),)
        )
        port = server.add_insecure_port("127.0.0.1:0")
        await server.start()
        async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
            call = channel.unary_unary("/test.Test/Call")
            for _ in range(5):
                with suppress(grpc.aio.AioRpcError):
                    await call(b"")
        await server.stop(None)

    asyncio.run(call_often())

    assert [message() for message in received] == [None] * 5
