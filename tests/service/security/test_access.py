from __future__ import annotations

import asyncio
import re
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from google.rpc.error_details_pb2 import ErrorInfo
from google.rpc.status_pb2 import Status
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as AsgiScope

from service.grpc.access import AccessInterceptor
from service.grpc.arrivals import TimelyCalls
from service.grpc.envelope import Envelope
from service.http.access import add_access
from service.security.access import (
    ANY_KEY,
    NOTHING,
    Access,
    is_loopback,
    needed_over_grpc,
    needed_over_http,
    open_access,
)
from service.security.key_file import Key, Scope, edited_keys, new_key
from service.security.key_ring import KeyRing
from service.settings import ServiceSettings, SettingsError
from service.telemetry.metrics import Metrics
from service.telemetry.observer import Observer
from visloc.errors import Forbidden, Overloaded
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1 import localization_pb2_grpc as pb2_grpc

LOCALIZE, READ, MANAGE = (frozenset({scope}) for scope in Scope)


@dataclass
class Keys:
    """A file of keys, and the tokens of those in it."""

    path: Path
    tokens: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, *scopes: Scope, **limits: Any) -> str:
        key, token = new_key(name, frozenset(scopes), **limits)
        with edited_keys(self.path) as keys:
            keys.append(key)
        self.tokens[name] = token
        return token


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    made = Keys(tmp_path / "keys.json")
    for scope in Scope:
        made.add(scope.value, scope)
    return made


# Which scope is for what


@pytest.mark.parametrize(
    ("method", "path", "needed"),
    [
        ("GET", "/healthz", NOTHING),
        ("GET", "/readyz", NOTHING),
        ("GET", "/openapi.json", NOTHING),
        ("POST", "/localize", LOCALIZE),
        ("POST", "/localize/rig", LOCALIZE),
        ("POST", "/localize/sequence", LOCALIZE),
        ("GET", "/maps", READ),
        ("HEAD", "/maps", READ),
        ("GET", "/maps/room", READ),
        ("GET", "/maps/room/versions/1", READ),
        ("GET", "/metrics", READ),
        ("PUT", "/maps/room/versions/1", MANAGE),
        ("DELETE", "/maps/room/versions/1", MANAGE),
        ("POST", "/maps/room/current", MANAGE),
        ("PATCH", "/maps", MANAGE),
        ("GET", "/", ANY_KEY),
        ("GET", "/mapsy", ANY_KEY),
        ("GET", "//maps", ANY_KEY),
        ("GET", "/../healthz", ANY_KEY),
        ("GET", "/healthz/", ANY_KEY),
        ("OPTIONS", "*", ANY_KEY),
    ],
)
def test_every_path_needs_what_it_is_for(
    method: str, path: str, needed: frozenset[Scope] | None
) -> None:
    assert needed_over_http(method, path) == needed


@pytest.mark.parametrize(
    ("method", "path", "needed"),
    [
        ("GET", "/", NOTHING),
        ("HEAD", "/", NOTHING),
        ("GET", "/assets/index-1a2b.js", NOTHING),
        ("HEAD", "/assets/index-1a2b.js", NOTHING),
        ("POST", "/", ANY_KEY),
        ("POST", "/assets/index-1a2b.js", ANY_KEY),
        ("OPTIONS", "/", ANY_KEY),
        ("GET", "//", ANY_KEY),
        ("GET", "/assets", ANY_KEY),
        ("GET", "/assets/", ANY_KEY),
        ("GET", "/assets/../maps", ANY_KEY),
        ("GET", "/assets/a/b", ANY_KEY),
        ("GET", "/assets/a\n/maps", ANY_KEY),
        ("GET", "/maps/room/points", READ),
        ("GET", "/maps/room/images", READ),
        ("POST", "/localize", LOCALIZE),
        ("GET", "/nowhere", ANY_KEY),
    ],
)
def test_of_a_page_that_is_served_only_the_files_need_nothing(
    method: str, path: str, needed: frozenset[Scope] | None
) -> None:
    assert needed_over_http(method, path, page=True) == needed


