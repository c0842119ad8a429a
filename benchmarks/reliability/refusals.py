"""What must be refused: callers without the right, what is too large, what was there, paths."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import grpc
import httpx

from benchmarks.reliability.asking import camera_text
from benchmarks.reliability.checks import Check
from benchmarks.reliability.maps import Photo, SampleMaps, leftovers, tree_hash
from benchmarks.reliability.service_process import ServiceProcess
from visloc_api.v1.localization_pb2 import (
    GetMapRequest,
    ListMapsRequest,
    LocalizeRequest,
    PutVersionRequest,
    VersionRef,
)
from visloc_api.v1.localization_pb2_grpc import LocalizationStub, MapsStub

SCOPES = ("localize", "read", "manage")
# Beside the maps; no answer may have it.
CANARY = "canary-4c1f0be2"
# As ids of maps, in paths as they are sent: what a careless server would follow.
TRICKS = (
    *("..", ".", "%2e%2e", "%2e%2e%2f", "..%2f", "%2e%2e%2fsecrets", "..%5csecrets", "..\\secrets"),
    *("%252e%252e%252fsecrets", "%00", "room%00", "room%0a", "%2fetc%2fpasswd", "~", "~root"),
    *(
        "room%2f..%2f..%2fsecrets",
        "room@..",
        "room@..%2f..%2fsecrets",
        "C:%5c",
        "file:%2f%2f%2fetc",
    ),
    *(
        ".lock",
        ".incoming",
        ".work",
        "current",
        "room%2fcurrent",
        "a" * 5000,
        "%ff%fe",
        "%c0%ae%c0%ae",
    ),
    *("r%cc%88oom", "CON", "%2e", "-rf", "*", "$(id)", "room;id", "%7b7*7%7d", "..;/room"),
)
_UNREADABLE_S = 20


@dataclass(frozen=True)
class _Refusal:
    """A request and the statuses that may be its answer."""

    name: str
    send: Callable[[], tuple[str, bytes]]
    allowed: Sequence[str]


def refusals(every: SampleMaps, work: Path) -> list[Check]:
    """Send what must be refused; the store, the keys and what lies beside them stay as they are."""
    outside = work / "outside"
    outside.mkdir()
    maps = every.copied_to(outside / "maps")
    (outside / "secrets").write_text(CANARY)
    (maps.folder / "secrets").write_text(CANARY)
    keys = {scope: _new_key(outside / "keys.json", scope) for scope in SCOPES}
    log = work / "service.log"
    service = ServiceProcess(
        maps.folder, log, keys_file=outside / "keys.json", max_upload_bytes=50 * 2**20
    )
    with (
        service,
        httpx.Client(base_url=service.url, timeout=60) as http,
        grpc.insecure_channel(service.grpc) as channel,
    ):
        asking = _Asking(service, http, channel, maps, keys)
        checks = [
            _checked(name, list(requests), outside, maps)
            for name, requests in (
                ("wrong key, or none", asking.without_key()),
                ("a key without the scope", asking.without_scope()),
                ("oversized, before a byte of the body", asking.oversized()),
                ("replayed upload, removed key", asking.replayed(outside / "keys.json")),
                ("path tricks over HTTP", asking.tricks_over_http()),
                ("path tricks over gRPC", asking.tricks_over_grpc()),
                ("packed maps with path tricks", asking.packed_tricks()),
            )
        ]
        good = asking.localize(keys["localize"], maps.photos["room"][0])
    said = [scope for scope, key in keys.items() if key in log.read_text()]
    return [
        *checks,
        Check(
            "who has the right is answered afterwards; no key is in the log",
            f"{good}, {len(said)} keys in the log",
            good == "200" and not said,
        ),
    ]


def _checked(name: str, requests: Sequence[_Refusal], outside: Path, maps: SampleMaps) -> Check:
    """Send one after another; after each, everything must be as before."""
    wrong, statuses = [], Counter[str]()
    for request in requests:
        before = tree_hash(outside)
        status, answer = request.send()
        statuses[status] += 1
        if status not in request.allowed:
            wrong.append(f"{request.name}: {status}")
        if CANARY.encode() in answer:
            wrong.append(f"{request.name}: told what it must not")
        if tree_hash(outside) != before or leftovers(maps.folder):
            wrong.append(f"{request.name}: changed what is on disk")
    seen = ", ".join(f"{count} x {status}" for status, count in sorted(statuses.items()))
    return Check(
        f"{name}: refused, nothing read or written",
        f"{len(requests)} requests: {seen}" + "".join(f"; {one[:200]}" for one in wrong[:5]),
        bool(requests) and not wrong,
    )


class _Asking:
    """All that is asked."""

    def __init__(
        self,
        service: ServiceProcess,
        http: httpx.Client,
        channel: grpc.Channel,
        maps: SampleMaps,
        keys: dict[str, str],
    ) -> None:
        self._service, self._http, self._maps, self._keys = service, http, maps, keys
        self._localization, self._managing = LocalizationStub(channel), MapsStub(channel)
        self._version = maps.versions["room"][-1]
        self._packed = maps.packed.read_bytes()

    def localize(self, key: str, photo: Photo) -> str:
        """Localize as one should; the status."""
        return str(
            self._http.post(
                "/localize",
                data={"map": "room", "camera": camera_text(photo.camera)},
                files={"image": photo.image},
                headers={"X-API-Key": key},
            ).status_code
        )

    def without_key(self) -> Iterator[_Refusal]:
        """Every route with no key and with keys that are none."""
        good = self._keys["localize"]
        wrong: dict[str, dict[str, str]] = {
            "no key": {},
            "empty": {"X-API-Key": ""},
            "not a key": {"X-API-Key": "secret"},
            "another secret": {"Authorization": f"Bearer {good[:-4]}0000"},
            "the beginning of one": {"X-API-Key": good[:-1]},
            "longer": {"X-API-Key": good + "a"},
            "two": {"X-API-Key": good, "Authorization": f"Bearer {self._keys['read']}"},
            "very long": {"X-API-Key": "a" * 10_000},
        }
        for kind, headers in wrong.items():
            for method, path in self._routes():
                yield self._over_http(f"{kind}, {method} {path}", method, path, headers, "401")
            for name, call in self._calls():
                metadata = tuple((n.lower(), v) for n, v in headers.items())
                # gRPC's library has its own limit for what comes before a message.
                allowed = ("UNAUTHENTICATED", "RESOURCE_EXHAUSTED")
                yield _over_grpc(f"{kind}, {name}", call, metadata, *allowed)

    def without_scope(self) -> Iterator[_Refusal]:
        """Every route with every key that is not for it."""
        needed = {"POST /localize": "localize", "GET /geopose": "localize"}
        for scope, key in self._keys.items():
            for method, path in self._routes():
                of_route = needed.get(
                    f"{method} {path.rpartition('/rig')[0] or path}",
                    "read" if method == "GET" else "manage",
                )
                if path.startswith(("/localize", "/geopose")):
                    of_route = "localize"
                if of_route != scope and path != "/nowhere":
                    headers = {"X-API-Key": key}
                    name = f"{scope}, {method} {path}"
                    yield self._over_http(name, method, path, headers, "403")
            for name, call in self._calls():
                of_call = (
                    "localize"
                    if name.startswith("Localize")
                    else "manage"
                    if name.startswith(("Put", "Delete", "Set"))
                    else "read"
                )
                if of_call != scope:
                    metadata: _Metadata = (("x-api-key", key),)
                    yield _over_grpc(f"{scope}, {name}", call, metadata, "PERMISSION_DENIED")

    def oversized(self) -> Iterator[_Refusal]:
        """Heads that promise too much, whose bodies never come; and a body without a promise."""
        path = "/maps/room/versions/new"
        for size in (50 * 2**20 + 1, 10**12, 10**18):
            name = f"PUT of {size} bytes"
            yield self._head_only(name, "PUT", path, "manage", f"Content-Length: {size}", "413")
        for url in ("/localize", "/localize/rig", "/localize/sequence", "/geopose"):
            length = f"Content-Length: {10**11}"
            yield self._head_only(f"POST {url} of 100 GB", "POST", url, "localize", length, "413")
        for length in ("Content-Length: -1", "Content-Length: 1e9", f"Content-Length: {10**30}"):
            yield self._head_only(length, "PUT", path, "manage", length, "400", "413")
        large = b"\0" * (51 * 2**20)
        chunks = (large[start : start + 2**20] for start in range(0, len(large), 2**20))
        headers = {"X-API-Key": self._keys["manage"], "Content-Type": "application/zip"}

        def endless() -> tuple[str, bytes]:
            response = self._http.put(path, content=chunks, headers=headers)
            return str(response.status_code), response.content

        yield _Refusal("chunked PUT of too much", endless, ["413"])

    def replayed(self, keys_file: Path) -> Iterator[_Refusal]:
        """An upload that succeeded once, again, whole or its head only; a key after its end."""
        path, headers = f"/maps/room/versions/{self._version}", {"X-API-Key": self._keys["manage"]}
        headers |= {"Content-Type": "application/zip"}

        def again() -> tuple[str, bytes]:
            response = self._http.put(path, content=self._packed, headers=headers)
            return str(response.status_code), response.content

        yield _Refusal("the same upload", again, ["409"])
        length = f"Content-Length: {len(self._packed)}"
        yield self._head_only("its head", "PUT", path, "manage", length, "409")
        yield _over_grpc(
            "the same upload over gRPC",
            self._upload_call("room", self._version, self._packed),
            (("x-api-key", self._keys["manage"]),),
            "FAILED_PRECONDITION",
        )
        key = _new_key(keys_file, "manage", "leaving")
        self._until(key, 403)
        _keys(keys_file, "remove", "leaving")
        self._until(key, 401)
        for method, route in self._routes():
            name = f"removed key, {method} {route}"
            yield self._over_http(name, method, route, {"X-API-Key": key}, "401")

    def tricks_over_http(self) -> Iterator[_Refusal]:
        """Ids that are paths, wherever there are ids; sent as they are, without a client's help."""
        version = "20200101T000000.000Z-00000000"
        for trick in TRICKS:
            for method, path, scope in (
                ("GET", f"/maps/{trick}", "read"),
                ("GET", f"/maps/{trick}/versions/{version}", "read"),
                ("GET", f"/maps/room/versions/{trick}", "read"),
                ("DELETE", f"/maps/{trick}/versions/{version}", "manage"),
                ("DELETE", f"/maps/room/versions/{trick}", "manage"),
                ("PUT", f"/maps/{trick}/versions/{version}", "manage"),
                ("PUT", f"/maps/room/versions/{trick}", "manage"),
                ("POST", f"/maps/{trick}/current", "manage"),
            ):
                yield self._raw(f"{method} {path[:100]}", method, path, scope)
            plain = httpx.URL(f"http://x/{trick}").path[1:] if "/" not in trick else trick
            yield self._trick_in_body("/localize", {"map": plain, "image": "aaaa"}, "localize")
            yield self._trick_in_body("/localize", {"maps": [plain], "image": "aaaa"}, "localize")
            yield self._trick_in_body("/maps/room/current", {"version": plain}, "manage")

    def tricks_over_grpc(self) -> Iterator[_Refusal]:
        """The same as fields of messages."""
        refused = ("INVALID_ARGUMENT", "NOT_FOUND")
        photo = self._maps.photos["room"][0].image
        for trick in TRICKS:
            plain = httpx.URL(f"http://x/{trick}").path[1:] if "/" not in trick else trick
            ref, here = VersionRef(map=plain, version=self._version), VersionRef(map="room")
            here.version = plain
            calls: dict[str, tuple[Callable[..., object], object, str]] = {
                "GetMap": (self._localization.GetMap, GetMapRequest(map=plain), "read"),
                "Localize": (
                    self._localization.Localize,
                    LocalizeRequest(map=plain, image=photo),
                    "localize",
                ),
                "GetVersion": (self._managing.GetVersion, here, "read"),
                "DeleteVersion": (self._managing.DeleteVersion, ref, "manage"),
                "DeleteVersion of room": (self._managing.DeleteVersion, here, "manage"),
                "SetCurrent": (self._managing.SetCurrent, ref, "manage"),
                "SetCurrent of room": (self._managing.SetCurrent, here, "manage"),
            }
            for name, (method, message, scope) in calls.items():
                yield _over_grpc(
                    f"{name} {plain[:50]!r}",
                    _bound(method, message),
                    (("x-api-key", self._keys[scope]),),
                    *refused,
                )
            yield _over_grpc(
                f"PutVersion {plain[:50]!r}",
                self._upload_call(plain, self._version, self._packed),
                (("x-api-key", self._keys["manage"]),),
                *refused,
            )

    def packed_tricks(self) -> Iterator[_Refusal]:
        """Archives that would write elsewhere."""
        headers = {"X-API-Key": self._keys["manage"], "Content-Type": "application/zip"}
        names = ("../evil", "/evil", "a/../../evil", "..\\evil", "C:\\evil", "evil\0", "./evil")

        def put(body: bytes) -> Callable[[], tuple[str, bytes]]:
            def send() -> tuple[str, bytes]:
                response = self._http.put("/maps/room/versions/new", content=body, headers=headers)
                return str(response.status_code), response.content

            return send

        for name in names:
            yield _Refusal(f"entry {name!r}", put(_with_entry(self._packed, name)), ["422"])
        link = zipfile.ZipInfo("link")
        link.external_attr = 0o120777 << 16
        yield _Refusal("a link", put(_with_entry(self._packed, link, b"/etc/passwd")), ["422"])
        yield _Refusal("no archive", put(b"PK not really"), ["422"])
        # Whole, and of another version than the one in the path.
        yield _Refusal("another version's", put(self._packed), ["422"])

    def _routes(self) -> Iterable[tuple[str, str]]:
        version = f"/maps/room/versions/{self._version}"
        posts = ("/localize", "/localize/rig", "/localize/sequence", "/geopose")
        return (
            *(("POST", path) for path in posts),
            ("GET", "/geopose"),
            *(("GET", path) for path in ("/maps", "/maps/room", version, "/metrics")),
            ("PUT", version),
            ("PUT", "/maps/room/versions/new"),
            ("DELETE", version),
            ("DELETE", f"/maps/room/versions/{self._maps.versions['room'][0]}"),
            ("POST", "/maps/room/current"),
            ("GET", "/nowhere"),
        )

    def _calls(self) -> Iterable[tuple[str, _Call]]:
        image = self._maps.photos["room"][0].image
        old = VersionRef(map="room", version=self._maps.versions["room"][0])
        localize, manage = self._localization, self._managing
        return (
            ("Localize", _bound(localize.Localize, LocalizeRequest(map="room", image=image))),
            ("ListMaps", _bound(localize.ListMaps, ListMapsRequest())),
            ("GetMap", _bound(localize.GetMap, GetMapRequest(map="room"))),
            ("GetVersion", _bound(manage.GetVersion, old)),
            ("SetCurrent", _bound(manage.SetCurrent, old)),
            ("DeleteVersion", _bound(manage.DeleteVersion, old)),
            ("PutVersion", self._upload_call("room", "new", self._packed)),
        )

    def _upload_call(self, map_id: str, version: str, packed: bytes) -> _Call:
        def call(metadata: _Metadata) -> object:
            start = PutVersionRequest(start=VersionRef(map=map_id, version=version))
            parts = [start, *(PutVersionRequest(chunk=c) for c in _pieces(packed))]
            return self._managing.PutVersion(iter(parts), metadata=metadata, timeout=60)

        return call

    def _over_http(
        self, name: str, method: str, path: str, headers: dict[str, str], *allowed: str
    ) -> _Refusal:
        def send() -> tuple[str, bytes]:
            content = b"" if method == "GET" else self._packed
            response = self._http.request(method, path, content=content, headers=headers)
            return str(response.status_code), response.content

        return _Refusal(name, send, allowed)

    def _raw(self, name: str, method: str, path: str, scope: str) -> _Refusal:
        """A request whose path no library has tidied up."""
        body = {"PUT": self._packed, "POST": json.dumps({"version": self._version}).encode()}
        kind = {"PUT": "application/zip"}.get(method, "application/json")
        content = body.get(method, b"")
        lines = (f"Content-Type: {kind}", f"Content-Length: {len(content)}")

        def send() -> tuple[str, bytes]:
            return self._exchange(method, path, scope, lines, content)

        # 405 for what is no path of ours after all, 400 for what is no HTTP.
        return _Refusal(name, send, ["400", "404", "405", "422"])

    def _head_only(
        self, name: str, method: str, path: str, scope: str, length: str, *allowed: str
    ) -> _Refusal:
        kind = "application/zip" if method == "PUT" else "application/json"

        def send() -> tuple[str, bytes]:
            return self._exchange(method, path, scope, (f"Content-Type: {kind}", length), b"")

        return _Refusal(name, send, allowed)

    def _exchange(
        self, method: str, path: str, scope: str, lines: Sequence[str], content: bytes
    ) -> tuple[str, bytes]:
        address = ("127.0.0.1", self._service.http_port)
        with socket.create_connection(address, timeout=_UNREADABLE_S) as connection:
            head = (
                f"{method} {path} HTTP/1.1",
                f"Host: 127.0.0.1:{self._service.http_port}",
                f"X-API-Key: {self._keys[scope]}",
                *lines,
            )
            text = "\r\n".join([*head, "", ""]).encode("latin-1")
            with suppress(ConnectionError):  # refused already
                connection.sendall(text + content)
            answer = b""
            try:
                while b"\r\n\r\n" not in answer and (more := connection.recv(65536)):
                    answer += more
            except TimeoutError:
                return "no answer before the body", b""
        return answer.split(b" ", 2)[1].decode() if answer else "closed", answer

    def _trick_in_body(self, path: str, body: dict[str, object], scope: str) -> _Refusal:
        def send() -> tuple[str, bytes]:
            headers = {"X-API-Key": self._keys[scope]}
            response = self._http.post(path, json=body, headers=headers)
            return str(response.status_code), response.content

        return _Refusal(f"{path} {str(body)[:80]}", send, ["404", "422"])

    def _until(self, key: str, status: int) -> None:
        """Wait until the service has seen that the keys changed."""
        end = time.monotonic() + 10
        while time.monotonic() < end:
            if self._http.get("/maps", headers={"X-API-Key": key}).status_code == status:
                return
            time.sleep(0.05)


