"""Maps through both doors, and through the clients: versions come, take over and go."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import socket
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent import futures
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from clients import AsyncClient, Axes, Client, Near, session_from_map
from clients.cli.main import main
from clients.cli.maps_display import print_map
from conftest import Query
from service.http.openapi import example
from visloc.archive import MapStore
from visloc.archive.checks import (
    content_hash,
    json_text,
    manifest_hash,
    sha256_of,
)
from visloc.archive.packed import pack_map
from visloc.errors import Conflict, InvalidInput, NotFound, TooLarge, VislocError
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1.localization_pb2_grpc import MapsStub
from visloc_api.words.maps import MapInfo

Pack = Callable[..., Path]


@pytest.fixture(scope="module")
def pack(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Pack:
    """Pack a map that is equal to ``room`` but for its names."""
    folder = tmp_path_factory.mktemp("packed")

    def make(
        version: str,
        map_id: str = "room",
        at: tuple[float, float] | None = None,
        change: Callable[[Any], None] = lambda _: None,
    ) -> Path:
        target = folder / f"{map_id}@{version}.zip"
        if not target.exists():
            copied = folder / "map"
            shutil.copytree(MapStore(built_maps).folder("room"), copied)
            manifest = json.loads((copied / "manifest.json").read_text())
            manifest.update(id=map_id, version=version)
            if at is not None:
                geodetic = {"latitude_deg": at[0], "longitude_deg": at[1], "altitude_m": 500.0}
                manifest["world"]["anchor"]["geodetic"] = geodetic
                manifest["content_hash"] = content_hash(manifest)
            change(manifest)
            manifest["manifest_hash"] = manifest_hash(manifest)
            (copied / "manifest.json").write_text(json_text(manifest))
            pack_map(copied, target)
            shutil.rmtree(copied)
        return target

    return make


@pytest.fixture(scope="module")
def root(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The maps of this module's service."""
    return Path(shutil.copytree(built_maps, tmp_path_factory.mktemp("served") / "maps"))


@pytest.fixture(scope="module")
def doors(root: Path, pack: Pack, serve: Any) -> Iterator[Any]:
    limit = pack("v0").stat().st_size + 100_000
    with serve(root, max_upload_bytes=limit, arrival_timeout_s=1.0) as doors:
        yield doors


@pytest.fixture(params=["http", "grpc"])
def url(doors: Any, request: pytest.FixtureRequest) -> str:
    port = doors.server.http_port if request.param == "http" else doors.server.grpc_port
    return f"{request.param}://127.0.0.1:{port}"


@pytest.fixture
def client(url: str) -> Iterator[Client]:
    with Client(url) as client:
        yield client


@pytest.fixture
def name(url: str) -> str:
    """A version of this test's and this door's own."""
    return f"v-{url.partition(':')[0]}-{time.monotonic_ns()}"


@pytest.fixture(autouse=True)
def nothing_is_left(root: Path) -> Iterator[None]:
    """Whatever becomes of an upload, its files are gone soon after."""
    yield
    for _ in range(50):
        if not (left := files_below(root / ".incoming")):
            return
        time.sleep(0.1)
    pytest.fail(f"left behind: {left}")


def files_below(folder: Path) -> list[Path]:
    # os.walk passes over a folder that the service removes meanwhile; rglob raises.
    found = (Path(at, name) for at, _, names in os.walk(folder) for name in names)
    return [path for path in found if path.name != ".lock"]


def used(client: Client) -> str:
    return client.map("room").version


def refused(kind: type[VislocError], code: str, call: Callable[[], object]) -> VislocError:
    with pytest.raises(kind) as caught:
        call()
    assert caught.value.code == code
    return caught.value


def test_a_version_comes_takes_over_is_rolled_back_and_goes(
    client: Client, name: str, pack: Pack
) -> None:
    before = client.map("room")

    uploaded = client.upload_map(pack(name))
    assert (uploaded.id, uploaded.version, uploaded.current) == ("room", name, False)
    assert uploaded.content_hash == before.content_hash
    assert [(v.version, v.current) for v in uploaded.versions] == sorted(
        [(v.version, v.current) for v in before.versions] + [(name, False)]
    )
    assert used(client) == before.version
    assert client.map_version("room", name) == uploaded

    taken_over = client.use_version("room", name)
    assert (taken_over.version, taken_over.current) == (name, True)
    assert used(client) == name
    assert not client.map_version("room", before.version).current

    assert client.use_version("room", before.version).current
    assert used(client) == before.version

    client.delete_version("room", name)
    refused(NotFound, "map.version", lambda: client.map_version("room", name))
    assert client.map("room") == before


