"""Writes docker/locks: what the images install, with the hashes of the files.

Run it after a change of constraints.txt, on Linux x86-64 with Python 3.11, in an environment with
all of the project's extras. pip then installs nothing else into the images (``--require-hashes``).

Left out is torch: its build for processors comes from another index than PyPI, whose file has
another hash; the Dockerfile installs it by its version alone, or with TORCH_SHA256.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

from packaging.requirements import Requirement

from tools.supply_chain.dependencies import (
    BUILD_TOOLS,
    IMAGES,
    ROOT,
    canonical,
    closure,
    of_extras,
    pinned,
)

LOCKS = ROOT / "docker" / "locks"
# torch, and what it needs only to build upon it.
NOT_LOCKED = ("torch", "setuptools")
_HEADER = "# Made by `python -m tools.supply_chain.lock` from constraints.txt.\n"


def locked() -> dict[str, dict[str, str]]:
    """Return what each lock holds: versions by canonical name, of constraints.txt."""
    needed = {name: of_extras(extras) for name, extras in IMAGES.items()}
    needed["build"] = closure([Requirement(name) for name in BUILD_TOOLS])
    pins = pinned()
    locks = {
        lock: {name: pins.get(name, "") for name in names if name not in NOT_LOCKED}
        for lock, names in needed.items()
    }
    missing = {name for names in locks.values() for name, version in names.items() if not version}
    if missing:
        sys.exit(f"constraints.txt does not pin {', '.join(sorted(missing))}")
    return locks


def hashes_of(versions: Mapping[str, str]) -> dict[str, str]:
    """Ask the package index, through pip, for the SHA-256 of each wheel for this platform."""
    wanted = [f"{name}=={version}" for name, version in versions.items()]
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "install", "--quiet", "--dry-run"),
            *("--ignore-installed", "--no-deps", "--only-binary", ":all:", "--report", "-"),
            *wanted,
        ],
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        sys.exit("pip does not find all of constraints.txt")
    report: dict[str, Any] = json.loads(done.stdout)
    return {
        canonical(one["metadata"]["name"]): one["download_info"]["archive_info"]["hashes"]["sha256"]
        for one in report["install"]
    }


def main() -> None:
    """Write all locks."""
    locks = locked()
    hashes = hashes_of({name: version for lock in locks.values() for name, version in lock.items()})
    LOCKS.mkdir(exist_ok=True)
    for lock, versions in locks.items():
        lines = [f"{name}=={versions[name]} --hash=sha256:{hashes[name]}\n" for name in versions]
        (LOCKS / f"{lock}.txt").write_text(_HEADER + "".join(lines))


if __name__ == "__main__":
    main()