def test_every_method_of_grpc_needs_a_scope_of_its_own() -> None:
    needed = {
        method.name: needed_over_grpc(f"/{service.full_name}/{method.name}")
        for service in pb2.DESCRIPTOR.services_by_name.values()
        for method in service.methods
    }

    assert needed == {
        **dict.fromkeys(("Localize", "LocalizeRig", "LocalizeSequence"), LOCALIZE),
        **dict.fromkeys(("ListMaps", "GetMap", "GetVersion"), READ),
        **dict.fromkeys(("PutVersion", "DeleteVersion", "SetCurrent"), MANAGE),
    }
    assert needed_over_grpc("/grpc.health.v1.Health/Check") is NOTHING
    assert needed_over_grpc("/grpc.reflection.v1alpha.ServerReflection/X") == ANY_KEY
    assert needed_over_grpc("/no.such/Method") == ANY_KEY


# Settings


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "127.1.2.3"])
def test_on_this_machine_alone_no_key_is_needed(host: str) -> None:
    assert open_access(ServiceSettings(host=host)).key_of([], LOCALIZE) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "10.0.0.1", "maps.example.org"])
def test_where_others_can_reach_it_a_server_without_keys_does_not_start(host: str) -> None:
    with pytest.raises(SettingsError, match=r"^keys_file: needed, because .*service\.keys"):
        open_access(ServiceSettings(host=host))


def test_keys_that_cannot_be_read_keep_the_server_from_starting(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"^keys_file: .*none\.json"):
        open_access(ServiceSettings(keys_file=tmp_path / "none.json"))


@pytest.mark.parametrize(
    ("origin", "says"),
    [
        ("null", "keys_file is needed"),
        ("*", "keys_file is needed"),
        ("maps.example.org", "is no origin"),
        ("localhost:5173", "is no origin"),
        ("https://a/b", "is no origin"),
        ("ftp://a", "is no origin"),
        ("ws://a:8000", "is no origin"),
        ("file:///index.html", "is no origin"),
        ("http://localhost:*", "is no origin"),
        ("https://*.example.org", "is no origin"),
        ("http://localhost:65536", "is no origin"),
        ("https://user@a.example", "is no origin"),
        ("https://b\u00fccher.example", "is no origin"),
        ("https://Maps.Example.org", "as https://maps.example.org;"),
        ("https://maps.example.org/", "as https://maps.example.org;"),
        ("https://maps.example.org:443", "as https://maps.example.org;"),
        ("HTTP://localhost:80/", "as http://localhost;"),
        ("capacitor://localhost/", "as capacitor://localhost;"),
    ],
)
def test_origin_that_no_browser_sends_or_that_needs_keys_is_refused(origin: str, says: str) -> None:
    with pytest.raises(SettingsError, match=rf"^cors_origins: .*{re.escape(says)}"):
        open_access(ServiceSettings(cors_origins=("https://a.example", origin)))


ORIGINS = [
    *("https://maps.example.org", "http://localhost:5173", "http://[::1]:8080"),
    *("capacitor://localhost", "ionic://localhost", "tauri://localhost", "http://tauri.localhost"),
    *("app://-", "chrome-extension://abcdefghijklmnop", "http://127.0.0.1:65535"),
]


@pytest.mark.parametrize("origin", ORIGINS)
def test_origins_of_pages_and_apps_may_be_named(origin: str) -> None:
    access = open_access(ServiceSettings(cors_origins=(origin,)))
    access.check_page("http", "localhost:8000", [origin])


@pytest.mark.parametrize("origin", ["null", "*"])
def test_every_page_may_call_only_with_keys(origin: str, keys: Keys) -> None:
    settings = ServiceSettings(cors_origins=(origin,), keys_file=keys.path)
    answer = http_door(open_access(settings)).ask("GET", "/maps", {"Origin": "null"})
    assert code_of(answer) == (401, "access.key_missing")
    assert answer.headers["access-control-allow-origin"] == origin


