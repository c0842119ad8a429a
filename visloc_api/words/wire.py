"""What both sides know of the wire besides its messages: headers, media types, dtypes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

# Names a request in the logs; over gRPC it is a field of the request.
REQUEST_ID_HEADER = "X-Request-ID"
REQUEST_ID = re.compile(r"[\x21-\x7e]{1,128}")
# How many seconds an HTTP caller waits; gRPC has deadlines.
TIMEOUT_HEADER = "X-Request-Timeout"
# Metadata of gRPC too. A balancer that routes by it finds the map already open.
MAP_HEADER = "x-visloc-map"
NDJSON = "application/x-ndjson"
# The server's version goes with every answer over gRPC, as a header.
VERSION_KEY = "visloc-version"
# The domain of the ErrorInfo that an error over gRPC carries.
ERROR_DOMAIN = "visloc"
# Types of arrays; little-endian, where they have more than one byte.
ARRAY_DTYPES: Mapping[str, np.dtype[Any]] = {
    "float32": np.dtype("<f4"),
    "float16": np.dtype("<f2"),
    "uint8": np.dtype("u1"),
    "int8": np.dtype("i1"),
}
