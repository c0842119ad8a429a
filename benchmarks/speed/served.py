"""Our default path as users have it: a service process, asked over HTTP by ``localize``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from benchmarks.reliability.service_process import free_port
from benchmarks.speed.building import MAP_ID
from benchmarks.speed.dataset import Bench

CONCURRENCIES = (1, 8)
_READY_WITHIN_S = 300.0


def ask_service(bench: Bench, maps_dir: Path, seed: int) -> dict[str, Any]:
    """Start a service, ask it all queries at each concurrency; the reports of ``localize``."""
    reports = {}
    with service(bench, maps_dir) as url:
        _localize(bench, url, 1, seed)  # the first answers of a process are slower
        for concurrency in CONCURRENCIES:
            reports[str(concurrency)] = _localize(bench, url, concurrency, seed)
    return reports


def _localize(bench: Bench, url: str, concurrency: int, seed: int) -> dict[str, Any]:
    report = bench.work / "report.json"
    command = [sys.executable, "-m", "clients", "benchmark", str(bench.query), "--map", MAP_ID]
    command += ["--server", url, "--report", str(report)]
    command += ["--concurrency", str(concurrency), "--seed", str(seed)]
    subprocess.run(command, check=True, capture_output=True, env=_environment())
    figures: dict[str, Any] = json.loads(report.read_text())
    return figures


@contextmanager
def service(bench: Bench, maps_dir: Path, settings: Sequence[str] = ()) -> Iterator[str]:
    """Run the service and yield its URL. Settings that are not given have their defaults."""
    port, log = free_port(), bench.work / "service.log"
    command = [sys.executable, "-m", "service", "--maps-dir", str(maps_dir)]
    command += ["--http-port", str(port), "--grpc-port", "0", *settings]
    if bench.weights_dir is not None:
        command += ["--weights-dir", str(bench.weights_dir)]
    with log.open("wb") as file:
        process = subprocess.Popen(command, stderr=file, env=_environment())
    try:
        _wait_until_ready(process, f"http://127.0.0.1:{port}", log)
        yield f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(60)


def _wait_until_ready(process: subprocess.Popen[bytes], url: str, log: Path) -> None:
    end = time.monotonic() + _READY_WITHIN_S
    while time.monotonic() < end and process.poll() is None:
        try:
            if httpx.get(f"{url}/readyz", timeout=5).status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.2)
    raise RuntimeError(f"the service does not come up:\n{log.read_text()[-3000:]}")


def _environment() -> dict[str, str]:
    """This process's variables without settings of services that run here."""
    return {name: value for name, value in os.environ.items() if not name.startswith("VISLOC_")}
