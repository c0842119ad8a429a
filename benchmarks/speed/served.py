"""Our default path as users have it: a service process, asked over HTTP by ``localize``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.reliability.service_process import ServiceProcess
from benchmarks.speed.building import MAP_ID
from benchmarks.speed.dataset import Bench

CONCURRENCIES = (1, 8)
_READY_WITHIN_S = 300.0


def ask_service(bench: Bench, maps_dir: Path, seed: int) -> dict[str, Any]:
    """Start a service, ask it all queries at each concurrency; the reports of ``localize``."""
    reports = {}
    with service(bench, maps_dir) as served:
        report_of(served.url, MAP_ID, bench.query)  # the first answers of a process are slower
        for concurrency in CONCURRENCIES:
            found = report_of(served.url, MAP_ID, bench.query, concurrency, seed)
            reports[str(concurrency)] = found
    return reports


def report_of(
    url: str, map_id: str, query: Path, concurrency: int = 1, seed: int = 0
) -> dict[str, Any]:
    """Ask a service about a dataset; the report of ``localize benchmark``."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "clients", "benchmark", str(query), "--map", map_id]
        command += ["--server", url, "--report", str(report)]
        command += ["--concurrency", str(concurrency), "--seed", str(seed)]
        # Without settings of services that run here.
        own = {name: value for name, value in os.environ.items() if "VISLOC_" not in name}
        subprocess.run(command, check=True, capture_output=True, env=own)
        figures: dict[str, Any] = json.loads(report.read_text())
        return figures


def service(bench: Bench, maps_dir: Path, **settings: Any) -> ServiceProcess:
    """The service, to be entered; settings that are not given have their defaults."""
    settings = {"workers": None, "threads_per_worker": None, **settings}
    return ServiceProcess(
        maps_dir,
        bench.work / "service.log",
        ready_within_s=_READY_WITHIN_S,
        weights_dir=bench.weights_dir,
        **settings,
    )
