"""The service with maps at URLs."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from clients import Client
from tests.service.rooms import busy, state_of, wait_until
from visloc.archive import MapStore
from visloc.priors import Priors
from visloc_extensions.object_storage.remote_store import RemoteMapStore

Serve = Callable[..., AbstractContextManager[Any]]


def test_tiles_of_a_remote_store_are_fetched_when_they_are_searched(
    site: Path, serve: Serve, query: Any, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    room, study = (MapStore(site).current_version(name) for name in ("room", "study"))

    def fetched() -> set[str]:
        return {path.parent.name for path in cache.rglob("manifest.json")}

    # Little room: the sets come first, their tiles when they are asked for.
    settings = {"cache_dir": cache, "max_loaded_bytes": 1}
    with serve(f"file://{site}", **settings) as doors, Client(doors.url) as client:
        assert not fetched() & {room, study}
        for _ in range(2):
            found = client.localize(query.image, "site", query.camera)
            assert found.pose is not None
            assert found.tile == f"room@{room}"
        assert room in fetched()


def test_a_tile_that_is_being_fetched_holds_up_no_other_set(
    site: Path,
    serve: Serve,
    query: Any,
    in_study: list[Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fetch, asked, arrives = RemoteMapStore.folder, threading.Event(), threading.Event()

    def slow(self: RemoteMapStore, ref: str) -> Path:
        if ref.startswith("study@"):
            asked.set()
            assert arrives.wait(60)
        return fetch(self, ref)

    monkeypatch.setattr(RemoteMapStore, "folder", slow)
    settings = {"cache_dir": tmp_path / "cache", "max_loaded_bytes": 1}
    image, camera, _ = in_study[0]
    with serve(f"file://{site}", workers=1, **settings) as doors:

        def ask() -> Any:
            with Client(doors.url) as client:
                return client.localize(image, "site", camera).tile

        with ThreadPoolExecutor(4) as pool, Client(doors.url) as client:
            # More than there is room for in memory.
            answers = [pool.submit(ask) for _ in range(4)]
            assert asked.wait(60)
            wait_until(lambda: doors.server.engine.photos == 4 and not busy(state_of(doors)))
            here = Priors(maps=("room",))
            assert client.localize(query.image, "site", query.camera, priors=here).pose is not None
            assert not any(answer.done() for answer in answers)
            arrives.set()
            assert all(answer.result().startswith("study@") for answer in answers)


def test_maps_of_a_remote_store_are_fetched_and_fetched_again_when_their_copy_went(
    maps_dir: Path, tmp_path: Path, serve: Serve
) -> None:
    cache = tmp_path / "cache"
    with serve(f"file://{maps_dir}", cache_dir=cache, load=False) as doors:
        first = doors.http.get("/maps/room/points")
        assert first.status_code == 200
        (folder,) = {path.parent for path in cache.rglob("landmarks.npy")}
        shutil.rmtree(folder)
        again = doors.http.get("/maps/room/points")
        assert again.content == first.content
        assert doors.http.get("/maps/room/images").status_code == 200
    assert folder.is_dir()