@pytest.mark.parametrize("name", ["localhost.", "127.0.0.1.evil.org", "evil", "0.0.0.0", "[", ""])
def test_names_that_only_look_like_this_machine_are_not(name: str) -> None:
    assert not is_loopback(name)


# Limits


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def limited(clock: Clock, **limits: Any) -> tuple[Access, Key]:
    key, _ = new_key("robot", frozenset(Scope), **limits)
    return Access(None, now=clock), key


def refused(access: Access, key: Key) -> str | None:
    try:
        with access.place(key):
            return None
    except Overloaded as error:
        return error.code


def test_a_burst_goes_through_at_once_and_then_the_rate_holds() -> None:
    clock = Clock()
    access, key = limited(clock, rate=2.0, burst=3)

    assert [refused(access, key) for _ in range(4)] == [None, None, None, "access.rate"]
    assert access.wait_s(key) == 1
    clock.now = 0.5
    assert [refused(access, key) for _ in range(2)] == [None, "access.rate"]
    clock.now = 1000.0
    assert [refused(access, key) for _ in range(4)] == [None, None, None, "access.rate"]


def test_the_wait_for_a_slow_rate_is_told() -> None:
    access, key = limited(Clock(), rate=0.1, burst=1)

    assert refused(access, key) is None
    assert access.wait_s(key) == 10


def test_requests_that_are_served_at_once_are_counted_until_they_end() -> None:
    access, key = limited(Clock(), concurrency=2)
    with access.place(key):
        with access.place(key):
            assert refused(access, key) == "access.concurrency"
        assert refused(access, key) is None
    assert refused(access, key) is None


def test_one_key_does_not_use_up_what_is_anothers() -> None:
    access, key = limited(Clock(), rate=1.0, burst=1)
    other, _ = new_key("other", frozenset(Scope), rate=1.0, burst=1)

    assert refused(access, key) is None
    assert refused(access, key) == "access.rate"
    assert refused(access, other) is None


# Pages


@pytest.mark.parametrize("host", ["localhost:8000", "127.0.0.1:8000", "[::1]:8000", "LOCALHOST"])
def test_a_page_of_this_server_itself_may_call_it(host: str) -> None:
    Access(None).check_page("http", host, [])
    Access(None).check_page("http", host, [f"http://{host}"])


@pytest.mark.parametrize(
    ("host", "origins", "code"),
    [
        ("evil.example:8000", [], "access.host"),  # a name that its owner makes point here
        ("", [], "access.host"),
        ("127.0.0.1.evil.example", [], "access.host"),
        ("localhost:8000", ["https://evil.example"], "access.origin"),
        ("localhost:8000", ["null"], "access.origin"),
        ("localhost:8000", ["https://localhost:8000"], "access.origin"),
        ("localhost:8000", ["http://localhost:9"], "access.origin"),
        ("localhost:8000", ["http://localhost:8000", "https://evil.example"], "access.origin"),
    ],
)
def test_a_page_of_somebody_else_may_not_use_a_server_without_keys(
    host: str, origins: Sequence[str], code: str
) -> None:
    with pytest.raises(Forbidden) as caught:
        Access(None).check_page("http", host, origins)
    assert caught.value.code == code


def test_a_page_that_was_named_may_call() -> None:
    access = Access(None, ["https://maps.example.org"])
    access.check_page("http", "localhost:8000", ["https://maps.example.org"])


# Over HTTP


class WithId:
    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        scope.setdefault("state", {})["request_id"] = "the-id"
        await self._app(scope, receive, send)


@dataclass
class HttpDoor:
    app: Starlette
    reached: list[str] = field(default_factory=list)
    read: int = 0  # parts of bodies

    def ask(self, method: str, path: str, headers: Any = None, **options: Any) -> httpx.Response:
        async def app(scope: AsgiScope, receive: Receive, send: Send) -> None:
            async def counted() -> Any:
                self.read += 1
                return await receive()

            await self.app(scope, counted, send)

        async def ask() -> httpx.Response:
            transport = httpx.ASGITransport(app=app)
            async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as http:
                return await http.request(method, path, headers=headers, **options)

        return asyncio.run(ask())