def test_a_map_that_is_new_is_not_listed_until_a_version_is_in_use(
    client: Client, name: str, pack: Pack
) -> None:
    map_id = f"hall-{name}"
    uploaded = client.upload_map(pack("v1", map_id))

    assert [(v.version, v.current) for v in uploaded.versions] == [("v1", False)]
    assert map_id not in {info.id for info in client.maps()}
    refused(NotFound, "map.none_in_use", lambda: client.map(map_id))

    client.use_version(map_id, "v1")
    assert map_id in {info.id for info in client.maps()}

    client.delete_version(map_id, "v1")
    assert map_id not in {info.id for info in client.maps()}


def test_both_doors_describe_a_version_alike(doors: Any) -> None:
    (info,) = doors.http.get("/maps").json()["maps"]
    over_http = doors.http.get(f"/maps/room/versions/{info['version']}").json()
    with Client(f"grpc://127.0.0.1:{doors.server.grpc_port}") as client:
        over_grpc = client.map_version("room", info["version"])
    with Client(doors.url) as client:
        assert client.map_version("room", info["version"]) == over_grpc
    assert over_http == info


def test_a_map_tells_what_an_app_decides_by(
    client: Client, name: str, pack: Pack, query: Query, built_maps: Path
) -> None:
    before = client.map("room")

    def change(manifest: Any) -> None:
        manifest["world"]["metric"] = False
        manifest["parts"]["doubts"] = [
            {"kind": "order", "message": f"doubt {i}", "photos": ["a.jpg"]} for i in range(40)
        ]
        others = [f"room-{i}@v1" for i in range(2, 42)]
        manifest["method"]["settings"]["pieces"] = ["x" * 10_000, 7, None, "room-1", *others]
        manifest["content_hash"] = content_hash(manifest)

    client.upload_map(pack(name, change=change))
    assert client.localize(query.image, "room", query.camera).pose.metric is True
    client.use_version("room", name)
    (told,) = client.maps()
    answer = client.localize(query.image, "room", query.camera)
    with pytest.warns(UserWarning, match="unknown length"):
        session_from_map(np.eye(4), answer.pose, Axes.OPENGL)
    client.use_version("room", before.version)
    client.delete_version("room", name)

    assert (before.metric, before.doubts, before.pieces) == (True, (), ())
    assert (told.metric, answer.pose.metric) == (False, False)
    assert [doubt.message for doubt in told.doubts] == [f"doubt {i}" for i in range(16)]
    assert told.doubts[0].kind == "order"
    assert told.pieces == tuple(f"room-{i}@v1" for i in range(2, 18))
    opened = MapStore(built_maps).open("room")
    test = opened.manifest.parts.own_test
    assert (told.own_test.tested, told.own_test.wrong) == (test.tested, test.wrong)
    assert {k: c.camera for k, c in told.cameras.items()} == dict(opened.cameras)
    assert told.num_cameras == len(opened.cameras)


def test_the_command_shows_what_speaks_against_a_map(capsys: pytest.CaptureFixture[str]) -> None:
    told = example("map") | {
        "doubts": [{"kind": "order", "message": "the path of a film jumps"}],
        "own_test": {"tested": 12, "localized": 11, "wrong": 2},
        "pieces": ["room-2@v1", "room-3@v1"],
    }

    print_map(Console(width=200), MapInfo.model_validate(told))

    lines = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    shown = {line[0]: line[1] for line in lines if len(line) > 1}
    assert shown["doubt"] == "the path of a film jumps"
    assert shown["own"] == "test       9 of 12 photos came back where they were, 2 elsewhere"
    assert shown["pieces"] == "room-2@v1, room-3@v1"


def test_the_photos_of_a_map_and_their_cameras_come_in_pages(doors: Any, built_maps: Path) -> None:
    opened = MapStore(built_maps).open("room")

    with Client(doors.url) as client:
        page, whole = client.images("room", 1, 2), client.images("room")

    assert (page.first, page.total, page.map.id) == (1, len(opened.images), "room")
    assert [each.name for each in page.images] == [each.name for each in opened.images[1:3]]
    camera = page.images[0].camera
    assert page.cameras[camera].camera == opened.cameras[camera]
    assert [each.name for each in whole.images] == [each.name for each in opened.images]


