"""Sets of maps when something is away, slow, far off or wrong, with real worker processes."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from clients import Client, Instant, Near, Odometry, RigImage
from mapping.frames.georeference import given_place, publish_anchored
from service.engine.catalog import Catalog
from service.engine.listing import Listing
from service.values import Near as Circle
from tests.service.rooms import (
    START,
    busy,
    copy_map,
    instants,
    quiet,
    state_of,
    wait_until,
)
from visloc.archive import MapOutline, MapStore, SetOutline
from visloc.errors import Conflict, NotFound, Unavailable, VislocError
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc.priors import PositionPrior, Priors
from visloc_extensions.sets.publishing import publish_set
from visloc_extensions.sets.sequences import SequenceInSet
from visloc_extensions.sets.tests.map_sets import SITE_FROM_ROOM, SITE_FROM_STUDY

Serve = Callable[..., AbstractContextManager[Any]]


@pytest.fixture(scope="module")
def served(site: Path, serve: Serve) -> Iterator[Any]:
    with serve(site, workers=2) as doors:
        yield doors


@pytest.fixture(scope="module")
def client(served: Any) -> Iterator[Client]:
    with Client(served.url) as client:
        yield client


def told(client: Client, sent: list[Instant], asked: Any) -> list[tuple[str, str]]:
    """Status and tile of each answer; the code of the error that ended it, if any."""
    found = []
    try:
        for each in client.localize_sequence(sent, asked):
            found.append((each.status, (each.tile or "").partition("@")[0]))
    except VislocError as error:
        found.append(("error", error.code))
    return found


def test_near_searches_the_tiles_that_reach_into_the_circle(
    site: Path, serve: Serve, query: Any, in_study: list[Any], tmp_path: Path
) -> None:
    maps = tmp_path / "maps"
    for name in ("room", "study"):
        shutil.copytree(site / name, maps / name)
    store = MapStore(maps)
    place = (45.2178, 5.8083, 310.0)
    anchored = given_place(store.open("room"), place, 90.0, gravity=(0.0, 0.0, -1.0))
    publish_anchored(store.open("room"), anchored, maps, force=False)
    rooms = [("room", SITE_FROM_ROOM), ("study", SITE_FROM_STUDY)]
    publish_set(store, "site", rooms, quiet)
    with serve(maps) as doors, Client(doors.url) as client:
        there = client.localize(in_study[0][0], "site", in_study[0][1]).geopose
        assert there is not None
        about_room = Near(45.2178, 5.8083, 5.0)
        about_study = Near(there.latitude, there.longitude, 5.0)
        both = client.map("site").place
        assert both is not None

        assert client.localize(query.image, about_room, query.camera).pose is not None
        for photo, near, tile in (
            (query.image, about_study, "study"),
            (in_study[0][0], about_room, "room"),
        ):
            found = client.localize(photo, near, query.camera)
            assert (found.map.id, found.pose) == ("site", None)
            assert (found.tile or "").startswith(f"{tile}@")
            sent = instants([photo], query.camera)
            assert told(client, sent, near) == [("not_localized", tile)]
        everywhere = Near(both.latitude, both.longitude, both.radius)
        assert client.localize(in_study[0][0], everywhere, query.camera).pose is not None
        # The circle about both holds it, yet it lies between them.
        between = Near(both.latitude, both.longitude, 5.0)
        assert [info.id for info in client.maps(between)] == []
        with pytest.raises(NotFound) as nothing:
            client.localize(query.image, between, query.camera)
        assert nothing.value.code == "map.none_near"


def test_a_sequence_changes_tiles_only_where_its_odometry_has_it(
    client: Client, queries: list[Any], in_study: list[Any]
) -> None:
    here, there = queries[0].image, in_study[0][0]
    # In the frame of the set, from one room to the other; both are metric.
    room = SITE_FROM_ROOM.move(queries[0].cam_from_world)
    study = SITE_FROM_STUDY.move(in_study[0][2])
    still = Pose.identity()
    for moved, expected in (
        (still, ["room"] * 4),
        (study @ room.inverse(), ["room", "room", "study", "room"]),
    ):
        # Three that agree overrule one.
        poses = [still, still, moved, still]
        sent = [
            Instant(
                START + 100 * i,
                (RigImage("camera", photo, queries[0].camera),),
                odometry=Odometry(pose),
            )
            for i, (photo, pose) in enumerate(zip([here, here, there, here], poses, strict=True))
        ]
        assert [tile for _, tile in told(client, sent, "site")] == expected


def test_odometry_that_a_map_does_not_take_is_refused_before_any_work(
    site_copy: Path, serve: Serve, query: Any
) -> None:
    manifest = MapStore(site_copy).folder("room") / "manifest.json"
    known = json.loads(manifest.read_text())
    known["world"]["metric"] = False
    manifest.write_text(json.dumps(known))
    sent = instants([query.image] * 2, query.camera)
    sent[1] = replace(sent[1], odometry=Odometry(Pose.identity()))
    with serve(site_copy) as doors, Client(doors.url) as client:
        assert told(client, sent, "room") == [("error", "sequence.odometry")]


def test_an_instant_that_shows_nothing_is_filled_in_the_tile_beside_it(
    site_copy: Path, serve: Serve, queries: list[Any]
) -> None:
    camera = queries[0].camera
    _, blank = cv2.imencode(".png", np.zeros((64, 64), np.uint8))
    (site_copy / "study").rename(site_copy / "away")
    with serve(site_copy) as doors, Client(doors.url) as client:
        for nothing in (b"no photo", blank.tobytes()):
            sent = instants([queries[0].image, nothing, queries[1].image], camera)
            assert [status for status, _ in told(client, sent, "room")] == [
                "localized",
                "filled",
                "localized",
            ]
            assert told(client, sent, "site") == [
                ("localized", "room"),
                ("filled", "room"),
                ("localized", "room"),
            ]


def test_a_tile_that_is_away_does_not_end_a_sequence_elsewhere(
    site_copy: Path, serve: Serve, queries: list[Any], in_study: list[Any]
) -> None:
    (site_copy / "study").rename(site_copy / "away")
    photos = [queries[0].image, in_study[0][0], queries[1].image]
    with serve(site_copy) as doors, Client(doors.url) as client:
        found = told(client, instants(photos, queries[0].camera), "site")
    assert found == [("localized", "room"), ("filled", "room"), ("localized", "room")]


def test_answers_outlive_an_error_of_a_later_instant(
    client: Client,
    query: Any,
    in_study: list[Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search, searched = SequenceInSet._searched, list[Any]()

    async def fourth_fails(self: SequenceInSet, *asked: Any) -> Any:
        searched.append(asked)
        if len(searched) == 4:
            raise Unavailable("server.worker_died", "died")
        return await search(self, *asked)

    monkeypatch.setattr(SequenceInSet, "_searched", fourth_fails)
    photos = [query.image, b"no photo", b"no photo", in_study[0][0]]
    found = told(client, instants(photos, query.camera), "site")
    assert [tile for _, tile in found[:3]] == ["room"] * 3
    assert found[3] == ("error", "server.worker_died")


def test_a_sequence_may_begin_outside_the_set(client: Client, query: Any) -> None:
    outside = Priors(position=PositionPrior(np.array([900.0, 0, 0]), 1.0))
    sent = [
        Instant(
            START + 100 * i,
            (RigImage("camera", query.image, query.camera),),
            priors=outside if i == 0 else None,
        )
        for i in range(2)
    ]
    first, second = client.localize_sequence(sent, "site")
    assert first.refusal is not None
    assert (first.status, first.refusal.reason) == ("not_localized", "no_photo_near")
    assert second.status == "localized"


def test_a_tile_that_does_not_know_a_rig_leaves_it_to_others(client: Client, sample: Path) -> None:
    dataset = read_dataset(sample / "query")
    first = [r for r in dataset.images if r.timestamp == dataset.images[0].timestamp]
    images = [RigImage(r.sensor_id, dataset.path_of(r).read_bytes()) for r in first]
    assert client.localize_rig(images, "site", "rig").pose is not None
    # What the photos show does not know it.
    found = client.localize_rig(images, "site", "cart")
    assert found.pose is None
    assert (found.tile or "").startswith("study@")
    with pytest.raises(NotFound) as unknown:
        client.localize_rig(images, "site", "bus")
    assert unknown.value.code == "rig.unknown"


def test_a_tile_that_does_not_know_the_rig_ends_no_sequence(
    client: Client, sample: Path, in_study: list[Any]
) -> None:
    dataset = read_dataset(sample / "query")
    first = [r for r in dataset.images if r.timestamp == dataset.images[0].timestamp]
    here = tuple(RigImage(r.sensor_id, dataset.path_of(r).read_bytes()) for r in first)
    there = (RigImage(first[0].sensor_id, in_study[0][0]),)
    sent = [Instant(START + 100 * i, images) for i, images in enumerate([here, there, here])]
    found = list(client.localize_sequence(sent, "site", rig="rig"))
    assert [each.status for each in found] == ["localized", "filled", "localized"]


def test_an_instant_may_name_tiles(client: Client, query: Any, in_study: list[Any]) -> None:
    def sent(photo: bytes, *names: str) -> list[Instant]:
        plain = instants([query.image, photo, query.image], query.camera)
        return [plain[0], replace(plain[1], priors=Priors(maps=names)), plain[2]]

    found = told(client, sent(query.image, "study"), "site")
    assert found == [("localized", "room"), ("filled", "room"), ("localized", "room")]
    assert told(client, sent(query.image, "room"), "site") == [("localized", "room")] * 3
    found = told(client, sent(in_study[0][0], "study"), "site")
    assert found == [("localized", "room"), ("localized", "study"), ("localized", "room")]
    # Before any work: HTTP has all instants at once.
    assert told(client, sent(query.image, "attic"), "site") == [("error", "priors.maps")]


def test_a_tile_in_use_stays_in_service_when_its_deletion_is_refused(
    served: Any, client: Client, site: Path, in_study: list[Any]
) -> None:
    engine = served.server.engine
    version = MapStore(site).current_version("study")
    held, done = threading.Event(), threading.Event()

    async def hold() -> None:
        async with engine._catalog.using((f"study@{version}",)):
            held.set()
            await asyncio.to_thread(done.wait)

    asyncio.run_coroutine_threadsafe(hold(), engine._following.get_loop())
    assert held.wait(60)
    image, camera, _ = in_study[0]
    try:
        with ThreadPoolExecutor(1) as pool:
            deletion = pool.submit(client.delete_version, "study", version)
            while not deletion.done():
                assert client.localize(image, "site", camera).pose is not None
    finally:
        done.set()
    refused = deletion.exception()
    assert isinstance(refused, Conflict)
    assert refused.code == "map.in_set"


def test_photos_that_wait_for_a_set_are_counted(site: Path, serve: Serve, query: Any) -> None:
    sent = 8
    with serve(site, workers=1) as doors:

        def ask() -> bool:
            with Client(doors.url) as client:
                return client.localize(query.image, "site", query.camera).pose is not None

        (process,) = doors.server.engine.workers.pids
        with ThreadPoolExecutor(sent) as pool:
            os.kill(process, signal.SIGSTOP)
            try:
                answers = [pool.submit(ask) for _ in range(sent)]
                most = 0
                while most < sent and not all(answer.done() for answer in answers):
                    most = max(most, busy(state_of(doors)))
            finally:
                os.kill(process, signal.SIGCONT)
            assert most == sent
            assert all(answer.result() for answer in answers)
        assert state_of(doors).photos_waiting == 0


def test_a_version_that_a_set_names_stays_open_when_another_takes_over(
    site_copy: Path, serve: Serve, query: Any
) -> None:
    before = f"room@{MapStore(site_copy).current_version('room')}"
    copy_map(site_copy, "room", "room", "v2")
    with serve(site_copy) as doors, Client(doors.url) as client:
        engine = doors.server.engine
        client.localize(query.image, "room", query.camera)  # by its own name, too
        client.use_version("room", "v2")
        wait_until(lambda: not engine._catalog._background)
        assert {before, "room@v2"} <= engine.workers.loaded.keys()
        assert client.localize(query.image, "site", query.camera).tile == before

        # Also in a process that takes the place of another.
        (process,) = engine.workers.pids
        os.kill(process, signal.SIGKILL)
        wait_until(lambda: engine.workers.pids not in ((process,), (0,), ()))
        client.localize(query.image, "room", query.camera)  # when it is ready
        wait_until(lambda: {before, "room@v2"} <= engine.workers.loaded.keys())  # while idle


def test_the_versions_that_sets_name_are_opened_at_the_start(site_copy: Path, serve: Serve) -> None:
    named = {f"{name}@{MapStore(site_copy).current_version(name)}" for name in ("room", "study")}
    for name in ("room", "study"):
        copy_map(site_copy, name, name, "v2")
        (site_copy / name / "current").write_text("v2")
    with serve(site_copy) as doors:
        loaded = doors.server.engine.workers.loaded.keys()
    assert named <= loaded
    assert not {"room@v2", "study@v2"} & loaded


def test_tiles_of_a_set_that_was_replaced_are_closed(
    site_copy: Path, serve: Serve, query: Any
) -> None:
    store = MapStore(site_copy)
    room, study = (f"{name}@{store.current_version(name)}" for name in ("room", "study"))
    before = f"site@{store.current_version('site')}"
    with serve(site_copy) as doors, Client(doors.url) as client:
        engine = doors.server.engine
        assert {room, study} <= engine.workers.loaded.keys()
        publish_set(store, "site", [("room", SITE_FROM_ROOM)], quiet)
        wait_until(lambda: before not in engine.workers.loaded)
        wait_until(lambda: not engine._catalog._background)
        assert room in engine.workers.loaded  # of the new set
        assert study not in engine.workers.loaded
        assert study not in {version.ref for version in engine._catalog.known}
        assert client.localize(query.image, "site", query.camera).tile == room
        # Of a set that was deleted, too.
        assert "copy@v1" in engine.workers.loaded
        client.delete_version("twice", store.current_version("twice"))
        wait_until(lambda: not engine._catalog._background)
        assert room in engine.workers.loaded
        assert "copy@v1" not in engine.workers.loaded


def test_a_tile_of_features_that_are_not_here_is_away(
    client: Client, query: Any, in_study: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    using = Catalog.using

    @asynccontextmanager
    async def not_here(self: Catalog, where: Any) -> AsyncIterator[Any]:
        if isinstance(where, tuple) and where[0].startswith("study@"):
            raise Conflict("weights.missing", "there are no weights", field="map")
        async with using(self, where) as maps:
            yield maps

    monkeypatch.setattr(Catalog, "using", not_here)
    assert client.localize(query.image, "site", query.camera).pose is not None
    with pytest.raises(Unavailable) as away:
        client.localize(in_study[0][0], "site", in_study[0][1])
    assert (away.value.code, away.value.got) == ("set.tile_unavailable", "weights.missing")


def test_tiles_of_sets_are_not_read_to_find_what_is_near(site: Path) -> None:
    read = list[str]()

    class Counting(MapStore):
        def outline(self, ref: str) -> MapOutline | SetOutline:
            read.append(ref.partition("@")[0])
            return super().outline(ref)

    room, study = (MapStore(site).current_version(name) for name in ("room", "study"))
    listing = Listing(Counting(site), lambda _: None)
    assert listing.opened_at_start() == (
        *("model", "site", "twice"),
        *(f"room@{room}", f"study@{study}", "copy@v1"),
    )
    read.clear()
    listing._described.clear()
    with pytest.raises(NotFound):
        listing.searched_near(Circle(45.0, 5.0, 10.0))
    assert sorted(read) == ["model", "site", "twice"]
