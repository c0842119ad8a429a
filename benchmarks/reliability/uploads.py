"""Uploads that break: no room on the disk, and clients that leave in the middle."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import grpc
import httpx

from benchmarks.reliability.checks import Check
from benchmarks.reliability.maps import (
    SampleMaps,
    leftovers,
    tree_hash,
    verify_store,
)
from benchmarks.reliability.service_process import ServiceProcess
from visloc.archive import MapStore
from visloc_api.v1.localization_pb2 import PutVersionRequest, VersionRef
from visloc_api.v1.localization_pb2_grpc import MapsStub

_CHUNK_BYTES = 64 * 1024
ZIP = {"Content-Type": "application/zip"}


def truncated_upload(maps: SampleMaps, work: Path) -> list[Check]:
    """Send a packed map in many broken ways; nothing of it may stay."""
    packed = maps.packed.read_bytes()
    version = maps.versions["room"][-1]
    service = ServiceProcess(maps.folder, work / "service.log", arrival_timeout_s=3)
    with service, httpx.Client(base_url=service.url, timeout=60) as http:
        _make_way(http, maps)
        path = f"/maps/room/versions/{version}"
        half = len(packed) // 2

        def declared_too_short() -> str:
            return _status(http.put(path, content=packed[:half], headers=ZIP))

        ways: list[tuple[str, Callable[[], str], Sequence[str]]] = [
            ("connection ends", lambda: _hang_up(service, path, packed, cut=half), ["ended"]),
            (
                "last byte is missing",
                lambda: _hang_up(service, path, packed, cut=len(packed) - 1),
                ["ended"],
            ),
            (
                "chunked, connection ends",
                lambda: _hang_up(service, path, packed, cut=half, chunked=True),
                ["ended"],
            ),
            (
                "the rest never comes",
                lambda: _wait_for(service, path, packed[:half], len(packed)),
                ["504 request.too_slow"],
            ),
            ("a whole request of half a file", declared_too_short, ["422 packed.*"]),
            (
                "gRPC, cancelled",
                lambda: _grpc_upload(service, version, packed[:half], cancel=True),
                ["CANCELLED"],
            ),
            (
                "gRPC, half a file",
                lambda: _grpc_upload(service, version, packed[:half], cancel=False),
                ["INVALID_ARGUMENT"],
            ),
        ]
        checks = [_nothing_stays(maps, service, name, way, said) for name, way, said in ways]
        whole = _status(http.put(path, content=packed, headers=ZIP))
        used = _status(http.post("/maps/room/current", json={"version": version}))
    count = verify_store(maps.folder)
    return [
        *checks,
        Check(
            "the whole file is accepted afterwards, and taken into use",
            f"{whole}, {used}, {count} versions read byte by byte",
            (whole, used, count) == ("201", "200", 4),
        ),
    ]


def full_disk(maps: SampleMaps, work: Path) -> list[Check]:
    """Upload to a file system without room, then with room again.

    The store is on a small tmpfs that only the service's own mount namespace has, so that neither
    an administrator nor a change to this machine is needed, only ``unshare``.
    """
    packed = maps.packed.read_bytes()
    version = maps.versions["room"][-1]
    mounted = work / "mounted"
    mounted.mkdir()
    size_kib = _tree_kib(maps.folder) + 8 * len(packed) // 1024
    script = (
        f"mount -t tmpfs -o size={size_kib}k visloc-test {mounted}"
        f" && cp -a {maps.folder}/. {mounted}"
        ' && exec "$@"'
    )
    before = ["unshare", "--map-root-user", "--mount", "sh", "-ec", script, "sh"]
    probe = [*before, "true"]
    done = subprocess.run(probe, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return [Check("a tmpfs can be mounted with unshare", done.stderr.strip()[:200], False)]
    service = ServiceProcess(mounted, work / "service.log", before=before)
    with service, httpx.Client(base_url=service.url, timeout=60) as http:
        store = Path(f"/proc/{service.pid}/root{mounted}")
        seen = replace(maps, folder=store)
        _make_way(http, maps)
        path = f"/maps/room/versions/{version}"

        def put() -> str:
            return _status(http.put(path, content=packed, headers=ZIP))

        def grpc_put() -> str:
            return _grpc_upload(service, version, packed, cancel=False)

        checks = []
        full = ["507 maps.storage_full", "RESOURCE_EXHAUSTED"]
        for name, room in (
            ("for half of the packed file", len(packed) // 2),
            ("for the packed file, not for the map", len(packed) + len(packed) // 2),
            ("for nothing", 0),
        ):
            with _filled(store, room):
                for door, way in (("HTTP", put), ("gRPC", grpc_put)):
                    what = f"room {name}, {door}"
                    checks.append(_nothing_stays(seen, service, what, way, full))
        first, other = maps.versions["hall"]
        with _filled(store, 0):
            swapped = _status(http.post("/maps/hall/current", json={"version": first}))
            now = MapStore(store).current_version("hall")
            told = _status(http.get(f"/maps/hall/versions/{now}"))
        whole, used = put(), _status(http.post("/maps/room/current", json={"version": version}))
        count = verify_store(store)
    return [
        *checks,
        Check(
            "on a full disk a version is put into use as a whole, or that is refused as a whole",
            f"{swapped}; in use: {'the new' if now == first else 'the old'} one",
            (swapped == "200" and now == first)
            or (swapped == "507 maps.storage_full" and now == other and told == "200"),
        ),
        Check(
            "with room again, the same upload succeeds",
            f"{whole}, {used}, {count} versions read byte by byte",
            (whole, used, count) == ("201", "200", 4),
        ),
    ]


def _make_way(http: httpx.Client, maps: SampleMaps) -> None:
    """Delete the version that is to be uploaded."""
    first, last = maps.versions["room"]
    http.post("/maps/room/current", json={"version": first}).raise_for_status()
    http.delete(f"/maps/room/versions/{last}").raise_for_status()


def _nothing_stays(
    maps: SampleMaps,
    service: ServiceProcess,
    name: str,
    way: Callable[[], str],
    expected: Sequence[str],
) -> Check:
    before = tree_hash(maps.folder)
    said = way()
    same, left = _settled(maps.folder, before)
    as_expected = any(said.startswith(words.rstrip("*")) for words in expected)
    return Check(
        f"{name}: said clearly, the store is as before, the service goes on",
        f"{said}; store {'as before' if same else 'changed'}, {len(left)} files left",
        as_expected and same and not left and service.is_ready(),
    )


def _settled(folder: Path, before: str) -> tuple[bool, list[str]]:
    """Whether a store is as before, and what is left in it, when nothing happens any more.

    A server learns that a client left when it reads on, and an answer may come before the end.
    """
    end, calm_since = time.monotonic() + 10, time.monotonic()
    while True:
        same, left = tree_hash(folder) == before, leftovers(folder)
        now = time.monotonic()
        if not same or left:
            calm_since = now
        if now > calm_since + 1 or now > end:
            return same, left
        time.sleep(0.1)


def _status(response: httpx.Response) -> str:
    code = response.json().get("code", "") if response.status_code >= 400 else ""
    return f"{response.status_code} {code}".strip()


def _hang_up(
    service: ServiceProcess, path: str, packed: bytes, *, cut: int, chunked: bool = False
) -> str:
    with socket.create_connection(("127.0.0.1", service.http_port), timeout=30) as connection:
        length = "Transfer-Encoding: chunked" if chunked else f"Content-Length: {len(packed)}"
        connection.sendall(_head(service, path, length))
        sent = packed[:cut]
        connection.sendall(b"%x\r\n%b\r\n" % (cut, sent) if chunked else sent)
    return "ended by the client"


def _wait_for(service: ServiceProcess, path: str, part: bytes, declared: int) -> str:
    with socket.create_connection(("127.0.0.1", service.http_port), timeout=60) as connection:
        connection.sendall(_head(service, path, f"Content-Length: {declared}") + part)
        text = b""
        while b"\r\n\r\n" not in text or b"}" not in text:
            more = connection.recv(65536)
            if not more:
                break
            text += more
    status = text.split(b" ", 2)[1].decode() if text else "no answer"
    code = text.partition(b'"code":"')[2].partition(b'"')[0].decode()
    return f"{status} {code}"


def _head(service: ServiceProcess, path: str, length: str) -> bytes:
    lines = [
        f"PUT {path} HTTP/1.1",
        f"Host: 127.0.0.1:{service.http_port}",
        "Content-Type: application/zip",
        length,
    ]
    return "\r\n".join([*lines, "", ""]).encode()


def _grpc_upload(service: ServiceProcess, version: str, packed: bytes, *, cancel: bool) -> str:
    def messages() -> Iterator[PutVersionRequest]:
        yield PutVersionRequest(start=VersionRef(map="room", version=version))
        for start in range(0, len(packed), _CHUNK_BYTES):
            yield PutVersionRequest(chunk=packed[start : start + _CHUNK_BYTES])
        if cancel:
            call.cancel()  # type: ignore[no-untyped-call]

    with grpc.insecure_channel(service.grpc) as channel:
        call = MapsStub(channel).PutVersion.future(messages(), timeout=60)
        try:
            call.result()
        except grpc.RpcError as error:
            return error.code().name
        except grpc.FutureCancelledError:
            return "CANCELLED"
    return "OK"


@contextmanager
def _filled(folder: Path, room: int) -> Iterator[None]:
    """Fill a file system until there is only so much room, in bytes."""
    filler = folder / ".filler"
    about = os.statvfs(folder)
    free = about.f_bavail * about.f_frsize
    with filler.open("wb") as file:
        file.write(bytes(max(0, free - room)))
    try:
        yield
    finally:
        filler.unlink()


def _tree_kib(folder: Path) -> int:
    sizes = (path.stat().st_size for path in folder.rglob("*") if path.is_file())
    # Whole pages, as tmpfs has them.
    return sum(-(-size // 4096) * 4 for size in sizes)