def http_door(access: Access) -> HttpDoor:
    async def serve(request: Request) -> Response:
        door.reached.append(request.url.path)
        return PlainTextResponse("ok")

    methods = ["GET", "POST", "PUT", "DELETE"]
    app = Starlette(routes=[Route("/{path:path}", serve, methods=methods)])
    add_access(app, access, Observer(Metrics()))
    app.add_middleware(WithId)
    door = HttpDoor(app)
    return door


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def code_of(response: httpx.Response) -> tuple[int, str]:
    assert response.headers["content-type"] == "application/problem+json"
    body = response.json()
    assert body["request_id"] == "the-id"
    return response.status_code, body["code"]


def test_a_key_opens_what_its_scope_is_for_and_nothing_else(keys: Keys) -> None:
    door = http_door(Access(KeyRing(keys.path)))
    asked = {
        Scope.LOCALIZE: ("POST", "/localize"),
        Scope.READ: ("GET", "/maps"),
        Scope.MANAGE: ("DELETE", "/maps/room/versions/1"),
    }
    for scope, (method, path) in asked.items():
        for name, token in keys.tokens.items():
            door.reached.clear()
            response = door.ask(method, path, bearer(token))
            if name == scope.value:
                assert response.status_code == 200
                assert door.reached == [path]
            else:
                assert code_of(response) == (403, "access.scope")
                assert scope.value in response.json()["expected"]
                assert door.reached == []


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        ({}, "access.key_missing"),
        ({"Authorization": "Basic dTpw"}, "access.key_missing"),
        ({"Authorization": "Bearer"}, "access.key_unknown"),
        ({"Authorization": "Bearer nonsense"}, "access.key_unknown"),
        ({"X-API-Key": ""}, "access.key_unknown"),
        ({"X-API-Key": f"visloc_{'0' * 12}_{'A' * 43}"}, "access.key_unknown"),
        ({"X-API-Key": "\u00ff"}, "access.key_unknown"),
    ],
)
def test_who_shows_no_key_of_ours_is_refused_before_the_body_is_read(
    keys: Keys, headers: dict[str, str], code: str
) -> None:
    door = http_door(Access(KeyRing(keys.path)))
    encoded = [(name, value.encode("latin-1")) for name, value in headers.items()]
    for path in ("/localize", "/nowhere"):
        response = door.ask("POST", path, encoded, content=b"x" * 1000)

        assert code_of(response) == (401, code)
        assert response.headers["www-authenticate"].startswith("Bearer")
        assert not any(token in response.text for token in keys.tokens.values())
    assert (door.reached, door.read) == ([], 0)


def test_a_key_may_come_in_either_header_but_not_two_keys(keys: Keys) -> None:
    door = http_door(Access(KeyRing(keys.path)))
    read, manage = keys.tokens["read"], keys.tokens["manage"]

    assert door.ask("GET", "/maps", {"X-API-Key": read}).status_code == 200
    assert door.ask("GET", "/maps", {"X-API-Key": read} | bearer(read)).status_code == 200
    assert door.ask("GET", "/maps", {"authorization": f"bearer {read}"}).status_code == 200
    both = door.ask("GET", "/maps", {"X-API-Key": read} | bearer(manage))
    assert code_of(both) == (401, "access.key_unknown")


def test_health_needs_no_key(keys: Keys) -> None:
    door = http_door(Access(KeyRing(keys.path)))

    assert door.ask("GET", "/readyz").status_code == 200
    assert door.ask("GET", "/healthz").status_code == 200


