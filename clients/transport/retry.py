"""Retries and routing for several servers behind a balancer."""

from __future__ import annotations

import json

import httpx

from clients.transport.uploads import Upload
from clients.wire.requests import (
    DeleteVersion,
    GetImages,
    GetMap,
    GetVersion,
    Localize,
    Request,
    StartSequence,
    UseVersion,
)
from visloc_api.words.wire import MAP_HEADER

# Before a request is sent a second time. Never a third: it may have ended both servers.
RESEND_PAUSE_S = 0.1
# gRPC retries by itself. Its servers answer INTERNAL when a request must not be sent again.
GRPC_OPTIONS = (
    (
        "grpc.service_config",
        json.dumps(
            {
                "methodConfig": [
                    {
                        "name": [
                            {"service": "visloc.v1.Localization", "method": method}
                            for method in ("Localize", "LocalizeRig", "ListMaps", "GetMap")
                        ]
                        + [{"service": "visloc.v1.Maps", "method": "GetVersion"}],
                        "retryPolicy": {
                            "maxAttempts": 2,
                            "initialBackoff": f"{RESEND_PAUSE_S}s",
                            "maxBackoff": f"{RESEND_PAUSE_S}s",
                            "backoffMultiplier": 1,
                            "retryableStatusCodes": ["UNAVAILABLE"],
                        },
                    }
                ]
            }
        ),
    ),
    # gRPC cannot resend a request that is larger than this buffer. The default is 256 KiB.
    ("grpc.per_rpc_retry_buffer_size", 128 * 2**20),
    # Of an answer, such as the list of ten thousand maps. The default is 4 MiB.
    ("grpc.max_receive_message_length", 128 * 2**20),
)


def map_header(request: Request | StartSequence | Upload) -> dict[str, str]:
    """Return the header that names the map of a request, or its first map, without version."""
    match request:
        case Localize(words=words) | StartSequence(words=words):
            if words.near is not None:
                return {}
            name = words.map or (words.maps or [""])[0]
        case GetMap() | GetImages():
            name = request.map
        case GetVersion() | UseVersion() | DeleteVersion() | Upload():
            name = request.map_id
        case _:
            return {}
    return {MAP_HEADER: name.partition("@")[0]}


def may_resend(request: Request, got: httpx.Response | httpx.HTTPError) -> bool:
    """Return whether a request is sent again over HTTP.

    Only a request that changes nothing on the server, and only when another server may answer:
    the connection broke, a balancer answered, or the server is being stopped.
    """
    if isinstance(request, UseVersion | DeleteVersion):
        return False
    if isinstance(got, httpx.Response):
        if got.status_code == httpx.codes.SERVICE_UNAVAILABLE:
            return b'"server.stopping"' in got.content
        return got.status_code == httpx.codes.BAD_GATEWAY
    return isinstance(got, httpx.NetworkError | httpx.RemoteProtocolError)
