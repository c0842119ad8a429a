"""Replicas of the service as processes of their own, and the balancer before them.

Each replica has an address of this machine of its own, 127.0.0.1, 127.0.0.2 and so on, and the same
ports, as on machines of their own. A name server tells the balancer which there are.
"""

from __future__ import annotations

import os
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from benchmarks.reliability.service_process import (
    READY_WITHIN_S,
    Addresses,
    ServiceProcess,
    free_port,
)

CONFIG = Path(__file__).resolve().parents[2] / "deploy" / "haproxy" / "haproxy.cfg"
NAME = "replicas.test"


@dataclass(frozen=True)
class Balanced:
    """Replicas and where the balancer takes requests for them.

    Attributes:
        replicas: the processes.
        http: address of the balancer.
        grpc: the same for gRPC.
        status: where it tells about itself.
    """

    replicas: tuple[ServiceProcess, ...]
    http: str
    grpc: str
    status: str

    @property
    def front(self) -> Addresses:
        """Where callers find the balancer."""
        port = int(self.http.rpartition(":")[2])
        return Addresses(self.http, port, self.grpc.removeprefix("grpc://"))

    def serving(self) -> int:
        """How many replicas the balancer sends requests to, over each door."""
        text = httpx.get(f"{self.status}/metrics").text
        states = 'haproxy_server_status{proxy="%s",server="replica%d",state="UP"} 1'
        return min(
            sum(states % (door, number) in text for number in range(1, len(self.replicas) + 1))
            for door in ("http", "grpc")
        )

    def wait_until_serving(self, count: int) -> None:
        """Wait until it sends requests to so many."""
        wait_until(lambda: self.serving() == count)


def wait_until(is_so: Callable[[], bool]) -> None:
    """Wait for something that is going to happen.

    Raises:
        TimeoutError: when it does not.
    """
    end = time.monotonic() + READY_WITHIN_S
    while not is_so():
        if time.monotonic() > end:
            raise TimeoutError("it does not happen")
        time.sleep(0.05)


@contextmanager
def balanced(
    maps_dirs: Sequence[Path | str],
    work: Path,
    environment: Mapping[str, str] | None = None,
    **settings: Any,
) -> Iterator[Balanced]:
    """Run a replica for each folder or URL of maps, and a balancer before them.

    Callers find it at 127.0.0.1, and at ``[::1]`` too.

    Args:
        settings: further settings of the replicas, by name.
    """
    ports = free_port(), free_port()
    addresses = [f"127.0.0.{number}" for number in range(1, len(maps_dirs) + 1)]
    with ExitStack() as stack:
        replicas = []
        for address, maps_dir in zip(addresses, maps_dirs, strict=True):
            replica = ServiceProcess(
                maps_dir,
                work / f"{address}.log",
                host=address,
                ports=ports,
                environment=environment,
                cache_dir=work / f"cache-{address}",
                drain_delay_s=3,
                **settings,
            )
            replica.start()
            stack.callback(replica.stop)
            replicas.append(replica)
        nameserver = stack.enter_context(name_server(addresses))
        http, grpc, status = free_port(), free_port(), free_port()
        log = stack.enter_context((work / "haproxy.log").open("wb"))
        process = subprocess.Popen(
            ["haproxy", "-db", "-f", str(CONFIG)],
            env={
                "PATH": os.environ["PATH"],
                "HTTP_BIND": f"127.0.0.1:{http},[::1]:{http}",
                "GRPC_BIND": f"127.0.0.1:{grpc},[::1]:{grpc}",
                "STATUS_BIND": f"127.0.0.1:{status}",
                "REPLICAS": NAME,
                "MAX_REPLICAS": str(len(addresses)),
                "REPLICA_HTTP_PORT": str(ports[0]),
                "REPLICA_GRPC_PORT": str(ports[1]),
                "NAMESERVER": f"127.0.0.1:{nameserver}",
            },
            stdout=log,
            stderr=log,
        )
        stack.callback(process.wait)
        stack.callback(process.kill)
        for replica in replicas:
            replica.wait_until_ready()
        found = Balanced(
            tuple(replicas),
            f"http://127.0.0.1:{http}",
            f"grpc://127.0.0.1:{grpc}",
            f"http://127.0.0.1:{status}",
        )
        wait_until(lambda: _answers(found.status))
        found.wait_until_serving(len(addresses))
        yield found


def _answers(status: str) -> bool:
    try:
        return httpx.get(f"{status}/healthz").status_code == 200
    except httpx.TransportError:
        return False


@contextmanager
def name_server(addresses: Sequence[str]) -> Iterator[int]:
    """Say that these are the addresses of whatever name is asked for; the port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        thread = threading.Thread(target=_answer_all, args=(server, addresses))
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            server.sendto(b"", server.getsockname())  # the end
            thread.join()


def _answer_all(server: socket.socket, addresses: Sequence[str]) -> None:
    """Answer questions for addresses of version 4, as RFC 1035 has it."""
    while True:
        asked, caller = server.recvfrom(512)
        if not asked:
            return
        end = asked.index(b"\0", 12) + 1  # of the name, which is followed by type and class
        is_v4 = asked[end : end + 2] == b"\0\1"
        found = [socket.inet_aton(address) for address in addresses] if is_v4 else []
        header = asked[:2] + b"\x81\x80\0\1" + len(found).to_bytes(2, "big") + b"\0\0\0\0"
        # The name again (a pointer to the question), type A, class IN, for a second, four bytes.
        answers = b"".join(b"\xc0\x0c\0\1\0\1\0\0\0\1\0\4" + address for address in found)
        server.sendto(header + asked[12 : end + 4] + answers, caller)
