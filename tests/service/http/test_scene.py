"""Points and photos of maps over HTTP."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from starlette.responses import Response

import service.engine.scenes
from service.engine.scenes import Scenes, _Kept
from service.http.scenes import _of_version
from service.security.key_file import Scope, edited_keys, new_key
from service.values import MapFolder, ServedMap
from tests.service.conftest import Doors
from visloc.archive import Map, MapOutline, MapStore
from visloc.drawing.detail_levels import detail_order
from visloc.drawing.point_bytes import packed_points
from visloc.errors import MapCorrupt, NotFound
from visloc.geometry import Pose
from visloc_api.words.scenes import MapImages


@pytest.fixture(scope="module")
def opened(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


def problem(response: httpx.Response, status: int, code: str) -> dict[str, Any]:
    assert response.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = response.json()
    assert (response.status_code, body["code"]) == (status, code)
    return body


# Points


def test_points_come_in_their_order_of_detail(doors: Doors, opened: Map) -> None:
    order = detail_order(opened.landmarks)

    for query, first, count in (("", 0, 65_536), ("?first=7&count=20", 7, 20)):
        answer = doors.http.get(f"/maps/room/points{query}")
        assert answer.status_code == 200
        assert answer.headers["content-type"] == "application/octet-stream"
        assert answer.headers["content-length"] == str(len(answer.content))
        assert answer.content == packed_points(opened, order, first, count)


def test_pages_make_up_the_whole_map(doors: Doors, opened: Map) -> None:
    pages = []
    while not pages or pages[-1]:
        query = {"first": len(pages) * 1000, "count": 1000}
        pages.append(doors.http.get("/maps/room/points", params=query).content[48:])

    whole = packed_points(opened, detail_order(opened.landmarks), 0, 2**31)
    assert b"".join(pages) == whole[48:]


def test_beyond_the_end_there_are_no_points_and_no_error(doors: Doors, opened: Map) -> None:
    num = len(opened.landmarks)
    for first in (num, 2**32 - 1):
        answer = doors.http.get("/maps/room/points", params={"first": first})
        assert answer.status_code == 200
        assert struct.unpack("<4s4I", answer.content[:20]) == (b"VLPT", 1, num, first, 0)
        assert len(answer.content) == 48


@pytest.mark.parametrize("path", ["points", "images"])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("first", "-1"),
        ("first", str(2**32)),
        ("first", "9" * 400),
        ("first", "nan"),
        ("count", "0"),
        ("count", "-5"),
        ("count", "262145"),
        ("count", "1.5"),
        ("count", "inf"),
        ("count", ""),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(
    path: str, name: str, value: str, doors: Doors
) -> None:
    answer = doors.http.get(f"/maps/room/{path}", params={name: value})

    assert problem(answer, 422, "request.invalid")["field"] == f"query.{name}"


@pytest.mark.parametrize("path", ["points", "images"])
def test_maps_that_are_not_there_are_refused_as_everywhere(path: str, doors: Doors) -> None:
    get = doors.http.get
    problem(get(f"/maps/hall/{path}"), 404, "map.unknown")
    problem(get(f"/maps/room@none/{path}"), 404, "map.version")
    problem(get(f"/maps/..%2froom/{path}"), 404, "http.not_found")
    problem(get(f"/maps/.room/{path}"), 422, "map.id")
    problem(
        get(f"/maps/room/{path}", headers={"X-Request-Timeout": "soon"}), 422, "request.timeout"
    )
    problem(doors.http.post(f"/maps/room/{path}"), 405, "http.method_not_allowed")


# Photos


def test_images_say_where_they_were_taken(doors: Doors, opened: Map) -> None:
    body = doors.http.get("/maps/room/images").json()
    answer = MapImages.model_validate(body)

    assert answer.model_dump() == body
    assert (answer.map.id, answer.map.version) == ("room", opened.manifest.version)
    assert (answer.total, answer.first) == (len(opened.images), 0)
    assert [image.name for image in answer.images] == [image.name for image in opened.images]
    for image, row in zip(answer.images, opened.image_poses, strict=True):
        cam_from_world = Pose.from_quaternion(row[:4], row[4:])
        np.testing.assert_allclose(image.position, cam_from_world.center, atol=1e-12)
        expected = cam_from_world.inverse().rotation_wxyz
        np.testing.assert_allclose(image.orientation, expected, atol=1e-12)
        assert answer.cameras[image.camera].params == list(opened.cameras[image.camera].params)


def test_images_come_in_pages_with_the_cameras_that_they_name(doors: Doors, opened: Map) -> None:
    pages = [
        MapImages.model_validate(
            doors.http.get("/maps/room/images", params={"first": first, "count": 3}).json()
        )
        for first in range(0, len(opened.images) + 3, 3)
    ]

    names = [image.name for page in pages for image in page.images]
    assert names == [image.name for image in opened.images]
    assert [page.first for page in pages] == list(range(0, len(opened.images) + 3, 3))
    for page in pages:
        assert page.cameras.keys() == {image.camera for image in page.images}
        assert page.total == len(opened.images)


# What may be kept


@pytest.mark.parametrize("path", ["points", "images"])
def test_a_version_may_be_kept_for_ever_and_a_map_is_asked_for_again(
    path: str, doors: Doors, opened: Map
) -> None:
    get = doors.http.get
    of_map = get(f"/maps/room/{path}")
    of_version = get(f"/maps/room@{opened.manifest.version}/{path}")

    assert of_map.headers["cache-control"] == "private, no-cache"
    assert of_version.headers["cache-control"] == "private, max-age=31536000, immutable"
    assert of_map.headers["etag"] == of_version.headers["etag"]
    assert of_map.headers["etag"] != get(f"/maps/room/{path}?first=1").headers["etag"]
    assert of_map.headers["etag"] != get(f"/maps/room/{path}?count=1").headers["etag"]
    etag = of_map.headers["etag"]
    for given in (etag, f'"other", W/{etag}', "*"):
        again = get(f"/maps/room/{path}", headers={"If-None-Match": given})
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["etag"] == etag
        assert again.headers["vary"] == of_map.headers["vary"]
    changed = get(f"/maps/room/{path}", headers={"If-None-Match": '"other"'})
    assert changed.content == of_map.content


@pytest.mark.parametrize("path", ["points", "images"])
def test_what_was_kept_is_no_answer_to_another_key(path: str, doors: Doors, opened: Map) -> None:
    for ref in ("room", f"room@{opened.manifest.version}"):
        named = doors.http.get(f"/maps/{ref}/{path}").headers["vary"].lower()
        assert {"authorization", "x-api-key"} <= set(named.replace(" ", "").split(","))


# Who may


def test_a_key_with_the_scope_read_is_needed(maps_dir: Path, tmp_path: Path, serve: Any) -> None:
    tokens = {}
    with edited_keys(tmp_path / "keys.json") as keys:
        for scope in (Scope.READ, Scope.LOCALIZE):
            key, tokens[scope] = new_key(scope.value, frozenset({scope}))
            keys.append(key)
    with serve(maps_dir, keys_file=tmp_path / "keys.json", load=False) as doors:
        for path in ("/maps/room/points", "/maps/room/images"):
            problem(doors.http.get(path), 401, "access.key_missing")
            localize = {"X-API-Key": tokens[Scope.LOCALIZE]}
            problem(doors.http.get(path, headers=localize), 403, "access.scope")
            read = {"X-API-Key": tokens[Scope.READ]}
            assert doors.http.get(path, headers=read).status_code == 200


# Versions that come, go and are damaged


def test_what_is_deleted_is_gone(maps_dir: Path, serve: Any) -> None:
    store = MapStore(maps_dir)
    before = store.current_version("room")
    with serve(maps_dir, load=False) as doors:
        assert doors.http.get(f"/maps/room@{before}/points").status_code == 200
        store.remove("room", before)
        for path in ("points", "images"):
            problem(doors.http.get(f"/maps/room@{before}/{path}"), 404, "map.unknown")


@pytest.mark.parametrize(
    ("path", "name", "code"),
    [
        ("points", "landmarks.npy", "map.array"),
        ("images", "images.json", "map.json"),
    ],
)
def test_a_damaged_map_is_told_as_such(
    path: str, name: str, code: str, maps_dir: Path, serve: Any
) -> None:
    file = MapStore(maps_dir).folder("room") / name
    good = file.read_bytes()
    with serve(maps_dir, load=False) as doors:
        assert doors.http.get("/maps/room").status_code == 200
        file.write_bytes(good[: len(good) // 2])
        problem(doors.http.get(f"/maps/room/{path}"), 500, code)
        file.write_bytes(good)  # a failure is not kept
        assert doors.http.get(f"/maps/room/{path}").status_code == 200


# Work


def test_an_order_is_computed_once_for_all_who_ask(
    maps_dir: Path, serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed = []
    enough = threading.Event()

    def slow(landmarks: Any) -> Any:
        computed.append(len(landmarks))
        enough.wait(5)
        return detail_order(landmarks)

    monkeypatch.setattr(service.engine.scenes, "detail_order", slow)
    with serve(maps_dir, load=False) as doors, ThreadPoolExecutor(6) as pool:
        asked = [pool.submit(doors.http.get, "/maps/room/points") for _ in range(6)]
        for _ in range(3):  # the server answers others meanwhile
            assert doors.http.get("/healthz").status_code == 200
        enough.set()
        assert len({answer.result().content for answer in asked}) == 1
        assert doors.http.get("/maps/room/points?first=5").status_code == 200

    assert len(computed) == 1


def test_an_order_that_takes_too_long_is_there_the_next_time(
    maps_dir: Path, serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    enough = threading.Event()

    def slow(landmarks: Any) -> Any:
        enough.wait(20)
        return detail_order(landmarks)

    monkeypatch.setattr(service.engine.scenes, "detail_order", slow)
    with serve(maps_dir, load=False) as doors:
        late = doors.http.get("/maps/room/points", headers={"X-Request-Timeout": "0.2"})
        problem(late, 504, "request.deadline")
        enough.set()
        assert doors.http.get("/maps/room/points").status_code == 200


def outline_named(opened: Map, name: str) -> MapOutline:
    manifest = opened.manifest.model_copy(update={"content_hash": name})
    return MapOutline(manifest, opened.cameras, opened.rigs)


class OneMap:
    """A catalog that gives one folder for everything and counts who has it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.reading_now = 0
        self.held = 0

    @asynccontextmanager
    async def reading(self, ref: str) -> AsyncIterator[MapFolder]:
        self.reading_now += 1
        self.held += 1
        yield MapFolder(ref, self.folder)
        self.reading_now -= 1


