from __future__ import annotations

import re

import pytest
from packaging.requirements import Requirement

from tools.supply_chain.dependencies import closure, of_extras, pinned
from tools.supply_chain.lock import LOCKS, NOT_LOCKED, locked

LINE = re.compile(r"([a-z0-9-]+)==(\S+) --hash=sha256:[0-9a-f]{64}")


@pytest.mark.parametrize("lock", sorted(locked()))
def test_a_lock_holds_what_its_image_needs_as_constraints_pin_it(lock: str) -> None:
    """After a change of constraints.txt or pyproject.toml: make lock."""
    comment, *lines = (LOCKS / f"{lock}.txt").read_text().splitlines()
    held = dict(found.groups() for line in lines if (found := LINE.fullmatch(line)))

    assert comment.startswith("#")
    assert len(held) == len(lines)
    assert held == locked()[lock]


def test_there_are_no_other_locks() -> None:
    assert {path.stem for path in LOCKS.iterdir()} == locked().keys()


def test_what_is_needed_is_found_through_extras_and_markers() -> None:
    service = of_extras(("service", "gem", "s3", "tracing"))

    assert {"numpy", "uvicorn", "h11", "s3fs", "botocore", "torch", "opentelemetry-sdk"} <= set(
        service
    )
    assert not {"pytest", "ruff", "av", "colorama", "visloc"} & set(service)
    assert "visloc" not in of_extras(("mapping",))  # which names visloc[vision]
    assert closure([Requirement("uvicorn")]).keys() == {"uvicorn", "click", "h11"}


def test_torch_is_the_only_package_of_the_images_that_is_not_locked() -> None:
    needed = of_extras(("service", "gem", "s3", "tracing"))

    assert needed.keys() - locked()["service"].keys() == set(NOT_LOCKED)
    assert "torch" in pinned()
