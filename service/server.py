"""HTTP, gRPC and the engine behind them, in one event loop."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette

from service.descriptors import METRICS_CONNECTIONS
from service.engine.engine import Engine
from service.engine.stores import open_store
from service.grpc.server import GrpcServer
from service.http.acceptor import Acceptor, OpenConnections, Patient
from service.http.app import create_app
from service.http.envelope import Backend
from service.http.health import metrics_app
from service.http.slow_clients import Arrivals, http_protocol
from service.security.access import open_access
from service.security.tls import Certificate, open_certificate
from service.settings import ServiceSettings, SettingsError
from service.telemetry.logs import configure_logging
from service.telemetry.metrics import Metrics, ServiceState
from service.telemetry.observer import Observer
from service.telemetry.tracing import open_spans
from service.values import WorkerSettings
from visloc.archive import MapStore
from visloc.options import Inference

# When the server stops: the time in which requests that are already on their way, over open or new
# connections, still get an answer, 503. After it, idle connections are closed.
_LAST_WORDS_S = 0.3


class Server:
    """Listens once constructed, answers after ``open``, localizes after ``load``.

    Raises:
        OSError: when an address cannot be listened on.
        SettingsError: when a setting cannot be used.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings
        self._certificate = open_certificate(settings)
        if settings.weights_dir is not None and not settings.weights_dir.is_dir():
            raise SettingsError(f"weights_dir: {settings.weights_dir} is no folder")
        access = open_access(settings)
        self._store = _open_store(settings)
        self._spans = open_spans(settings)
        self.observer = Observer(Metrics(), self._spans)
        self.engine = _make_engine(settings, self._store, self.observer)
        self.backend = Backend(
            self.engine,
            settings,
            self.observer,
            access,
            Arrivals(settings.arrival_timeout_s, settings.max_buffered_bytes),
            OpenConnections(settings.max_connections),
            self.state,
        )
        with ExitStack() as opened:
            listener = opened.enter_context(_listen(settings.host, settings.http_port))
            self._http = [self._http_server(listener)]
            self.http_port: int = listener.getsockname()[1]
            self.metrics_port: int | None = None
            if settings.metrics_port is not None:
                listener = opened.enter_context(_listen(settings.host, settings.metrics_port))
                self._http.append(self._metrics_server(listener))
                self.metrics_port = listener.getsockname()[1]
            try:
                self._grpc = GrpcServer(
                    self.engine, settings, self.observer, access, self._certificate
                )
            except RuntimeError as error:
                address = f"{settings.host}:{settings.grpc_port}"
                raise OSError(f"cannot listen on {address}: {error}") from None
            opened.pop_all()  # the acceptors close the sockets from here on
        self.grpc_port = self._grpc.port

    def _http_server(self, listener: socket.socket) -> _HttpServer:
        app, connections = create_app(self.backend), self.backend.connections
        grace_s = self._settings.arrival_timeout_s
        return _HttpServer(app, listener, connections, grace_s, self._certificate)

    def _metrics_server(self, listener: socket.socket) -> _HttpServer:
        app, connections = metrics_app(self.backend), OpenConnections(METRICS_CONNECTIONS)
        return _HttpServer(app, listener, connections, self._settings.arrival_timeout_s, None)

    async def open(self) -> None:
        """Answer requests. Until ``load`` is done, /readyz and gRPC's health say not ready."""
        await self._grpc.start()
        self._serving = [asyncio.create_task(server.serve()) for server in self._http]

    async def load(self) -> None:
        """Open the maps, warm up, and accept photos."""
        await self.engine.start()
        await self._grpc.set_serving(True)

    async def close(self, grace_s: float) -> None:
        """Stop: for ``drain_delay_s`` only readiness says so, then new requests are refused.

        Running requests get ``grace_s`` seconds to finish.
        """
        self.engine.withdraw()
        await self._grpc.set_serving(False)
        await asyncio.sleep(self._settings.drain_delay_s)
        self.engine.drain()
        for server in self._http:
            server.config.timeout_graceful_shutdown = max(1, int(grace_s))
            server.should_exit = True
        await asyncio.gather(self._grpc.stop(grace_s), *self._serving)
        await self.engine.close()
        if self._spans is not None:
            await asyncio.to_thread(self._spans.close)

    def state(self) -> ServiceState:
        """Return the current state for the metrics."""
        engine, workers, settings = self.engine, self.engine.workers, self._settings
        status = engine.status
        loaded = {
            (ref.partition("@")[0], ref.partition("@")[2]): size
            for ref, size in workers.loaded.items()
        }
        remote = "://" in settings.maps_dir
        return ServiceState(
            status.ready,
            draining=engine.draining,
            photos_waiting=engine.waiting,
            max_queue=settings.max_queue,
            photos_running=workers.running,
            batches_running=engine.batches,
            max_batches=settings.max_batches,
            workers=workers.count,
            worker_pids=workers.pids,
            loaded_maps=loaded,
            max_loaded_bytes=settings.max_loaded_bytes,
            unusable_maps={map_id: error.code for map_id, error in status.not_loaded.items()},
            connections=len(self.backend.connections),
            max_connections=settings.max_connections,
            store_reachable=self._store.reachable,
            buffered_bytes=self.backend.arrivals.bytes_held,
            max_buffered_bytes=settings.max_buffered_bytes,
            certificate_ends=None if self._certificate is None else self._certificate.ends,
            folders={"cache": settings.cache_dir} if remote else {"maps": Path(settings.maps_dir)},
        )


