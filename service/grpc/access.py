"""Access control of gRPC calls."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import ExitStack
from typing import Any

import grpc

from service.grpc.calls import Handler, behaviour_of, handler_like
from service.grpc.envelope import Context, Envelope
from service.security.access import (
    FORWARDED_HEADER,
    NOTHING,
    Access,
    address_of_grpc,
    is_method,
    needed_over_grpc,
    tokens_of,
)
from service.security.key_file import Key
from service.telemetry.logs import UNMATCHED
from visloc.errors import Overloaded, VislocError, refuse

# How long a call without a key, such as a health watch, may stay open. Watchers ask again.
_KEYLESS_S = 300.0


class AccessInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[type-arg]
    """Admits or refuses a call before any of its messages is read.

    Args:
        max_keyless: calls open at once that need no key, so that callers with a key find a slot.
    """

    def __init__(self, access: Access, envelope: Envelope, max_keyless: int) -> None:
        self._access = access
        self._envelope = envelope
        self._max_keyless = max_keyless
        self._keyless = 0

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler:
        """Decide one call."""
        method = handler_call_details.method
        metadata: list[tuple[str, str | bytes]] = list(
            handler_call_details.invocation_metadata or ()
        )

        def sent(name: str) -> list[str]:
            return [value for key, value in metadata if key == name and isinstance(value, str)]

        try:
            tokens = tokens_of(sent("authorization"), sent("x-api-key"))
            key = self._access.key_of(tokens, needed_over_grpc(method))
        except VislocError as error:
            return self._refusal(error, method)
        handler: Handler | None = await continuation(handler_call_details)
        if handler is not None and needed_over_grpc(method) is NOTHING:
            return self._few(handler, method)
        if key is None or handler is None:
            return handler  # type: ignore[return-value]  # None: gRPC answers that there is none
        return self._counted(handler, key, method)

    def _few(self, handler: Handler, method: str) -> Handler:
        behaviour = behaviour_of(handler)

        async def serve(messages: AsyncIterator[Any], context: Context) -> Any:
            if self._keyless >= self._max_keyless:
                busy = refuse(
                    "server.busy", "there are too many calls without an API key; try again shortly"
                )
                await self._refuse(method, busy, context)
            self._keyless += 1
            try:
                async with asyncio.timeout(_KEYLESS_S):
                    return await behaviour(messages, context)
            except TimeoutError:
                over = refuse("request.deadline", "watching ends after a while; call again")
                # Every watcher meets it all the time: alerts would take it for missed deadlines.
                await self._refuse(method, over, context, counted=False)
            finally:
                self._keyless -= 1

        return handler_like(handler, serve)

    def _counted(self, handler: Handler, key: Key, method: str) -> Handler:
        behaviour = behaviour_of(handler)

        async def serve(messages: AsyncIterator[Any], context: Context) -> Any:
            with ExitStack() as stack:
                try:
                    stack.enter_context(self._access.place(key))
                except Overloaded as error:
                    await self._refuse(method, error, context)
                return await behaviour(messages, context)

        return handler_like(handler, serve)

    def _refusal(self, error: VislocError, method: str) -> Handler:
        async def refuse(messages: AsyncIterator[Any], context: Context) -> None:
            del messages  # not read
            await self._refuse(method, error, context)

        made: Handler = grpc.stream_stream_rpc_method_handler(refuse)
        return made

    async def _refuse(
        self, method: str, error: VislocError, context: Context, *, counted: bool = True
    ) -> None:
        forwarded = [
            value
            for name, value in context.invocation_metadata() or ()
            if name == FORWARDED_HEADER and isinstance(value, str)
        ]
        caller = self._access.caller(address_of_grpc(context.peer()), forwarded)
        await self._envelope.refuse(_name(method), error, context, caller=caller, counted=counted)


def _name(method: str) -> str:
    """Return the name of one of our methods, one word for all others."""
    return method.rpartition("/")[2] if is_method(method) else UNMATCHED
