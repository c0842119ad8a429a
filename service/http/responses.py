"""HTTP answers: JSON, problems and streamed lines. Handles clients that disconnect."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Callable, Coroutine
from contextlib import aclosing
from http import HTTPStatus
from typing import Any, TypeVar

from pydantic import BaseModel
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from service.errors import RETRY_AFTER_S, internal_error, statuses_of
from visloc.errors import Unavailable, VislocError
from visloc_api.words.status import Problem
from visloc_api.words.wire import NDJSON

logger = logging.getLogger(__name__)

T = TypeVar("T")


def json_response(message: BaseModel, status: int = 200) -> Response:
    """Answer with a message."""
    return Response(message.model_dump_json(), status, media_type="application/json")


def problem_of(error: VislocError, id_: str, status: HTTPStatus | None = None) -> Problem:
    """Describe an error as problem details; its kind decides the status unless one is given."""
    status = status or statuses_of(error)[0]
    return Problem(
        title=status.phrase,
        status=status,
        detail=error.message,
        code=error.code,
        field=error.field,
        expected=error.expected,
        got=error.got,
        kind=type(error).__name__,
        request_id=id_,
    )


def problem_response(error: VislocError, id_: str, status: HTTPStatus | None = None) -> Response:
    """Answer with an error."""
    problem = problem_of(error, id_, status)
    headers = {}
    if isinstance(error, Unavailable):
        headers["Retry-After"] = str(RETRY_AFTER_S)
    if error.code == "request.too_slow":  # the rest of its body is not waited for
        headers["Connection"] = "close"
    return Response(
        problem.model_dump_json(),
        problem.status,
        headers,
        media_type="application/problem+json",
    )


async def while_connected(receive: Receive, work: Coroutine[Any, Any, T]) -> T:
    """Do the work; cancel it if the client hangs up."""

    async def hang_up() -> None:
        while (await receive())["type"] != "http.disconnect":
            pass

    working, leaving = asyncio.create_task(work), asyncio.create_task(hang_up())
    try:
        await asyncio.wait({working, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise ClientDisconnect
        return working.result()
    finally:
        working.cancel()
        leaving.cancel()
        await asyncio.wait({working, leaving})  # the work has released what it held


class Lines(Response):
    """One line of JSON per answer, sent as soon as the answer is there.

    The next answer is computed only after the client has taken the previous ones. After the first
    line, an error becomes the last line, ``{"problem": {...}}``. The work ends when the client
    hangs up.

    Args:
        first: the first answer, computed beforehand, so that an error until then is a problem.
        others: the answers after it; closed at the end.
        message: converts an answer to the words of the API.
        patience_s: the longest that the client may take for a line.
    """

    def __init__(
        self,
        first: T,
        others: AsyncGenerator[T],
        message: Callable[[T], BaseModel],
        id_: str,
        patience_s: float,
    ) -> None:
        super().__init__(media_type=NDJSON)
        del self.headers["content-length"]
        self.headers["X-Accel-Buffering"] = "no"  # otherwise nginx would buffer the lines
        self._answers = _with_first(first, others)
        self._message = message
        self._id = id_
        self._patience_s = patience_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        del scope
        await while_connected(receive, self._send_all(send))

    async def _send_all(self, send: Send) -> None:
        start = {"status": self.status_code, "headers": self.raw_headers}
        await send({"type": "http.response.start", **start})
        try:
            async with aclosing(self._answers) as answers:
                async for answer in answers:
                    await self._send_line(send, self._message(answer).model_dump_json())
        except VislocError as error:
            await self._send_problem(send, error)
        except Exception:  # the last line of defence, as for all requests
            logger.exception("request %s failed unexpectedly", self._id)
            await self._send_problem(send, internal_error())
        await send({"type": "http.response.body", "body": b"", "more_body": False})

    async def _send_problem(self, send: Send, error: VislocError) -> None:
        problem = problem_of(error, self._id)
        await self._send_line(send, f'{{"problem":{problem.model_dump_json()}}}')

    async def _send_line(self, send: Send, text: str) -> None:
        body = text.encode() + b"\n"
        try:
            async with asyncio.timeout(self._patience_s):
                await send({"type": "http.response.body", "body": body, "more_body": True})
        except TimeoutError:
            raise ClientDisconnect from None


async def _with_first(first: T, others: AsyncGenerator[T]) -> AsyncGenerator[T]:
    async with aclosing(others):
        yield first
        async for other in others:
            yield other