@pytest.mark.parametrize(
    ("asked", "code", "field"),
    [
        (("hall",), "map.unknown", "map"),
        (("room@none",), "map.version", "map"),
        (("../room",), "map.id", "map"),
        (("room", -1), "request.invalid", "query.first"),
        (("room", 0, 0), "request.invalid", "query.count"),
        (("room", 0, 10_001), "request.invalid", "query.count"),
    ],
)
def test_photos_that_a_map_cannot_give_are_refused_by_name(
    doors: Any, asked: tuple[Any, ...], code: str, field: str
) -> None:
    with Client(doors.url) as client, pytest.raises(VislocError) as caught:
        client.images(*asked)
    assert (caught.value.code, caught.value.field) == (code, field)


def test_photos_of_a_map_are_refused_over_grpc_with_the_way_that_has_them(doors: Any) -> None:
    with Client(f"grpc://127.0.0.1:{doors.server.grpc_port}") as client:
        error = refused(InvalidInput, "server.url", lambda: client.images("room"))
    assert error.expected == "http://host:port"


def test_an_upload_answers_with_the_place_of_the_version(doors: Any, pack: Pack) -> None:
    path = "/maps/room/versions/located"
    response = doors.http.put(
        path, content=pack("located").read_bytes(), headers={"Content-Type": "application/zip"}
    )

    assert response.status_code == 201
    assert response.headers["location"] == path
    assert doors.http.get(path).json() == response.json()
    removed = doors.http.delete(path)
    assert (removed.status_code, removed.content) == (204, b"")


def test_a_version_in_use_is_not_deleted(client: Client, name: str, pack: Pack) -> None:
    client.upload_map(pack(name))
    try:
        refused(Conflict, "map.version_in_use", lambda: client.delete_version("room", used(client)))
    finally:
        client.delete_version("room", name)


def test_an_unknown_version_is_neither_used_nor_deleted(client: Client) -> None:
    refused(NotFound, "map.version", lambda: client.use_version("room", "nothing"))
    refused(NotFound, "map.version", lambda: client.delete_version("room", "nothing"))
    refused(NotFound, "map.unknown", lambda: client.use_version("nothing", "nothing"))
    refused(NotFound, "map.unknown", lambda: client.delete_version("nothing", "nothing"))


def test_photos_are_answered_while_versions_change(doors: Any, pack: Pack, query: Any) -> None:
    name = "switched"
    with Client(doors.url) as client, futures.ThreadPoolExecutor(1) as threads:
        first = used(client)
        client.upload_map(pack(name))
        done = threading.Event()

        def ask() -> list[Any]:
            with Client(doors.url) as asking:
                found = []
                while not done.is_set() or len(found) < 3:
                    found.append(asking.localize(query.image, "room", query.camera, {"seed": 1}))
                return found

        asked = threads.submit(ask)
        for version in (name, first, name, first):
            client.use_version("room", version)
        done.set()
        results = asked.result(60)
        client.delete_version("room", name)

    assert {result.map.version for result in results} <= {first, name}
    # The versions have the same content: so have the answers.
    assert len({result.pose.rotation_wxyz for result in results}) == 1


def test_a_version_that_exists_is_refused_before_its_body_comes(doors: Any, root: Path) -> None:
    version = MapStore(root).current_version("room")
    with connected(doors) as connection:
        connection.sendall(put_head(f"/maps/room/versions/{version}", 100_000))
        answer = answer_of(connection)

    assert answer.startswith(b"HTTP/1.1 409")
    assert b"map.version_exists" in answer


def test_a_client_hears_of_a_refusal_while_it_sends(url: str, root: Path, pack: Pack) -> None:
    version = MapStore(root).current_version("room")
    with Client(url) as client:
        refused(
            Conflict,
            "map.version_exists",
            lambda: client.upload_map(pack("v0"), "room", version),
        )


def test_an_upload_that_declares_too_much_is_refused_before_it_comes(doors: Any) -> None:
    with connected(doors) as connection:
        connection.sendall(put_head("/maps/room/versions/huge", 10**15))
        answer = answer_of(connection)

    assert answer.startswith(b"HTTP/1.1 413")
    assert b"request.too_large" in answer