def test_a_removed_key_is_useless_at_once(keys: Keys) -> None:
    door = http_door(Access(KeyRing(keys.path)))
    headers = bearer(keys.tokens["read"])
    assert door.ask("GET", "/maps", headers).status_code == 200
    with edited_keys(keys.path) as all_keys:
        all_keys[:] = [key for key in all_keys if key.name != "read"]

    assert code_of(door.ask("GET", "/maps", headers)) == (401, "access.key_unknown")


def test_a_key_over_its_rate_is_told_when_to_come_again(keys: Keys) -> None:
    token = keys.add("slow", Scope.READ, rate=0.1, burst=1)
    door = http_door(Access(KeyRing(keys.path), now=Clock()))

    assert door.ask("GET", "/maps", bearer(token)).status_code == 200
    response = door.ask("GET", "/maps", bearer(token))
    assert code_of(response) == (429, "access.rate")
    assert response.headers["retry-after"] == "10"
    assert door.ask("GET", "/maps", bearer(keys.tokens["read"])).status_code == 200


def test_without_keys_other_hosts_and_origins_are_refused() -> None:
    door = http_door(Access(None))

    assert door.ask("POST", "/localize").status_code == 200
    page = door.ask("POST", "/localize", {"Origin": "https://evil.example"})
    assert code_of(page) == (403, "access.origin")
    rebound = door.ask("GET", "/maps", {"Host": "evil.example"})
    assert code_of(rebound) == (403, "access.host")


def test_no_page_may_call_unless_its_origin_is_named(keys: Keys) -> None:
    preflight = {
        "Origin": "https://maps.example.org",
        "Access-Control-Request-Method": "POST",
        "Access-Control-Request-Headers": "authorization,x-request-id,x-visloc-map",
    }
    closed = http_door(Access(KeyRing(keys.path))).ask("OPTIONS", "/localize", preflight)
    door = http_door(Access(KeyRing(keys.path), ["https://maps.example.org"]))
    opened = door.ask("OPTIONS", "/localize", preflight)
    refused = door.ask("OPTIONS", "/localize", preflight | {"Origin": "https://evil.example"})
    private = preflight | {"Access-Control-Request-Private-Network": "true"}
    in_private_network = door.ask("OPTIONS", "/localize", private)
    answer = door.ask("POST", "/localize", {"Origin": "https://maps.example.org"})

    assert closed.status_code == 401
    assert "access-control-allow-origin" not in closed.headers
    assert opened.status_code == 200
    assert opened.headers["access-control-allow-origin"] == "https://maps.example.org"
    assert refused.status_code == 400
    assert "access-control-allow-origin" not in refused.headers
    assert in_private_network.status_code == 200
    assert in_private_network.headers["access-control-allow-private-network"] == "true"
    # A preflight lets nobody in: the request itself needs its key, and the page may see why not.
    assert code_of(answer) == (401, "access.key_missing")
    assert answer.headers["access-control-allow-origin"] == "https://maps.example.org"


# Over gRPC


class Localization(pb2_grpc.LocalizationServicer):
    def __init__(self) -> None:
        self.reached: list[str] = []
        self.busy: threading.Event | None = None

    def wait(self) -> None:
        while not self.reached:
            time.sleep(0.01)

    async def Localize(self, request: Any, context: Any) -> Any:  # noqa: N802
        del context
        self.reached.append("Localize")
        if self.busy is not None:
            await asyncio.to_thread(self.busy.wait)
        return pb2.LocalizeResponse(request_id=request.request_id)

    async def LocalizeSequence(self, request_iterator: Any, context: Any) -> None:  # type: ignore[override]  # noqa: N802
        self.reached.append("LocalizeSequence")
        async for message in request_iterator:
            await context.write(pb2.InstantAnswer(request_id=message.start.request_id))

    async def ListMaps(self, request: Any, context: Any) -> Any:  # noqa: N802
        del request, context
        self.reached.append("ListMaps")
        return pb2.ListMapsResponse()


class Maps(pb2_grpc.MapsServicer):
    async def PutVersion(self, request_iterator: AsyncIterator[Any], context: Any) -> Any:  # noqa: N802
        del context
        count = 0
        async for _ in request_iterator:
            count += 1
        return pb2.MapInfo(id=str(count))


