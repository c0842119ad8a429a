"""Names on the wire besides the messages: headers, media types, patterns."""

from __future__ import annotations

import re

# Names a request in the logs; over gRPC it is a field of the request.
REQUEST_ID_HEADER = "X-Request-ID"
REQUEST_ID = re.compile(r"[\x21-\x7e]{1,128}")
# How many seconds an HTTP caller waits; gRPC has deadlines.
TIMEOUT_HEADER = "X-Request-Timeout"
NDJSON = "application/x-ndjson"
# The server's version goes with every answer over gRPC, as a header.
VERSION_KEY = "visloc-version"
# Of the ErrorInfo that an error over gRPC carries.
ERROR_DOMAIN = "visloc"
