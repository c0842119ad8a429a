"""The service as its own process, as users start it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Without the settings of whoever runs the tests.
ENVIRONMENT = {name: value for name, value in os.environ.items() if "VISLOC" not in name}
READY = re.compile(r"ready: (http://127\.0\.0\.1:\d+) ")


@contextmanager
def serving(maps_dir: Path, log: Path, *arguments: str) -> Iterator[str]:
    """Run the service on free ports; its URL.

    Args:
        maps_dir: its maps.
        log: a file to write.
        arguments: more of the command line.
    """
    command = [
        sys.executable,
        "-m",
        "service",
        "--maps-dir",
        str(maps_dir),
        "--workers=1",
        *arguments,
    ]
    ports = ["--http-port=0", "--grpc-port=0", "--threads-per-worker=1"]
    with (
        log.open("wb") as stderr,
        subprocess.Popen([*command, *ports], stderr=stderr, env=ENVIRONMENT) as process,
    ):
        try:
            deadline = time.monotonic() + 60
            while (ready := READY.search(log.read_text())) is None:
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < deadline, log.read_text()
                time.sleep(0.05)
            yield ready[1]
        finally:
            process.kill()
