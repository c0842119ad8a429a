"""Methods of gRPC in one form, so that one piece of code can stand before all of them."""

from __future__ import annotations

import inspect
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import aclosing
from traceback import clear_frames
from typing import Any, TypeAlias

import grpc

from service.grpc.envelope import Context

Handler: TypeAlias = "grpc.RpcMethodHandler[Any, Any]"
# Reads its messages itself, writes its answers to the context or returns the only one.
Behaviour = Callable[[AsyncIterator[Any], Context], Awaitable[Any]]


def behaviour_of(handler: Handler) -> Behaviour:
    """Return what a method does, whichever of gRPC's four kinds it is."""
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
    """Drop what a call held when it ends, its message above all.

    gRPC's iterator over messages and the generator that it reads from hold each other, and so do
    the exception of a refusal and the variables of the call, by its traceback. Only the garbage
    collector would free them: it counts objects and not their bytes, and comes after gigabytes.
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
    """Return a method with the messages of another, unless ``parse`` is to read them.

    It is called as soon as the call begins, also where there is one message only: gRPC itself
    would call it when that has arrived, however long that takes.
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
