"""HTTP, gRPC and the engine behind them, in one event loop."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.descriptors import METRICS_CONNECTIONS
from service.engine.engine import Engine
from service.engine.stores import open_store
from service.grpc.server import GrpcServer
from service.http.app import create_app
from service.http.arrivals import Arrivals
from service.http.envelope import Backend
from service.http.health import metrics_app
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
# Largest head of a request: several times what the longest keys and ids need.
_MAX_HEAD_BYTES = 16 * 1024
# Connections that wait to be accepted. asyncio tries as many times in a row when files run out.
_BACKLOG = 512


class Server:
    """Listens once constructed, answers after ``open``, localizes after ``load``."""

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
            self.state,
        )
        with ExitStack() as opened:
            listener = opened.enter_context(_listen(settings, settings.http_port))
            app = create_app(self.backend)
            self._http = _HttpServer(app, listener, settings.max_connections, self._certificate)
            self._servers = [self._http]
            self.http_port: int = listener.getsockname()[1]
            self.metrics_port: int | None = None
            if settings.metrics_port is not None:
                listener = opened.enter_context(_listen(settings, settings.metrics_port))
                metrics = metrics_app(self.backend)
                self._servers.append(_HttpServer(metrics, listener, METRICS_CONNECTIONS, None))
                self.metrics_port = listener.getsockname()[1]
            try:
                self._grpc = GrpcServer(
                    self.engine, settings, self.observer, access, self._certificate
                )
            except RuntimeError as error:
                address = f"{settings.host}:{settings.grpc_port}"
                raise OSError(f"cannot listen on {address}: {error}") from None
            opened.pop_all()  # the servers close the sockets from here on
        self.grpc_port = self._grpc.port

    async def open(self) -> None:
        """Answer requests. Until ``load`` is done, /readyz and gRPC's health say not ready."""
        await self._grpc.start()
        self._serving = [asyncio.create_task(server.serve()) for server in self._servers]

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
        for server in self._servers:
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
            connections=len(self._http.server_state.connections),
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
    """uvicorn on a socket that already listens.

    Args:
        max_connections: limit of open connections; further ones are closed at once.
        certificate: for TLS; None for plain HTTP.
    """

    def __init__(
        self,
        app: Starlette,
        listener: socket.socket,
        max_connections: int,
        certificate: Certificate | None,
    ) -> None:
        class LimitedProtocol(H11Protocol):
            def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
                super().connection_made(transport)
                if len(self.connections) > max_connections:
                    transport.abort()

        super().__init__(
            uvicorn.Config(
                app,
                log_config=None,
                log_level="error",  # its warnings are of callers' mistakes, one line for each
                access_log=False,
                ws="none",
                proxy_headers=False,  # any local process could forge them
                http=LimitedProtocol,
                backlog=_BACKLOG,
                h11_max_incomplete_event_size=_MAX_HEAD_BYTES,
                ssl_context_factory=None
                if certificate is None
                else lambda *_: certificate.server_context(),
            )
        )
        self._listener = listener

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer requests until ``should_exit``."""
        del sockets
        await super().serve([self._listener])

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept no more connections, and return when all requests have ended."""
        await asyncio.sleep(_LAST_WORDS_S)
        await super().shutdown(sockets)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals to ``main``, because they end gRPC too."""
        yield


def _listen(settings: ServiceSettings, port: int) -> socket.socket:
    host = settings.host
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise OSError(f"cannot listen on {host}:{port}: {error}") from None
    # Connections inherit these options. asyncio sets TCP_NODELAY only on sockets made with TCP's
    # protocol number, which create_server does not do. Without it, every later answer on a
    # connection waits 40 ms for an acknowledgement.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # The system then closes connections of clients that are gone, or take nothing of an answer.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    patience_ms = round(1000 * settings.arrival_timeout_s)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, patience_ms)
    return listener


def _open_store(settings: ServiceSettings) -> MapStore:
    try:
        return open_store(settings.maps_dir, settings.cache_dir, settings.max_cache_bytes)
    except ValueError as error:
        raise SettingsError(f"maps_dir: {error}") from None