def test_an_upload_that_becomes_too_large_is_refused(
    doors: Any, client: Client, pack: Pack, tmp_path: Path
) -> None:
    large = tmp_path / "large.zip"
    large.write_bytes(pack("v0").read_bytes() + bytes(200_000))
    refused(TooLarge, "request.too_large", lambda: client.upload_map(large, "room", "large"))

    def chunks() -> Iterator[bytes]:
        yield large.read_bytes()

    headers = {"Content-Type": "application/zip"}
    response = doors.http.put("/maps/room/versions/large", content=chunks(), headers=headers)
    assert response.status_code == 413


def test_an_upload_that_breaks_off_leaves_nothing_and_can_be_repeated(
    doors: Any, name: str, pack: Pack, root: Path
) -> None:
    content = pack(name).read_bytes()
    with connected(doors) as connection:
        connection.sendall(put_head(f"/maps/room/versions/{name}", len(content)))
        connection.sendall(content[: len(content) // 2])
        wait_until(lambda: bool(files_below(root / ".incoming")))
    wait_until(lambda: not files_below(root / ".incoming"))

    with Client(doors.url) as client:
        refused(NotFound, "map.version", lambda: client.map_version("room", name))
        assert client.upload_map(pack(name)).version == name
        client.delete_version("room", name)


def test_a_cancelled_call_leaves_nothing_and_can_be_repeated(
    doors: Any, name: str, pack: Pack, root: Path
) -> None:
    content, goes_on = pack(name).read_bytes(), threading.Event()

    def messages() -> Iterator[pb2.PutVersionRequest]:
        yield pb2.PutVersionRequest(start=pb2.VersionRef(map="room", version=name))
        yield pb2.PutVersionRequest(chunk=content[:100_000])
        goes_on.wait(10)

    call: Any = MapsStub(doors.channel).PutVersion.future(messages())
    wait_until(lambda: bool(files_below(root / ".incoming")))
    call.cancel()
    goes_on.set()
    wait_until(lambda: not files_below(root / ".incoming"))

    with Client(doors.url) as client:
        assert client.upload_map(pack(name)).version == name
        client.delete_version("room", name)


def test_a_truncated_file_is_refused(client: Client, name: str, pack: Pack, tmp_path: Path) -> None:
    half = tmp_path / "half.zip"
    half.write_bytes(pack(name).read_bytes()[:-1000])

    with pytest.raises(InvalidInput) as caught:
        client.upload_map(half, "room", name)
    assert caught.value.code.startswith("packed.")
    refused(NotFound, "map.version", lambda: client.map_version("room", name))


def test_an_altered_byte_is_noticed_and_says_nothing_of_the_servers_folders(
    client: Client, name: str, pack: Pack, root: Path, tmp_path: Path
) -> None:
    altered = tmp_path / "altered.zip"
    content = bytearray(pack(name).read_bytes())
    content[len(content) // 2] ^= 1
    altered.write_bytes(content)

    with pytest.raises(InvalidInput) as caught:
        client.upload_map(altered, "room", name)
    assert str(root) not in str(caught.value)
    refused(NotFound, "map.version", lambda: client.map_version("room", name))


@pytest.mark.parametrize("content", [b"", b"PK", b"hello" * 1000])
def test_what_is_no_packed_map_is_refused(
    content: bytes, client: Client, name: str, tmp_path: Path
) -> None:
    file = tmp_path / "no.zip"
    file.write_bytes(content)
    with pytest.raises(InvalidInput) as caught:
        client.upload_map(file, "room", name)
    assert caught.value.code.startswith("packed.")


def test_a_map_is_published_under_its_own_names_only(client: Client, name: str, pack: Pack) -> None:
    refused(
        InvalidInput, "packed.renamed", lambda: client.upload_map(pack(name), "room", f"{name}x")
    )
    refused(InvalidInput, "packed.renamed", lambda: client.upload_map(pack(name), "hall", name))


def test_an_upload_that_stalls_is_given_up(doors: Any, url: str, name: str, pack: Pack) -> None:
    content = pack(name).read_bytes()[:1000]
    if url.startswith("http"):
        with connected(doors) as connection:
            connection.sendall(put_head(f"/maps/room/versions/{name}", 1_000_000) + content)
            answer = answer_of(connection)
        assert answer.startswith(b"HTTP/1.1 504")
        assert b"request.too_slow" in answer
        return
    goes_on = threading.Event()

    def messages() -> Iterator[pb2.PutVersionRequest]:
        yield pb2.PutVersionRequest(start=pb2.VersionRef(map="room", version=name))
        yield pb2.PutVersionRequest(chunk=content)
        goes_on.wait(10)

    with pytest.raises(grpc.RpcError) as caught:
        MapsStub(doors.channel).PutVersion(messages())
    goes_on.set()
    call: Any = caught.value
    assert call.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    assert "arrives too slowly" in call.details()


def test_a_file_that_shrinks_while_it_is_sent_is_an_error_of_its_own(
    client: Client, name: str, pack: Pack, tmp_path: Path
) -> None:
    file = tmp_path / "shrinks.zip"
    file.write_bytes(pack(name).read_bytes())
    refused(
        InvalidInput,
        "packed.changed",
        lambda: client.upload_map(
            file, "room", name, on_progress=lambda _: truncate(file, 600_000)
        ),
    )
    refused(NotFound, "map.version", lambda: client.map_version("room", name))


def test_a_version_is_uploaded_once_at_a_time(doors: Any, name: str, pack: Pack) -> None:
    content = pack(name).read_bytes()
    with connected(doors) as connection, Client(doors.url) as client:
        connection.sendall(put_head(f"/maps/room/versions/{name}", len(content)))
        connection.sendall(content[:1000])
        time.sleep(0.2)
        refused(Conflict, "map.upload_runs", lambda: client.upload_map(pack(name)))
        connection.sendall(content[1000:])
        assert answer_of(connection).startswith(b"HTTP/1.1 201")
        client.delete_version("room", name)


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        ([], "start"),
        ([pb2.PutVersionRequest(chunk=b"x")], "start"),
        ([pb2.PutVersionRequest()], "start"),
        (
            [pb2.PutVersionRequest(start=pb2.VersionRef(map="room", version="twice"))] * 2,
            "chunk",
        ),
    ],
)
def test_messages_in_another_order_are_refused(
    messages: list[pb2.PutVersionRequest], expected: str, doors: Any
) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        MapsStub(doors.channel).PutVersion(iter(messages))
    call: Any = caught.value
    assert call.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert f"expected {expected}" in call.details()


BAD_NAMES = ["..", ".", "%2e%2e", "..%2F..%2Fetc", "a%00b", "%20", "a@b", "x" * 65, "%C3%A9", "-a"]


@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE", "POST"])
@pytest.mark.parametrize("bad", BAD_NAMES)
def test_names_that_are_paths_or_worse_are_refused(
    method: str, bad: str, doors: Any, root: Path
) -> None:
    before = sorted(root.rglob("*"))
    paths = (
        [f"/maps/{bad}/current"]
        if method == "POST"
        else [f"/maps/{bad}/versions/v1", f"/maps/room/versions/{bad}"]
    )
    for path in paths:
        body = b'{"version":"v1"}'
        answer = raw(doors, method, path, body, "application/zip" if method == "PUT" else None)
        assert answer.split(b" ")[1] in (b"404", b"405", b"422"), answer
        assert b"problem+json" in answer
    assert sorted(root.rglob("*")) == before


@pytest.mark.parametrize("bad", ["", "..", "a/b", "../room", "a\x00b", "a@b", "x" * 65])
def test_names_that_are_paths_are_refused_over_grpc(bad: str, doors: Any) -> None:
    stub = MapsStub(doors.channel)
    for ref in (pb2.VersionRef(map=bad, version="v1"), pb2.VersionRef(map="room", version=bad)):
        for call in (
            stub.GetVersion,
            stub.SetCurrent,
            stub.DeleteVersion,
            lambda ref: stub.PutVersion(iter([pb2.PutVersionRequest(start=ref)])),
        ):
            with pytest.raises(grpc.RpcError) as caught:
                call(ref)
            failed: Any = caught.value
            assert failed.code() is grpc.StatusCode.INVALID_ARGUMENT


@pytest.mark.parametrize(
    ("body", "content_type", "status", "code"),
    [
        (b"{}", "application/json", 422, "request.missing_field"),
        (b'{"version":1}', "application/json", 422, "request.invalid"),
        (b'{"version":"v","x":1}', "application/json", 422, "request.unknown_field"),
        (b'{"version":"../v"}', "application/json", 422, "map.id"),
        (b"version=v", "application/x-www-form-urlencoded", 422, "request.content_type"),
        (b"[" * 1000, "application/json", 422, "request.malformed"),
        (b" " * 100_000, "application/json", 413, "request.too_large"),
    ],
)
def test_a_wrong_choice_of_version_is_refused(
    body: bytes, content_type: str, status: int, code: str, doors: Any
) -> None:
    headers = {"Content-Type": content_type}
    response = doors.http.post("/maps/room/current", content=body, headers=headers)

    assert (response.status_code, response.json()["code"]) == (status, code)


def test_only_packed_maps_are_taken(doors: Any) -> None:
    for headers in ({}, {"Content-Type": "multipart/form-data"}):
        response = doors.http.put("/maps/room/versions/v1", content=b"x", headers=headers)
        assert (response.status_code, response.json()["code"]) == (422, "request.content_type")


def test_maps_are_found_by_place(client: Client, name: str, pack: Pack) -> None:
    map_id = f"church-{name}"
    client.upload_map(pack("v1", map_id, at=(48.2, 11.5)))
    client.use_version(map_id, "v1")
    try:
        assert [m.id for m in client.maps(Near(48.2, 11.5, 1.0))] == [map_id]
        assert [m.id for m in client.maps(Near(48.2009, 11.5, 200.0))] == [map_id]
        assert client.maps(Near(48.21, 11.5, 200.0)) == []
        place = client.map(map_id).place
        assert place is not None
        assert (round(place.latitude, 3), round(place.longitude, 3)) == (48.2, 11.5)
    finally:
        client.delete_version(map_id, "v1")


@pytest.mark.parametrize("near", [(91.0, 0.0, 1.0), (0.0, 181.0, 1.0), (0.0, 0.0, -1.0)])
def test_a_place_that_is_none_is_refused(near: tuple[float, float, float], client: Client) -> None:
    with pytest.raises(InvalidInput) as caught:
        client.maps(Near(*near))
    assert caught.value.code.startswith("near.")


Arrays = dict[str, NDArray[np.float32]]


def without_axes(model: Arrays) -> None:
    for name in [name for name in model if name.startswith("axes")]:
        del model[name]


def with_mean_of_one_number(model: Arrays) -> None:
    model["mean"] = model["mean"][:1]


def with_fewer_words(model: Arrays) -> None:
    model["vocabulary"] = model["vocabulary"][:-1]


def with_words_beyond_all_others(model: Arrays) -> None:
    model["vocabulary"] = np.full_like(model["vocabulary"], 3e38)


@pytest.fixture
def repacked(root: Path, tmp_path: Path) -> Callable[[Callable[[Path, Any], None]], Path]:
    """Packs ``room`` as its version ``v-other`` after a change of its folder and its manifest."""

    def repack(change: Callable[[Path, Any], None]) -> Path:
        copied = Path(shutil.copytree(MapStore(root).folder("room"), tmp_path / "map"))
        manifest = json.loads((copied / "manifest.json").read_text())
        manifest["version"] = "v-other"
        change(copied, manifest)
        manifest["content_hash"] = content_hash(manifest)
        manifest["manifest_hash"] = manifest_hash(manifest)
        (copied / "manifest.json").write_text(json_text(manifest))
        with zipfile.ZipFile(tmp_path / "map.zip", "w") as archive:  # pack_map checks more
            for name in ("manifest.json", *sorted(manifest["files"])):
                archive.write(copied / name, name)
        return tmp_path / "map.zip"

    return repack


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (without_axes, "map.unusable"),
        (with_mean_of_one_number, "map.range"),
        (with_fewer_words, "map.range"),
        (with_words_beyond_all_others, "map.range"),
    ],
)
def test_a_map_whose_models_cannot_work_is_refused_when_it_comes(
    change: Callable[[Arrays], None], code: str, repacked: Any, doors: Any, query: Query
) -> None:
    def with_other_model(folder: Path, manifest: Any) -> None:
        file = next((folder / "global").glob("*.model.npz"))
        name = file.relative_to(folder).as_posix()
        arrays = dict(np.load(file))
        change(arrays)
        np.savez(file, **arrays)  # type: ignore[arg-type]  # its stub thinks of allow_pickle
        manifest["files"][name] = {"size": file.stat().st_size, "sha256": sha256_of(file)}

    sent = repacked(with_other_model)
    with Client(doors.url) as client:
        refused(InvalidInput, code, lambda: client.upload_map(sent, "room", "v-other"))
        assert "v-other" not in [each.version for each in client.map("room").versions]
        assert client.localize(query.image, "room", query.camera).localized