@dataclass
class GrpcDoor:
    servicer: Localization
    channel: grpc.Channel

    def stub(self) -> Any:
        return pb2_grpc.LocalizationStub(self.channel)


@contextmanager
def grpc_door(access: Access, grace_s: float = 20.0) -> Iterator[GrpcDoor]:
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    def run(coroutine: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(coroutine, loop).result(30)

    servicer = Localization()  # type: ignore[abstract]  # what is not called is not there

    async def start() -> tuple[grpc.aio.Server, int]:
        envelope = Envelope(Observer(Metrics()))
        server = grpc.aio.server(
            interceptors=(
                AccessInterceptor(access, envelope, 10),
                TimelyCalls(envelope, grace_s, 0),
            )
        )
        pb2_grpc.add_LocalizationServicer_to_server(servicer, server)
        pb2_grpc.add_MapsServicer_to_server(Maps(), server)  # type: ignore[abstract]
        healthy = health.aio.HealthServicer()  # type: ignore[attr-defined]
        await healthy.set("", health_pb2.HealthCheckResponse.SERVING)
        health_pb2_grpc.add_HealthServicer_to_server(healthy, server)
        port = server.add_insecure_port("127.0.0.1:0")
        await server.start()
        return server, port

    try:
        server, port = run(start())
        try:
            with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
                yield GrpcDoor(servicer, channel)
        finally:
            run(server.stop(1))
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def refusal(call: Callable[[], object]) -> tuple[grpc.StatusCode, str]:
    with pytest.raises(grpc.RpcError) as caught:
        call()
    error: Any = caught.value
    details = dict(error.trailing_metadata())["grpc-status-details-bin"]
    info = ErrorInfo()
    Status.FromString(details).details[0].Unpack(info)
    assert info.metadata["request_id"]
    return error.code(), info.reason


def test_over_grpc_a_key_opens_what_its_scope_is_for(keys: Keys) -> None:
    with grpc_door(Access(KeyRing(keys.path))) as door:
        stub = door.stub()
        localize, read = (
            (("authorization", f"Bearer {keys.tokens[name]}"),) for name in ("localize", "read")
        )
        asked = pb2.LocalizeRequest(request_id="x", image=b"photo")

        assert stub.Localize(asked, metadata=localize).request_id == "x"
        assert stub.ListMaps(pb2.ListMapsRequest(), metadata=read) == pb2.ListMapsResponse()
        starts = [
            pb2.LocalizeSequenceRequest(start=pb2.SequenceStart(request_id=id_)) for id_ in "ab"
        ]
        answers = stub.LocalizeSequence(iter(starts), metadata=localize)
        assert [answer.request_id for answer in answers] == ["a", "b"]
        manage = (("x-api-key", keys.tokens["manage"]),)
        chunks = [pb2.PutVersionRequest(chunk=b"x")] * 3
        put = pb2_grpc.MapsStub(door.channel).PutVersion(iter(chunks), metadata=manage)
        assert put.id == "3"

        door.servicer.reached.clear()
        denied = (grpc.StatusCode.PERMISSION_DENIED, "access.scope")
        assert refusal(lambda: stub.Localize(asked, metadata=read)) == denied
        assert refusal(lambda: stub.ListMaps(pb2.ListMapsRequest(), metadata=localize)) == denied
        assert refusal(lambda: list(stub.LocalizeSequence(iter(starts), metadata=read))) == denied
        assert refusal(
            lambda: pb2_grpc.MapsStub(door.channel).PutVersion(iter(chunks), metadata=read)
        ) == (denied)
        assert door.servicer.reached == []


@pytest.mark.parametrize(
    ("metadata", "code"),
    [
        ((), "access.key_missing"),
        ((("authorization", "Bearer nonsense"),), "access.key_unknown"),
        ((("x-api-key", "nonsense"),), "access.key_unknown"),
    ],
)
def test_over_grpc_who_shows_no_key_is_refused(
    keys: Keys, metadata: tuple[tuple[str, str], ...], code: str
) -> None:
    with grpc_door(Access(KeyRing(keys.path))) as door:
        unauthenticated = (grpc.StatusCode.UNAUTHENTICATED, code)
        asked = pb2.LocalizeRequest(image=b"x" * 1_000_000)
        assert refusal(lambda: door.stub().Localize(asked, metadata=metadata)) == unauthenticated
        nowhere = door.channel.unary_unary("/no.such/Method", None, None)
        assert refusal(lambda: nowhere(b"", metadata=metadata)) == unauthenticated
        assert door.servicer.reached == []

        check = health_pb2_grpc.HealthStub(door.channel).Check
        assert check(health_pb2.HealthCheckRequest()).status == 1


def test_over_grpc_a_method_that_is_not_there_is_told_to_holders_of_a_key(keys: Keys) -> None:
    metadata = (("x-api-key", keys.tokens["read"]),)
    with grpc_door(Access(KeyRing(keys.path))) as door:
        nowhere = door.channel.unary_unary("/no.such/Method", None, None)
        with pytest.raises(grpc.RpcError) as caught:
            nowhere(b"", metadata=metadata)
    assert caught.value.code() == grpc.StatusCode.UNIMPLEMENTED


def test_over_grpc_calls_of_a_key_are_counted_until_they_end(keys: Keys) -> None:
    token = keys.add("narrow", Scope.LOCALIZE, concurrency=1)
    metadata = (("x-api-key", token),)
    with grpc_door(Access(KeyRing(keys.path))) as door:
        stub, asked = door.stub(), pb2.LocalizeRequest()
        door.servicer.busy = threading.Event()
        first = stub.Localize.future(asked, metadata=metadata)
        door.servicer.wait()
        second = refusal(lambda: stub.Localize(asked, metadata=metadata))
        assert second == (grpc.StatusCode.RESOURCE_EXHAUSTED, "access.concurrency")
        door.servicer.busy.set()
        first.result(10)
        assert stub.Localize(asked, metadata=metadata) is not None

        # One that is given up counts no longer either.
        door.servicer.busy = threading.Event()
        door.servicer.reached.clear()
        given_up = stub.Localize.future(asked, metadata=metadata)
        door.servicer.wait()
        given_up.cancel()
        door.servicer.busy.set()
        for _ in range(100):
            try:
                assert stub.Localize(asked, metadata=metadata) is not None
                break
            except grpc.RpcError:
                continue
        else:
            pytest.fail("the place was not given back")


def test_over_grpc_without_keys_everybody_is_served() -> None:
    with grpc_door(Access(None)) as door:
        assert door.stub().Localize(pb2.LocalizeRequest(request_id="x")).request_id == "x"


def test_over_grpc_a_message_that_does_not_come_ends_the_call() -> None:
    silent = threading.Event()

    def messages() -> Iterator[Any]:
        yield pb2.LocalizeSequenceRequest(start=pb2.SequenceStart(request_id="a"))
        silent.wait(20)

    with grpc_door(Access(None), grace_s=0.3) as door:
        answers = door.stub().LocalizeSequence(messages())
        assert next(answers).request_id == "a"
        code = refusal(lambda: next(answers))
        silent.set()
        assert code == (grpc.StatusCode.DEADLINE_EXCEEDED, "request.too_slow")
        # A single message that never comes, as of a client of somebody's own making.
        single = door.channel.stream_unary(
            "/visloc.v1.Localization/Localize", pb2.LocalizeRequest.SerializeToString, None
        )
        waiting = threading.Event()

        def never() -> Iterator[Any]:
            waiting.wait(20)
            yield from ()

        code = refusal(lambda: single(never()))
        waiting.set()
        assert code == (grpc.StatusCode.DEADLINE_EXCEEDED, "request.too_slow")
        assert door.servicer.reached == ["LocalizeSequence"]
