"""The TLS certificate of both transports, read again when its files change."""

from __future__ import annotations

import logging
import re
import ssl
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from time import time

import grpc

from service.settings import ServiceSettings, SettingsError

logger = logging.getLogger(__name__)

_PEM = re.compile(rb"-----BEGIN CERTIFICATE-----.*?-----END CERTIFICATE-----", re.DOTALL)
# Tags of ASN.1.
_VERSION, _UTC_TIME = 0xA0, 0x17


@dataclass(frozen=True, slots=True)
class _Pair:
    """A chain of certificates and its private key, as one state of the files.

    Attributes:
        ends: when the first certificate of the chain expires, seconds since 1970.
    """

    ends: float
    chain: bytes
    key: bytes
    context: ssl.SSLContext


class Certificate:
    """The service's certificate. New connections get that which is in the files by then.

    If changed files cannot be used, such as while only one of both is new, that is logged and the
    old certificate stays in use.
    """

    def __init__(self, chain: Path, key: Path) -> None:
        self._files = (chain, key)
        self._seen = _version_of(self._files)
        self._pair = _read(self._files)
        if self._pair.ends < time():
            logger.error("the certificate in %s has expired: clients refuse it", chain)

    @property
    def ends(self) -> float:
        """When the first certificate of the chain expires, seconds since 1970."""
        return self._now().ends

    @property
    def context(self) -> ssl.SSLContext:
        """The context for a new HTTPS connection."""
        return self._now().context

    def server_context(self) -> ssl.SSLContext:
        """Return the context of an HTTPS server, which gives new connections that of then."""

        def renew(connection: ssl.SSLObject, name: str | None, first: ssl.SSLContext) -> None:
            del name, first
            connection.context = self.context

        context = self.context
        context.sni_callback = renew
        return context

    def credentials(self) -> grpc.ServerCredentials:
        """Return credentials for gRPC that ask for the certificate with every connection."""
        sent = self._pair

        def changed() -> grpc.ServerCertificateConfiguration | None:
            nonlocal sent
            pair = self._now()
            if pair is sent:
                return None
            sent = pair
            return _for_grpc(pair)

        # Its stubs forget that None means: as before.
        return grpc.dynamic_ssl_server_credentials(
            _for_grpc(sent),
            changed,  # type: ignore[arg-type]
        )

    def _now(self) -> _Pair:
        version = _version_of(self._files)
        if version != self._seen:
            self._seen = version
            try:
                self._pair = _read(self._files)
            except SettingsError as error:
                # The message says all; a stack trace would fill the log of whoever renews slowly.
                logger.error("the certificate was not reloaded: %s", error)  # noqa: TRY400
            else:
                ends = datetime.fromtimestamp(self._pair.ends, UTC)
                logger.info("reloaded the certificate: it is valid until %s", ends.isoformat())
        return self._pair


def open_certificate(settings: ServiceSettings) -> Certificate | None:
    """Read the certificate before any port is open; None without TLS."""
    chain, key = settings.tls_cert, settings.tls_key
    if chain is not None and key is not None:
        return Certificate(chain, key)
    if chain is not None or key is not None:
        given, missing = ("tls_key", "tls_cert") if chain is None else ("tls_cert", "tls_key")
        raise SettingsError(f"{missing}: {given} was given without it; TLS needs both")
    return None


def _read(files: tuple[Path, Path]) -> _Pair:
    contents = []
    for name, path in zip(("tls_cert", "tls_key"), files, strict=True):
        try:
            contents.append(path.read_bytes())
        except OSError as error:
            raise SettingsError(f"{name}: {path} cannot be read: {error.strerror}") from None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        # An encrypted key would otherwise ask for its password on the terminal.
        context.load_cert_chain(*files, lambda: b"")
        certificates = [ssl.PEM_cert_to_DER_cert(pem.decode()) for pem in _PEM.findall(contents[0])]
        ends = min(_end_of(certificate) for certificate in certificates)
    except (OSError, ValueError, IndexError) as error:  # a file may be gone again, too
        raise SettingsError(
            f"tls_cert, tls_key: {files[0]} and {files[1]} are not a certificate chain and its "
            f"private key, both PEM and not encrypted: {error}"
        ) from None
    chain_pem, key_pem = contents
    return _Pair(ends, chain_pem, key_pem, context)


def _for_grpc(pair: _Pair) -> grpc.ServerCertificateConfiguration:
    return grpc.ssl_server_certificate_configuration([(pair.key, pair.chain)])


def _version_of(files: tuple[Path, Path]) -> object:
    return tuple(_stamp_of(path) for path in files)


def _stamp_of(path: Path) -> tuple[int, ...] | None:
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size, stat.st_ino


def _end_of(certificate: bytes) -> float:
    """Return when a certificate expires, seconds since 1970.

    Python's own ``ssl`` tells this only of certificates that it trusts (RFC 5280, section 4.1).
    """
    _, body, _ = _element(certificate)
    _, fields, _ = _element(body)
    if fields[0] == _VERSION:
        _, _, fields = _element(fields)
    for _ in ("serial number", "signature algorithm", "issuer"):
        _, _, fields = _element(fields)
    _, validity, _ = _element(fields)
    _, _, not_after = _element(validity)
    tag, text, _ = _element(not_after)
    year = "%y" if tag == _UTC_TIME else "%Y"
    moment = datetime.strptime(text.decode("ascii"), f"{year}%m%d%H%M%SZ")
    return moment.replace(tzinfo=UTC).timestamp()


def _element(data: bytes) -> tuple[int, bytes, bytes]:
    """Return the tag and the content of the first element of DER, and what follows it."""
    length, start = data[1], 2
    if length & 0x80:
        start += length & 0x7F
        length = int.from_bytes(data[2:start], "big")
    return data[0], data[start : start + length], data[start + length :]