def test_a_version_is_held_while_it_is_read_and_no_longer(
    opened: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalog: Any = OneMap(opened.path)
    scenes = Scenes(catalog)

    def order(landmarks: Any) -> Any:
        assert catalog.reading_now == 0  # it may take long
        return detail_order(landmarks)

    monkeypatch.setattr(service.engine.scenes, "detail_order", order)
    body = asyncio.run(scenes.points(opened, 0, 10))
    scenes.close()

    assert body == packed_points(opened, detail_order(opened.landmarks), 0, 10)
    assert (catalog.held, catalog.reading_now) == (2, 0)


def test_points_and_photos_never_wait_for_the_order_of_another_map(
    opened: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    enough = threading.Event()
    at_once: list[int] = []
    under_way: list[int] = []

    def slow(landmarks: Any) -> Any:
        under_way.append(1)
        at_once.append(len(under_way))
        enough.wait(20)
        under_way.pop()
        return detail_order(landmarks)

    async def use() -> None:
        catalog: Any = OneMap(opened.path)
        scenes = Scenes(catalog)
        known = await scenes.points(opened, 0, 10)
        monkeypatch.setattr(service.engine.scenes, "detail_order", slow)
        large = [
            asyncio.create_task(scenes.points(outline_named(opened, name), 0, 10))
            for name in ("large", "larger", "largest")
        ]
        async with asyncio.timeout(10):
            while not at_once:
                await asyncio.sleep(0.001)
            assert await scenes.points(opened, 0, 10) == known
            assert (await scenes.photos(outline_named(opened, "small"))).images == opened.images
        enough.set()
        assert await asyncio.gather(*large) == [known] * 3
        scenes.close()

    asyncio.run(use())
    assert at_once == [1, 1, 1]  # and one at a time, which bounds their memory


@pytest.mark.parametrize("takes_over", [True, False])
def test_a_version_that_goes_meanwhile_is_looked_up_once_more(
    takes_over: bool, opened: Map
) -> None:
    versions = ["first", "second" if takes_over else "first"]

    class Replaced:
        async def map(self, _: str) -> ServedMap:
            manifest = opened.manifest.model_copy(update={"version": versions.pop(0)})
            return ServedMap(MapOutline(manifest, {}, {}), True, ())

    async def answer(outline: MapOutline) -> Response:
        if outline.manifest.version == "first":
            raise NotFound("map.version", "deleted", field="map")
        return Response(outline.manifest.version)

    engine: Any = Replaced()
    if takes_over:
        assert asyncio.run(_of_version(engine, "room", answer)).body == b"second"
    else:
        with pytest.raises(NotFound):
            asyncio.run(_of_version(engine, "room", answer))
    assert versions == []


def test_the_last_used_values_are_kept_whatever_their_size() -> None:
    made: list[str] = []

    async def use() -> None:
        kept = _Kept[str](2)

        async def get(key: str, value: str) -> None:
            async def make() -> str:
                made.append(key)
                return value

            assert await kept.get(key, make) == value

        for key in "abab":  # a large one and a small one in turn
            await get(key, "x" * (1 if key == "a" else 10**6))
        assert made == ["a", "b"]
        await get("c", "12345")  # a was used longest ago
        await get("b", "x" * 10**6)
        assert made == ["a", "b", "c"]
        await get("a", "x")
        assert made == ["a", "b", "c", "a"]

    asyncio.run(use())


def test_a_failure_reaches_all_who_wait_and_is_not_kept() -> None:
    async def use() -> None:
        kept = _Kept[str](10)
        go = asyncio.Event()

        async def fail() -> str:
            await go.wait()
            raise MapCorrupt("map.array", "damaged")

        async def succeed() -> str:
            return "fine"

        waiting = [asyncio.create_task(kept.get("a", fail)) for _ in range(3)]
        await asyncio.sleep(0)
        go.set()
        errors = await asyncio.gather(*waiting, return_exceptions=True)
        assert [getattr(error, "code", None) for error in errors] == ["map.array"] * 3
        assert len({id(error) for error in errors}) == 3
        assert await kept.get("a", succeed) == "fine"

    asyncio.run(use())


# The description


def test_openapi_tells_the_bytes_and_the_limits(doors: Doors) -> None:
    paths = doors.http.get("/openapi.json").json()["paths"]
    points = paths["/maps/{ref}/points"]["get"]

    assert set(points["responses"]["200"]["content"]) == {"application/octet-stream"}
    limits = {p["name"]: p["schema"] for p in points["parameters"] if p["in"] == "query"}
    assert limits["count"]["maximum"] == 262_144
    assert limits["first"]["minimum"] == 0
    assert "304" in points["responses"]
    assert "/" not in paths
    assert not any(path.startswith("/assets") for path in paths)
    assert json.dumps(paths["/maps/{ref}/images"]).count("MapImages") == 1
