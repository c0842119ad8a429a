"""All four kinds of gRPC methods in one form, so that an interceptor can wrap any of them."""

from __future__ import annotations

import inspect
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import aclosing
from traceback import clear_frames
from typing import Any, TypeAlias

import grpc

from service.grpc.envelope import Context

Handler: TypeAlias = "grpc.RpcMethodHandler[Any, Any]"
# Reads the messages; writes several answers to the context, or returns the only one.
Behaviour = Callable[[AsyncIterator[Any], Context], Awaitable[Any]]


def behaviour_of(handler: Handler) -> Behaviour:
    """Return the code of a method in one form, whichever of the four kinds it is."""
    serve: Any = (
        handler.stream_stream or handler.stream_unary
        if handler.request_streaming
        else handler.unary_stream or handler.unary_unary
    )

    async def behaviour(messages: AsyncIterator[Any], context: Context) -> Any:
        asked: Any = messages
        if not handler.request_streaming:
            asked = await anext(messages, None)
            if asked is None:
                await context.abort(grpc.StatusCode.INVALID_ARGUMENT, "a call without a message")
        answer = serve(asked, context)
        if not inspect.isasyncgen(answer):
            return await answer
        async with aclosing(answer) as answers:
            async for each in answers:
                await context.write(each)
        return None

    return behaviour


def _forgetful(behaviour: Behaviour) -> Behaviour:
    """Release the memory of a call when it ends, above all its message.

    gRPC's iterator over messages and the generator behind it refer to each other. So do the
    exception of a refusal and, through its traceback, the variables of the call. Only the garbage
    collector would free them. It counts objects, not bytes, and comes after gigabytes.
    """

    async def serve(messages: AsyncIterator[Any], context: Context) -> Any:
        received: Any = aiter(messages)
        try:
            async with aclosing(received):
                return await behaviour(messages, context)
        except grpc.aio.AbortError as aborted:
            error: BaseException | None = aborted
            while error is not None:
                clear_frames(error.__traceback__)
                error = error.__context__
            del messages, received, context  # of this call too, which has not ended
            raise

    return serve


def handler_like(
    handler: Handler, behaviour: Behaviour, parse: Callable[[bytes], Any] | None = None
) -> Handler:
    """Return a handler that runs ``behaviour``, with the message types of another handler.

    It runs as soon as the call begins. gRPC would run a method with a single message only when that
    message has arrived, however long that takes.

    Args:
        parse: reads messages in place of the handler's own parser.
    """
    make: Any = (
        grpc.stream_stream_rpc_method_handler
        if handler.response_streaming
        else grpc.stream_unary_rpc_method_handler
    )
    made: Handler = make(
        _forgetful(behaviour),
        parse or handler.request_deserializer,
        handler.response_serializer,
    )
    return made
