"""Exit 0 when the service in this container is ready, from the same environment as the service.

Flags of the service are not seen here: in a container, settings come from ``VISLOC_`` variables
or the file that ``VISLOC_CONFIG`` names.
"""

from __future__ import annotations

import os
import ssl
import sys
from http.client import HTTPConnection, HTTPException, HTTPSConnection

from service.settings import SettingsError, read_settings

TIMEOUT_S = 4.0
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1"}


def main() -> None:
    """Ask /readyz, and say on stderr what is wrong."""
    try:
        settings = read_settings([], os.environ)
    except SettingsError as error:
        sys.exit(f"healthcheck: {error}")
    host = EVERYWHERE.get(settings.host, settings.host)
    if settings.tls_cert is None:
        connection = HTTPConnection(host, settings.http_port, timeout=TIMEOUT_S)
    else:
        # The certificate names the service as others see it, not this container.
        unverified = ssl.create_default_context()
        unverified.check_hostname = False
        unverified.verify_mode = ssl.CERT_NONE
        connection = HTTPSConnection(
            host, settings.http_port, timeout=TIMEOUT_S, context=unverified
        )
    try:
        connection.request("GET", "/readyz")
        status = connection.getresponse().status
    except (OSError, HTTPException) as error:
        sys.exit(f"healthcheck: no answer from {host}:{settings.http_port}: {error}")
    if status != 200:
        sys.exit(f"healthcheck: /readyz answered {status}")


if __name__ == "__main__":
    main()
