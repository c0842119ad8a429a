"""The address of a server, the key for it, and the certificates to trust."""

from __future__ import annotations

import re
import ssl
from dataclasses import dataclass, field
from pathlib import Path

from clients.wire.requests import checked_server
from visloc.errors import refuse

_KEY = re.compile(r"[\x21-\x7e]{1,512}")


@dataclass(frozen=True, slots=True)
class Connection:
    """The address of a server, and how to talk to it.

    Attributes:
        server: ``http://``, ``https://``, ``grpc://`` or ``grpcs://``, host and port.
        timeout_s: longest wait for an answer, seconds.
        api_key: sent with every request; never shown.
        authorities: PEM text of the authorities to trust instead of the usual ones.
    """

    server: str
    timeout_s: float
    api_key: str | None = field(default=None, repr=False)
    authorities: str | None = field(default=None, repr=False)

    @property
    def is_grpc(self) -> bool:
        return self.server.startswith(("grpc:", "grpcs:"))

    @property
    def is_encrypted(self) -> bool:
        return self.server.startswith(("https:", "grpcs:"))


def checked_connection(
    server: str, timeout_s: float, api_key: str | None, ca: str | Path | None
) -> Connection:
    """Check the arguments of a client, and read the file of certificates."""
    connection = Connection(checked_server(server), timeout_s, api_key, _authorities(ca))
    if api_key is not None and not _KEY.fullmatch(api_key):
        raise refuse("server.api_key", field="api_key")
    if ca is not None and not connection.is_encrypted:
        raise refuse("server.ca", field="ca", got=server)
    return connection


def _authorities(ca: str | Path | None) -> str | None:
    if ca is None:
        return None
    try:
        text = Path(ca).read_text(encoding="ascii")
        ssl.create_default_context(cadata=text)
    except (OSError, ValueError) as error:  # SSLError is an OSError
        raise refuse(
            "server.ca",
            "the file holds no certificates",
            field=str(ca),
            expected="a PEM file",
            got=str(error),
        ) from None
    return text
