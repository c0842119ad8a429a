"""The TLS certificate of both transports."""

from __future__ import annotations

import ssl
from typing import TypedDict

import grpc

from service.settings import ServiceSettings, SettingsError


class TlsConfig(TypedDict, total=False):
    """Settings of uvicorn."""

    ssl_certfile: str
    ssl_keyfile: str


def check_tls(settings: ServiceSettings) -> None:
    """Refuse a certificate that cannot be used, before any port is open.

    Raises:
        SettingsError: naming the setting.
    """
    certificate, key = settings.tls_cert, settings.tls_key
    if (certificate is None) != (key is None):
        given, missing = ("tls_key", "tls_cert") if certificate is None else ("tls_cert", "tls_key")
        raise SettingsError(f"{missing}: {given} was given without it; TLS needs both")
    if certificate is None or key is None:
        return
    for name, path in (("tls_cert", certificate), ("tls_key", key)):
        try:
            path.read_bytes()
        except OSError as error:
            raise SettingsError(f"{name}: {path} cannot be read: {error.strerror}") from None
    try:
        # An encrypted key would otherwise ask for its password on the terminal.
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, lambda: b"")
    except (ssl.SSLError, ValueError) as error:
        raise SettingsError(
            f"tls_cert, tls_key: {certificate} and {key} are not a certificate chain and its "
            f"private key, both PEM and not encrypted: {error}"
        ) from None


def tls_config(settings: ServiceSettings) -> TlsConfig:
    """Return the settings for HTTPS; none without a certificate."""
    if settings.tls_cert is None or settings.tls_key is None:
        return {}
    return {"ssl_certfile": str(settings.tls_cert), "ssl_keyfile": str(settings.tls_key)}


def grpc_credentials(settings: ServiceSettings) -> grpc.ServerCredentials | None:
    """Return the credentials for gRPC over TLS; None without a certificate."""
    if settings.tls_cert is None or settings.tls_key is None:
        return None
    pair = (settings.tls_key.read_bytes(), settings.tls_cert.read_bytes())
    return grpc.ssl_server_credentials([pair])
