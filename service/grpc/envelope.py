"""The envelope of all gRPC methods: answers as messages, errors as statuses, the log."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import grpc
from google.protobuf.any_pb2 import Any as AnyMessage
from google.rpc.error_details_pb2 import ErrorInfo
from google.rpc.status_pb2 import Status
from pydantic import BaseModel

import visloc
from service.api.deadlines import request_id
from service.errors import internal_error, statuses_of
from service.telemetry.logs import RequestRecord
from service.telemetry.observer import Observer
from service.telemetry.tracing import traceparent_of
from visloc.errors import VislocError
from visloc_api.messages import MessageT, filled
from visloc_api.words.wire import ERROR_DOMAIN, VERSION_KEY

logger = logging.getLogger(__name__)

# Characters per detail: details are sent in headers, and clients accept 8 kB of headers.
_MAX_DETAIL = 1000

Context = grpc.aio.ServicerContext[Any, Any]


def message_of(answer: BaseModel, message: MessageT) -> MessageT:
    """Fill a message from the model with the same fields, so that HTTP and gRPC answer the same."""
    return filled(message, answer.model_dump())


class Envelope:
    """Turns errors into statuses with details, and reports every call to the observer."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer

    @asynccontextmanager
    async def __call__(
        self, method: str, id_: str, context: Context, *, streams: bool = False
    ) -> AsyncIterator[None]:
        """Serve a call in the block.

        Headers are sent with a single answer, not before it: the client's gRPC may retry a call
        elsewhere as long as nothing was answered.

        Args:
            streams: whether the block writes answers to the context.
        """
        caller = dict(context.invocation_metadata() or ()).get("traceparent")
        traceparent = caller if isinstance(caller, str) else None
        with self._observer.request("grpc", id_, route=method, traceparent=traceparent) as record:
            record.status = grpc.StatusCode.CANCELLED.name
            headers = [(VERSION_KEY, visloc.__version__)]
            if record.trace is not None:
                headers.append(("traceresponse", traceparent_of(record.trace)))
            try:
                if streams:
                    await context.send_initial_metadata(headers)
                yield
                if not streams:
                    await context.send_initial_metadata(headers)
                record.status = grpc.StatusCode.OK.name
            except VislocError as error:
                await self._refuse(error, id_, context, record)
            except Exception:  # the last line of defence: gRPC would show the caller the exception
                logger.exception("request %s failed unexpectedly", id_)
                await self._refuse(internal_error(), id_, context, record)

    async def refuse(
        self,
        method: str,
        error: VislocError,
        context: Context,
        *,
        caller: str | None = None,
        counted: bool = True,
    ) -> None:
        """Answer a call with an error outside of its method.

        Args:
            caller: its address, for the log.
            counted: whether it is one of the errors that metrics count.
        """
        id_ = request_id(None)
        with self._observer.request("grpc", id_, route=method) as record:
            record.peer = caller
            await self._refuse(error, id_, context, record, counted=counted)

    async def _refuse(
        self,
        error: VislocError,
        id_: str,
        context: Context,
        record: RequestRecord,
        *,
        counted: bool = True,
    ) -> None:
        if counted:
            self._observer.error(error)
        record.status = statuses_of(error)[1].name
        await _abort(error, id_, context)


async def _abort(error: VislocError, id_: str, context: Context) -> None:
    code = statuses_of(error)[1]
    details = {
        "kind": type(error).__name__,
        "message": error.message,
        "field": error.field,
        "expected": error.expected,
        "got": error.got,
        "request_id": id_,
    }
    info = ErrorInfo(
        reason=error.code,
        domain=ERROR_DOMAIN,
        metadata={
            name: str(value)[:_MAX_DETAIL] for name, value in details.items() if value is not None
        },
    )
    packed = AnyMessage()
    packed.Pack(info)
    text = str(error)[:_MAX_DETAIL]
    status = Status(code=code.value[0], message=text, details=[packed])
    await context.abort(
        code, text, trailing_metadata=(("grpc-status-details-bin", status.SerializeToString()),)
    )
