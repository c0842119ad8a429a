"""Which distributions the project needs, by what they are needed for."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import requires, version
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PROJECT = "visloc"
# The extras that each image installs; `build` makes the wheel of the project.
IMAGES: Mapping[str, Sequence[str]] = {
    "vision": ("vision", "gem"),
    "service": ("service", "gem", "s3", "tracing"),
    "mapping": ("mapping", "gem"),
    "clients": ("clients",),
}
BUILD_TOOLS = ("hatchling",)


def canonical(name: str) -> str:
    """Return the name of a distribution as PEP 503 writes it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def needed_by(name: str, extras: Sequence[str] = ()) -> Iterator[Requirement]:
    """Give what a distribution needs on this platform, with some of its extras."""
    for text in _own_needs(extras) if name == PROJECT else requires(name) or ():
        requirement = Requirement(text)
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield requirement


def _own_needs(extras: Sequence[str]) -> list[str]:
    """Return what pyproject.toml says; what is installed may have been made of an older one."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"]
    return [*project["dependencies"], *(text for extra in extras for text in optional[extra])]


def closure(roots: Sequence[Requirement]) -> dict[str, str]:
    """Return the versions, by canonical name, of all that some requirements need.

    They are those that are installed, on this platform.
    """
    found: dict[str, str] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    waiting = list(roots)
    while waiting:
        one = waiting.pop()
        name, extras = canonical(one.name), frozenset(one.extras)
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        if name != PROJECT:
            found[name] = version(name)
        waiting += needed_by(name, sorted(extras))
    return dict(sorted(found.items()))


def of_extras(extras: Sequence[str]) -> dict[str, str]:
    """Return what the project needs with these extras: versions by canonical name."""
    return closure([Requirement(f"{PROJECT}[{','.join(extras)}]")])


def pinned() -> dict[str, str]:
    """Return the versions of constraints.txt, by canonical name."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = (line.split("==") for line in lines if line and not line.startswith("#"))
    return {canonical(name): version for name, version in pairs}
