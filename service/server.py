"""Both doors and the engine behind them, in one event loop."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn

from service.engine import Engine
from service.grpc import GrpcServer
from service.http import create_app
from service.settings import ServiceSettings
from visloc.archive import MapStore
from visloc.images import ImageLimits


class Server:
    """Listens as soon as it is made, answers after ``open``, localizes after ``load``.

    Attributes:
        engine: what is behind the doors.
        http_port: where HTTP listens.
        grpc_port: where gRPC listens.

    Raises:
        OSError: when an address cannot be listened on.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        self.engine = Engine(
            MapStore(settings.maps_dir),
            weights_dir=settings.weights_dir,
            workers=settings.workers,
            threads_per_worker=settings.threads_per_worker,
            max_queue=settings.max_queue,
            max_batches=settings.max_batches,
            max_rig_images=settings.max_rig_images,
            max_instants=settings.max_instants,
            limits=ImageLimits(settings.max_image_bytes, settings.max_image_pixels),
        )
        self._listener = _listen(settings.host, settings.http_port)
        self.http_port: int = self._listener.getsockname()[1]
        try:
            self._grpc = GrpcServer(self.engine, settings)
        except RuntimeError as error:
            self._listener.close()
            address = f"{settings.host}:{settings.grpc_port}"
            raise OSError(f"cannot listen on {address}: {error}") from None
        self.grpc_port = self._grpc.port
        self._http = _HttpServer(
            uvicorn.Config(
                create_app(self.engine, settings),
                log_config=None,
                log_level="warning",
                access_log=False,
                limit_concurrency=settings.max_requests + 1,  # uvicorn refuses the one that fills
            )
        )

    async def open(self) -> None:
        """Answer. Before ``load`` is done, /readyz and gRPC's health say that it is not ready."""
        await self._grpc.start()
        self._http_task = asyncio.create_task(self._http.serve(sockets=[self._listener]))

    async def load(self) -> None:
        """Open the maps, warm up, and accept photos."""
        await self.engine.start()
        await self._grpc.set_serving()

    async def close(self, grace_s: float) -> None:
        """Accept nothing new, and give running requests ``grace_s`` seconds to end."""
        self._http.config.timeout_graceful_shutdown = int(grace_s)
        self._http.should_exit = True
        await asyncio.gather(self._grpc.stop(grace_s), self._http_task)
        await asyncio.to_thread(self.engine.close)


class _HttpServer(uvicorn.Server):
    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield  # signals end both doors: they are the business of main


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=2048)
    except OSError as error:
        raise OSError(f"cannot listen on {host}:{port}: {error}") from None