def test_a_map_whose_origin_is_nowhere_is_refused(repacked: Any, doors: Any) -> None:
    def far_away(_: Path, manifest: Any) -> None:
        manifest["world"]["origin"] = [1e300, 0.0, 0.0]

    sent = repacked(far_away)
    with Client(doors.url) as client:
        refused(InvalidInput, "map.manifest", lambda: client.upload_map(sent, "room", "v-other"))


@pytest.mark.parametrize("near", ["", "1", "1,2", "1,2,3,4", "a,b,c", "nan,0,1", "1;2;3"])
def test_a_place_that_cannot_be_read_is_refused(near: str, doors: Any) -> None:
    response = doors.http.get("/maps", params={"near": near})

    assert response.status_code == 422
    assert response.json()["code"].startswith("near.")


def test_an_asynchronous_client_sends_everything_and_tells_how_far_it_is(
    url: str, name: str, pack: Pack
) -> None:
    sent: list[int] = []

    async def run() -> None:
        async with AsyncClient(url) as client:
            info = await client.upload_map(pack(name), on_progress=sent.append)
            assert (info.version, info.current) == (name, False)
            assert await client.map_version("room", name) == info
            current = (await client.map("room")).version
            assert (await client.use_version("room", name)).current
            assert (await client.use_version("room", current)).current
            await client.delete_version("room", name)
            assert [m.id for m in await client.maps()] == ["room"]
            with pytest.raises(Conflict) as caught:
                await client.upload_map(pack(name), "room", current)
            assert caught.value.code == "map.version_exists"

    asyncio.run(run())
    assert sum(sent) >= pack(name).stat().st_size


