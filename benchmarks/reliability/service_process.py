"""The service as users start it, in a process of its own, that can be killed and started again."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import httpx

READY_WITHIN_S = 90.0


@dataclass(frozen=True)
class Addresses:
    """The addresses of a service, or of a balancer before several.

    Attributes:
        url: of its HTTP API.
        http_port: the port in it.
        grpc: host and port.
    """

    url: str
    http_port: int
    grpc: str

    @property
    def grpc_port(self) -> int:
        """The port of ``grpc``."""
        return int(self.grpc.rpartition(":")[2])


class ServiceProcess:
    """``python -m service`` on ports that stay the same when it is started again.

    Args:
        maps_dir: folder or URL of maps.
        log: file that its log is appended to.
        host: address of this machine to listen on.
        ports: of HTTP and gRPC; free ones when None.
        before: words before the command, such as ``unshare``'s.
        environment: variables besides this process's own.
        ready_within_s: after which it is taken for broken.
        settings: further settings, by name; None leaves the service's own default.
    """

    def __init__(
        self,
        maps_dir: Path | str,
        log: Path,
        *,
        host: str = "127.0.0.1",
        ports: tuple[int, int] | None = None,
        before: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
        ready_within_s: float = READY_WITHIN_S,
        **settings: object,
    ) -> None:
        self.http_port, self.grpc_port = ports or (free_port(), free_port())
        self._ready_within_s = ready_within_s
        self.url = f"http://{host}:{self.http_port}"
        self.grpc = f"{host}:{self.grpc_port}"
        self.log = log
        given = {
            "maps_dir": maps_dir,
            "host": host,
            "http_port": self.http_port,
            "grpc_port": self.grpc_port,
            "workers": 1,
            "threads_per_worker": 1,
            "log_format": "json",
            **settings,
        }
        flags = [
            f"--{name.replace('_', '-')}={value}"
            for name, value in given.items()
            if value is not None
        ]
        # However the benchmark ends, the service is told to end as well.
        ends_with_us = ("setpriv", "--pdeathsig", "TERM")
        self._command = [*before, *ends_with_us, sys.executable, "-m", "service", *flags]
        own = {name: value for name, value in os.environ.items() if "VISLOC" not in name}
        self._environment = own | dict(environment or {})
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Of the main process."""
        assert self._process is not None
        return self._process.pid

    @property
    def worker_pids(self) -> list[int]:
        """Of the processes that do the vision: the fork server's children."""
        return [pid for child in children_of(self.pid) for pid in children_of(child)]

    @property
    def addresses(self) -> Addresses:
        """Where it is."""
        return Addresses(self.url, self.http_port, self.grpc)

    def start(self) -> None:
        """Begin; the doors may be closed yet."""
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(self._command, stderr=log, env=self._environment)

    def wait_until_ready(self) -> float:
        """Wait for /readyz; the seconds that it took.

        Raises:
            RuntimeError: when it ended, or takes far too long.
        """
        started = time.monotonic()
        end = started + self._ready_within_s
        while not self.is_ready():
            assert self._process is not None
            if self._process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"the service does not come up:\n{self.log.read_text()[-3000:]}")
            time.sleep(0.1)
        return time.monotonic() - started

    def is_ready(self) -> bool:
        """Whether /readyz says so."""
        try:
            return httpx.get(f"{self.url}/readyz", timeout=5).is_success
        except httpx.TransportError:
            return False

    def kill(self) -> None:
        """Kill the main process, as the kernel does when memory is short."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def stop(self) -> None:
        """End it with SIGTERM, or at once when that takes too long."""
        if self._process is None or self._process.poll() is not None:
            return
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(40)
        except subprocess.TimeoutExpired:
            self.kill()

    def resident_bytes(self) -> tuple[int, int]:
        """Resident memory of the main process, and of it with all below it."""
        every = [self.pid, *_descendants_of(self.pid)]
        sizes = [resident_bytes(pid) for pid in every]
        return sizes[0], sum(sizes)

    def proportional_bytes(self) -> int:
        """Resident memory of all its processes; a page that several share counts once."""
        return sum(map(_proportional_bytes, [self.pid, *_descendants_of(self.pid)]))

    def processor_seconds(self) -> float:
        """Processor time that its processes have taken, those that have ended included."""
        return sum(map(_processor_seconds, [self.pid, *_descendants_of(self.pid)]))

    def __enter__(self) -> Self:
        self.start()
        try:
            self.wait_until_ready()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


def children_of(pid: int) -> list[int]:
    """Processes that a process started and that live."""
    try:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
    except FileNotFoundError:
        return []
    found = []
    for task in tasks:
        with suppress(FileNotFoundError):
            found += [int(child) for child in (task / "children").read_text().split()]
    return found


def is_alive(pid: int) -> bool:
    """Whether there is such a process that does something; a zombie does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def resident_bytes(pid: int) -> int:
    """Resident memory of a process; 0 when it has ended."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def peak_resident_bytes(pid: int) -> int:
    """Largest resident memory that a living process has had."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024


def _proportional_bytes(pid: int) -> int:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return 0
    (line,) = (line for line in lines if line.startswith("Pss:"))
    return int(line.split()[1]) * 1024


def _processor_seconds(pid: int) -> float:
    """Of a process and of its children that have ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except FileNotFoundError:
        return 0.0
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def _descendants_of(pid: int) -> Iterator[int]:
    for child in children_of(pid):
        yield child
        yield from _descendants_of(child)
