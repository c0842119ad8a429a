"""Both doors on real sockets."""

from __future__ import annotations

import asyncio
import shutil
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import grpc
import httpx
import pytest

from service.server import Server
from service.settings import ServiceSettings
from visloc_api.v1.localization_pb2_grpc import LocalizationStub

T = TypeVar("T")


@dataclass(frozen=True)
class Doors:
    """A running service."""

    server: Server
    http: httpx.Client
    channel: grpc.Channel
    stub: LocalizationStub

    @property
    def url(self) -> str:
        return str(self.http.base_url)


@contextmanager
def serving(maps_dir: Path, *, load: bool = True, **settings: object) -> Iterator[Doors]:
    """Run both doors in a thread of their own, on free ports."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    def run(coroutine: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(coroutine, loop).result(60)

    async def make() -> Server:
        return Server(
            ServiceSettings(
                maps_dir=maps_dir,
                http_port=0,
                grpc_port=0,
                **{"workers": 1, "threads_per_worker": 1, **settings},
            )
        )

    try:
        server = run(make())
        run(server.open())
        try:
            if load:
                run(server.load())
            with (
                httpx.Client(base_url=f"http://127.0.0.1:{server.http_port}", timeout=60) as http,
                grpc.insecure_channel(f"127.0.0.1:{server.grpc_port}") as channel,
            ):
                yield Doors(server, http, channel, LocalizationStub(channel))
        finally:
            run(server.close(5))
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@pytest.fixture(scope="session")
def doors(built_maps: Path) -> Iterator[Doors]:
    """The service with the map ``room``."""
    limits = {
        "max_image_bytes": 200_000,
        "max_image_pixels": 1_000_000,
        "max_batch_bytes": 600_000,
        "max_rig_images": 3,
        "max_instants": 20,
    }
    with serving(built_maps, **limits) as doors:
        yield doors


@pytest.fixture(scope="session")
def serve() -> Callable[..., AbstractContextManager[Doors]]:
    """``with serve(maps_dir, **settings) as doors``: a service of the test's own."""
    return serving


@pytest.fixture(scope="session")
def anchored_maps(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map ``room``, tied to the Earth."""
    from tests.service.anchored import write_anchored

    maps = tmp_path_factory.mktemp("anchored") / "maps"
    write_anchored(built_maps, maps)
    return maps


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of another room than the sample's."""
    from tests.service.rooms import write_study

    folder = tmp_path_factory.mktemp("study")
    write_study(folder)
    return folder


@pytest.fixture(scope="session")
def two_rooms(built_maps: Path, study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps ``room`` and ``study``; only to be read."""
    from tests.service.rooms import add_study

    maps = Path(shutil.copytree(built_maps, tmp_path_factory.mktemp("two_rooms") / "maps"))
    add_study(study, maps)
    return maps


@pytest.fixture(scope="session")
def upright_room(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``room``, with features that do not know a turned photo."""
    from tests.service.rooms import build_upright

    maps = tmp_path_factory.mktemp("upright_room")
    build_upright(sample, "room", maps)
    return maps


@pytest.fixture(scope="session")
def in_study(study: Path) -> list[Any]:
    """Photos of the other room with their cameras and poses."""
    from tests.service.rooms import photos_of

    return photos_of(study)
