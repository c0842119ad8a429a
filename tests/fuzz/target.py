"""What a fuzz target is, and what is watched while it runs."""

from __future__ import annotations

import json
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from visloc.errors import VislocError

# Beyond what the process had when all seeds had been read once.
MAX_MEMORY_BYTES = 256 * 2**20


class Target(Protocol):
    """Something that reads what strangers send."""

    def seeds(self) -> Iterator[bytes]:
        """Yield good inputs, from which others are made by changing them."""

    def run(self, data: bytes) -> str:
        """Read one input and return how it came out: ``accepted`` or the code of the refusal.

        Whatever is raised is a finding.
        """

    def repair(self, data: bytes) -> bytes:
        """Return the input with checksums and the like made right, so that it is looked into."""


class MemoryExceeded(Exception):
    """An input made the process take more memory than it may."""


class Watch:
    """Runs inputs, counts how they came out, and measures what they cost.

    Args:
        target: what to run.
        figures: a file that is kept up to date; None for none.
    """

    def __init__(self, target: Target, figures: Path | None = None) -> None:
        self._target = target
        self._figures = figures
        self._outcomes: Counter[str] = Counter()
        self._longest_s = 0.0
        warnings.simplefilter("ignore")  # of Pillow, about the files it reads
        warnings.simplefilter("error", RuntimeWarning)  # of NumPy: numbers out of hand
        for seed in target.seeds():
            target.run(seed)
        self._start_bytes = _peak_bytes()

    def __call__(self, data: bytes) -> None:
        """Run one input.

        Raises:
            MemoryExceeded: when it took too much; and whatever the target raises.
        """
        start = time.process_time()
        outcome = self._target.run(data)
        self._longest_s = max(self._longest_s, time.process_time() - start)
        self._outcomes[outcome] += 1
        grown = _peak_bytes() - self._start_bytes
        if grown > MAX_MEMORY_BYTES:
            raise MemoryExceeded(f"{grown} bytes, {MAX_MEMORY_BYTES} are allowed")
        runs = self._outcomes.total()
        if self._figures is not None and runs % 1000 == 0:
            figures = {
                "runs": runs,
                "longest_run_s": round(self._longest_s, 3),
                "memory_grown_mib": round(grown / 2**20, 1),
                "outcomes": dict(self._outcomes.most_common()),
            }
            self._figures.write_text(json.dumps(figures), encoding="utf-8")


def refusal(error: VislocError, *kinds: str) -> str:
    """Return the code of a refusal, which begins with one of ``kinds``.

    What a user would see of it must be there, and must not be all that was sent.
    """
    assert error.code.startswith(kinds), f"{error.code} is not one of {kinds}"
    assert error.message
    assert len(str(error)) < 10_000
    return error.code


@contextmanager
def holds(claim: str) -> Iterator[None]:
    """Say which claim about an accepted input an exception refutes."""
    try:
        yield
    except Exception as error:
        raise AssertionError(f"accepted, but not {claim}") from error


def _peak_bytes() -> int:
    # Address space, not pages: memory that is asked for and never touched counts as well.
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmPeak:"):
            return int(line.split()[1]) * 1024
    raise AssertionError("no VmPeak")
