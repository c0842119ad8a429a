"""Measurements kept as they are made, so that a run that was stopped can go on."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.speed.machine import load_average


def say(text: str) -> None:
    """Tell the person who waits."""
    sys.stderr.write(f"{time.strftime('%H:%M:%S')} {text}\n")
    sys.stderr.flush()


class Steps:
    """Values by name, in one JSON file each.

    Args:
        folder: of the files.
        settings: of the run; values of other settings are of no use.
        resume: take values that an earlier run left instead of measuring them again.

    Raises:
        ValueError: when the earlier run had other settings.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        kept = folder / "settings.json"
        if resume and kept.is_file() and json.loads(kept.read_text()) != settings:
            raise ValueError(f"{folder} holds a run with other settings: {kept.read_text()}")
        if not resume:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        _write(kept, settings)
        self._folder = folder

    def get(self, name: str, measure: Callable[[], Any]) -> Any:
        """Return a value that was measured before, or measure it."""
        path = self._folder / f"{name}.json"
        if path.is_file():
            say(f"{name}: measured before")
        else:
            started, load = time.perf_counter(), load_average()
            value = measure()
            seconds = time.perf_counter() - started
            measured_at = time.strftime("%Y-%m-%dT%H:%M:%S%z")
            _write(path, {"measured_at": measured_at, "load_before": load, "value": value})
            say(f"{name}: {seconds:.0f} s, load {load:.1f} before and {load_average():.1f} after")
        return json.loads(path.read_text())["value"]

    def load_averages(self) -> list[float]:
        """Of the machine before each value was measured."""
        kept = [json.loads(path.read_text()) for path in sorted(self._folder.glob("*.json"))]
        return [entry["load_before"] for entry in kept if "load_before" in entry]


def _write(path: Path, value: object) -> None:
    """Write whole or not at all."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
    part.replace(path)