def test_the_commands_publish_switch_and_remove(
    url: str, name: str, pack: Pack, capsys: pytest.CaptureFixture[str]
) -> None:
    def localize(*arguments: str) -> str:
        with pytest.raises(SystemExit) as ended:
            main(["maps", *arguments, "--server", url])
        printed = capsys.readouterr()
        assert ended.value.code == 0, printed.err
        return printed.out

    map_id = f"hall-{name}"
    assert f"localize maps use {map_id}@v1" in localize("push", str(pack("v1", map_id)))
    assert f"{map_id}@v1" in localize("use", f"{map_id}@v1")
    assert map_id in localize("list")
    shown = localize("show", map_id)
    assert "v1  current" in shown
    assert "8 photos" in shown
    assert f"{map_id}@v1" in localize("remove", f"{map_id}@v1")
    assert map_id not in localize("list")
    assert "no maps" in localize("list", "--near", "0,0,10")


def truncate(file: Path, size: int) -> None:
    with file.open("r+b") as opened:
        opened.truncate(size)


def put_head(path: str, size: int) -> bytes:
    return (
        f"PUT {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/zip\r\n"
        f"Content-Length: {size}\r\n\r\n"
    ).encode()


def raw(doors: Any, method: str, path: str, body: bytes, content_type: str | None) -> bytes:
    """Send a request whose path no client library has tidied up."""
    head = (
        f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n"
        f"Content-Type: {content_type or 'application/json'}\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    answer = b""
    with connected(doors) as connection:
        connection.sendall(head.encode() + body)
        while piece := connection.recv(65536):
            answer += piece
    return answer


def answer_of(connection: socket.socket) -> bytes:
    """Read one answer, which has a body of known length."""
    with connection.makefile("rb") as file:
        head = b"".join(iter(file.readline, b"\r\n"))
        length = int(head.lower().partition(b"content-length: ")[2].split(b"\r\n")[0])
        return head + file.read(length)


def connected(doors: Any) -> socket.socket:
    return socket.create_connection(("127.0.0.1", doors.server.http_port), timeout=10)


def wait_until(happened: Callable[[], bool]) -> None:
    for _ in range(100):
        if happened():
            return
        time.sleep(0.05)
    pytest.fail("it did not happen")