def _make_engine(settings: ServiceSettings, store: MapStore, observer: Observer) -> Engine:
    worker = WorkerSettings(
        weights_dir=settings.weights_dir,
        inference=Inference(settings.inference),
        threads=settings.threads_per_worker,
        max_loaded_bytes=settings.max_loaded_bytes,
        max_images=settings.max_rig_images,
        max_instants=settings.max_instants,
        max_image_bytes=settings.max_image_bytes,
        max_image_pixels=settings.max_image_pixels,
        configure_logging=partial(configure_logging, settings),
    )
    return Engine(
        store,
        worker,
        workers=settings.workers,
        max_queue=settings.max_queue,
        max_batches=settings.max_batches,
        max_upload_bytes=settings.max_upload_bytes,
        limit_s=settings.request_timeout_s,
        metrics=observer.metrics,
        on_overdue=observer.worker_ended,
    )


class _HttpServer(uvicorn.Server):
    """uvicorn with connections from an ``Acceptor``.

    Args:
        app: answers.
        listener: the listening socket.
        connections: at most so many, and not too slow.
        grace_s: the longest TLS handshake, head, or body of a refused request.
        certificate: for TLS; None for plain HTTP.
    """

    def __init__(
        self,
        app: Starlette,
        listener: socket.socket,
        connections: OpenConnections,
        grace_s: float,
        certificate: Certificate | None,
    ) -> None:
        super().__init__(
            uvicorn.Config(
                Patient(app, connections),
                log_config=None,
                log_level="error",  # its warnings are of callers' mistakes, one line for each
                access_log=False,
                ws="none",
                proxy_headers=False,  # any local process could forge them
                http=http_protocol(grace_s, connections),
            )
        )
        self._listener = listener
        self._open = connections
        self._grace_s = grace_s
        self._certificate = certificate

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        del sockets
        await super().startup(sockets=[])  # uvicorn itself listens nowhere
        certificate = self._certificate
        context = None if certificate is None else lambda: certificate.context
        self._acceptor = Acceptor(
            self._listener, self._open, self._make_protocol, context, self._grace_s
        )

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept no more connections, and return when all requests have ended."""
        del sockets
        await asyncio.sleep(_LAST_WORDS_S)
        self._acceptor.close()
        await asyncio.sleep(_LAST_WORDS_S)  # for the last ones that it accepted
        self._open.close_unopened()  # uvicorn does not know them yet
        await super().shutdown()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals to ``main``, because they end gRPC too."""
        yield

    def _make_protocol(self) -> Any:
        return self.config.http_protocol_class(  # type: ignore[call-arg]
            config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=2048)
    except OSError as error:
        raise OSError(f"cannot listen on {host}:{port}: {error}") from None
    # Connections inherit it. asyncio sets it only on sockets made with TCP's protocol number, which
    # create_server does not do. Without it, every later answer on a connection waits 40 ms for an
    # acknowledgement.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def _open_store(settings: ServiceSettings) -> MapStore:
    try:
        return open_store(settings.maps_dir, settings.cache_dir, settings.max_cache_bytes)
    except ValueError as error:
        raise SettingsError(f"maps_dir: {error}") from None
