"""What all tests share."""

from __future__ import annotations

import os

# One thread per library makes timings and results independent of the machine's size.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "2")

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


def _shared(name: str) -> Path:
    path = SHARED / name
    if not path.is_dir():
        pytest.skip(f"needs the shared folder {name!r} beside the repository, which is absent")
    return path


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real datasets; the test is skipped where it is absent."""
    return _shared("data")


@pytest.fixture(scope="session")
def shared_weights() -> Path:
    """Folder of published checkpoints; the test is skipped where it is absent."""
    return _shared("weights")