_Metadata = tuple[tuple[str, str | bytes], ...]
_Call = Callable[[_Metadata], object]


def _bound(method: Callable[..., object], message: object) -> _Call:
    def call(metadata: _Metadata) -> object:
        return method(message, metadata=metadata, timeout=60)

    return call


def _over_grpc(name: str, call: _Call, metadata: _Metadata, *allowed: str) -> _Refusal:
    def send() -> tuple[str, bytes]:
        try:
            answer = call(metadata)
        except grpc.RpcError as error:
            return error.code().name, str(error).encode()
        return "OK", str(answer).encode()

    return _Refusal(name, send, allowed)


def _pieces(data: bytes) -> Iterator[bytes]:
    for start in range(0, len(data), 2**18):
        yield data[start : start + 2**18]


def _with_entry(packed: bytes, name: str | zipfile.ZipInfo, data: bytes = b"evil") -> bytes:
    file = BytesIO(packed)
    with zipfile.ZipFile(file, "a") as archive:
        if isinstance(name, str):
            info = zipfile.ZipInfo("placeholder")
            info.filename = name  # as it is; the class would tidy it up
            name = info
        archive.writestr(name, data)
    return file.getvalue()


def _new_key(file: Path, scope: str, name: str | None = None) -> str:
    return _keys(file, "add", name or scope, "--scope", scope).strip()


def _keys(file: Path, *words: str) -> str:
    command = [sys.executable, "-m", "service.keys", "--file", str(file), *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
