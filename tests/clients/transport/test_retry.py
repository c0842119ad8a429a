"""Servers behind a balancer: the map is named, and what one left unanswered goes to the next."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import grpc
import pytest

from clients import AsyncClient, Client, Near
from clients.transport.retry import GRPC_OPTIONS, map_header
from clients.wire.requests import (
    GetMap,
    ListMaps,
    Localize,
    UseVersion,
    checked_search,
    photo_request,
)
from visloc.errors import Unavailable, VislocError
from visloc_api.v1 import localization_pb2 as pb2

BREAK = 0  # the connection, without an answer
MAPS = (200, {"maps": []})


def stopping(code: str) -> dict[str, str]:
    return {"kind": "Unavailable", "code": code, "detail": "no"}


class Replies:
    """Answers in turn, and what was asked."""

    def __init__(self, *replies: tuple[int, Mapping[str, object]]) -> None:
        self.left = list(replies)
        self.asked: list[str] = []
        self.headers: list[dict[str, str]] = []


@pytest.fixture
def over_http() -> Iterator[Callable[[Replies], str]]:
    servers: list[tuple[HTTPServer, threading.Thread]] = []

    def start(replies: Replies) -> str:
        class Handler(BaseHTTPRequestHandler):
            def answer(self) -> None:
                length = int(self.headers.get("Content-Length") or 0)
                self.rfile.read(length)
                replies.asked.append(f"{self.command} {self.path}")
                replies.headers.append({n.lower(): v for n, v in self.headers.items()})
                status, said = replies.left.pop(0)
                self.close_connection = True
                if status == BREAK:
                    return
                body = json.dumps(said).encode()
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            do_GET = do_POST = do_DELETE = answer  # noqa: N815  the server calls them so

            def log_message(self, *_: Any) -> None:
                pass

        server = HTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        servers.append((server, thread))
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server, thread in servers:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def over_grpc() -> Iterator[Callable[..., str]]:
    servers: list[grpc.Server] = []

    def start(calls: list[Mapping[str, Any]], *statuses: grpc.StatusCode) -> str:
        left = list(statuses)

        def answer(_: Any, context: Any) -> pb2.ListMapsResponse:
            calls.append(dict(context.invocation_metadata()))
            status = left.pop(0)
            if status is not grpc.StatusCode.OK:
                context.abort(status, "no")
            return pb2.ListMapsResponse()

        method = grpc.unary_unary_rpc_method_handler(
            answer, None, pb2.ListMapsResponse.SerializeToString
        )
        server = grpc.server(ThreadPoolExecutor(1))
        names = ("ListMaps", "GetMap", "Localize")
        server.add_generic_rpc_handlers(
            (
                grpc.method_handlers_generic_handler(
                    "visloc.v1.Localization", dict.fromkeys(names, method)
                ),
                grpc.method_handlers_generic_handler("visloc.v1.Maps", {"SetCurrent": method}),
            )
        )
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()
        servers.append(server)
        return f"grpc://127.0.0.1:{port}"

    yield start
    for server in servers:
        server.stop(None).wait()


@pytest.mark.parametrize(
    "first",
    [(BREAK, {}), (502, {}), (503, stopping("server.stopping"))],
    ids=["broken", "balancer", "stopping"],
)
def test_what_a_server_left_unanswered_is_asked_once_more(
    first: tuple[int, Mapping[str, object]], over_http: Callable[[Replies], str]
) -> None:
    replies = Replies(first, MAPS, first, MAPS)
    url = over_http(replies)

    async def ask() -> Any:
        async with AsyncClient(url) as client:
            return await client.maps()

    with Client(url) as client:
        assert client.maps() == []
    assert asyncio.run(ask()) == []
    assert replies.asked == ["GET /maps"] * 4


def test_it_is_not_asked_a_third_time(over_http: Callable[[Replies], str]) -> None:
    replies = Replies(*[(502, {})] * 3)
    with Client(over_http(replies)) as client, pytest.raises(Unavailable) as caught:
        client.maps()

    assert caught.value.code == "server.unavailable"
    assert len(replies.asked) == 2


@pytest.mark.parametrize(
    "reply",
    [
        (500, stopping("server.worker_died")),
        (503, stopping("server.starting")),
        (504, stopping("server.deadline")),
        (429, stopping("server.busy")),
    ],
)
def test_what_a_server_answered_stands(
    reply: tuple[int, Mapping[str, object]], over_http: Callable[[Replies], str]
) -> None:
    replies = Replies(reply, MAPS)
    with Client(over_http(replies)) as client, pytest.raises(VislocError) as caught:
        client.maps()

    assert caught.value.code == reply[1]["code"]
    assert len(replies.asked) == 1


def test_what_changes_something_is_sent_once(over_http: Callable[[Replies], str]) -> None:
    replies = Replies(*[(BREAK, {})] * 4)
    with Client(over_http(replies)) as client:
        for change in (client.use_version, client.delete_version):
            with pytest.raises(Unavailable):
                change("room", "v1")

    assert replies.asked == ["POST /maps/room/current", "DELETE /maps/room/versions/v1"]


def test_grpc_asks_once_more_of_itself(over_grpc: Callable[..., str]) -> None:
    away, well = grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.OK
    calls: list[Mapping[str, Any]] = []
    url = over_grpc(calls, away, well, away, well, away, away)

    async def ask() -> Any:
        async with AsyncClient(url) as client:
            return await client.maps()

    with Client(url) as client:
        assert client.maps() == []
        assert asyncio.run(ask()) == []
        with pytest.raises(Unavailable):
            client.maps()
    assert len(calls) == 6


def test_grpc_sends_once_what_a_server_answered_or_what_changes_something(
    over_grpc: Callable[..., str],
) -> None:
    calls: list[Mapping[str, Any]] = []
    url = over_grpc(calls, grpc.StatusCode.INTERNAL, grpc.StatusCode.UNAVAILABLE)
    with Client(url) as client:
        with pytest.raises(Unavailable):
            client.maps()
        with pytest.raises(Unavailable):
            client.use_version("room", "v1")

    assert len(calls) == 2
    assert calls[1]["x-visloc-map"] == "room"


def test_a_large_photo_is_kept_to_be_sent_again(over_grpc: Callable[..., str]) -> None:
    calls: list[Mapping[str, Any]] = []
    url = over_grpc(calls, grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.INTERNAL)
    with Client(url) as client, pytest.raises(Unavailable):
        client.localize(bytes(2**20), "room@v1")

    assert [call["x-visloc-map"] for call in calls] == ["room", "room"]


def test_the_methods_that_are_sent_again_exist() -> None:
    (of_methods,) = json.loads(dict(GRPC_OPTIONS)["grpc.service_config"])["methodConfig"]  # type: ignore[arg-type]
    services = pb2.DESCRIPTOR.services_by_name
    known = {
        (service.full_name, method)
        for service in services.values()
        for method in service.methods_by_name
    }

    assert {(each["service"], each["method"]) for each in of_methods["name"]} < known


def test_the_map_is_named_without_its_version(over_http: Callable[[Replies], str]) -> None:
    replies = Replies((404, {}), (404, {}))
    with Client(over_http(replies)) as client:
        for ask in (client.localize, lambda _, ref: client.map(ref)):
            with pytest.raises(VislocError):
                ask(b"photo", "room@v1")

    assert [headers["x-visloc-map"] for headers in replies.headers] == ["room", "room"]


def test_requests_of_no_one_map_go_to_any_server() -> None:
    def localize(where: Any) -> Localize:
        return photo_request(checked_search(where, None, None, None), b"", None)

    assert map_header(ListMaps()) == {}
    assert map_header(localize(Near(47.0, 8.0, 100.0))) == {}
    assert map_header(localize(["hall", "room"])) == {"x-visloc-map": "hall"}
    assert map_header(GetMap("room@v1")) == map_header(UseVersion("room", "v1"))
