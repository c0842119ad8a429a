"""The gRPC server."""

from __future__ import annotations

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from service.engine.engine import Engine
from service.grpc.access import AccessInterceptor
from service.grpc.arrivals import TimelyCalls
from service.grpc.envelope import Envelope
from service.grpc.localization import LocalizationServicer
from service.grpc.maps import MapsServicer
from service.security.access import Access
from service.security.tls import Certificate
from service.settings import ServiceSettings
from service.telemetry.observer import Observer
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1 import localization_pb2_grpc as pb2_grpc

SERVICE_NAMES = tuple(
    pb2.DESCRIPTOR.services_by_name[name].full_name for name in ("Localization", "Maps")
)
# A connection without a call is closed after this time.
_IDLE_MS = 60_000


class GrpcServer:
    """The server with health and reflection; health says NOT_SERVING at first."""

    def __init__(
        self,
        engine: Engine,
        settings: ServiceSettings,
        observer: Observer,
        access: Access,
        certificate: Certificate | None,
    ) -> None:
        envelope = Envelope(observer)
        patience_s = settings.arrival_timeout_s
        self._server = grpc.aio.server(
            interceptors=[
                AccessInterceptor(access, envelope, max(1, settings.max_connections // 2)),
                TimelyCalls(envelope, patience_s, settings.max_message_bytes),
            ],
            options=[
                ("grpc.max_receive_message_length", settings.max_message_bytes),
                ("grpc.max_allowed_incoming_connections", settings.max_connections),
                # Clients connect again by themselves.
                ("grpc.max_connection_idle_ms", _IDLE_MS),
                # For connections that send nothing, or no HTTP/2 preface.
                ("grpc.server_handshake_timeout_ms", round(1000 * patience_s)),
                ("grpc.so_reuseport", 0),  # a second server on the port is a mistake
                # A robot that loses its network within a stream must not keep its slot.
                ("grpc.keepalive_time_ms", 60_000),
                ("grpc.keepalive_timeout_ms", 20_000),
                ("grpc.http2.max_pings_without_data", 0),
            ],
            maximum_concurrent_rpcs=settings.max_connections,
        )
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined]
        pb2_grpc.add_LocalizationServicer_to_server(
            LocalizationServicer(engine, settings, observer), self._server
        )
        pb2_grpc.add_MapsServicer_to_server(MapsServicer(engine, observer), self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        reflection.enable_server_reflection(
            (*SERVICE_NAMES, health.SERVICE_NAME, reflection.SERVICE_NAME), self._server
        )
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        address = f"{host}:{settings.grpc_port}"
        if certificate is None:
            self.port = self._server.add_insecure_port(address)
        else:
            self.port = self._server.add_secure_port(address, certificate.credentials())

    async def start(self) -> None:
        """Accept calls."""
        await self.set_serving(False)
        await self._server.start()

    async def set_serving(self, serving: bool) -> None:
        """Let health say SERVING or NOT_SERVING."""
        status = health_pb2.HealthCheckResponse
        for name in ("", *SERVICE_NAMES):
            await self._health.set(name, status.SERVING if serving else status.NOT_SERVING)

    async def stop(self, grace_s: float) -> None:
        """Refuse new calls, and give running ones ``grace_s`` seconds to finish."""
        await self._health.enter_graceful_shutdown()
        await self._server.stop(grace_s)
