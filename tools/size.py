"""Lines of Python by room of the core and by extension, against the numbers in pyproject.toml.

    python -m tools.size

Exits with 1 where a room has more lines than ``[tool.size]`` allows: raising a number is a line in
a commit that somebody reads. Tests and generated code do not count.
"""

from __future__ import annotations

import sys
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CORE = ("visloc", "mapping", "service", "clients", "visloc_api")
GENERATED = ROOT / "visloc_api" / "v1"


def lines_by_room() -> Counter[str]:
    """Count the lines of each room of the core, extension, and other folder of Python."""
    found: Counter[str] = Counter()
    for folder in (*CORE, "visloc_extensions", "samples", "tools"):
        for file in (ROOT / folder).rglob("*.py"):
            parts = file.relative_to(ROOT).parts
            if GENERATED in file.parents or "tests" in parts:
                continue
            # Files directly in a package count as the package's own.
            room = folder if len(parts) == 2 or folder in ("samples", "tools") else None
            found[room or "/".join(parts[:2])] += len(file.read_text("utf-8").splitlines())
    return found


def main() -> int:
    """Print the table; return 1 where a number is passed, or a room has none."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        limits = tomllib.load(file)["tool"]["size"]
    found = lines_by_room()
    core = sum(count for room, count in found.items() if room.split("/")[0] in CORE)
    found["core"], found["all"] = core, sum(found.values())
    wrong = 0
    for room in sorted(found, key=lambda name: (name in ("core", "all"), name)):
        limit = limits.get(room)
        fits = limit is not None and found[room] <= limit
        wrong += not fits
        allowed = "no number in [tool.size]" if limit is None else f"of {limit:>6}"
        sys.stdout.write(f"{room:<32}{found[room]:>7} {allowed}{'' if fits else '  <- too many'}\n")
    gone = sorted(set(limits) - set(found))
    if gone:
        sys.stdout.write(f"[tool.size] has numbers of rooms that are gone: {', '.join(gone)}\n")
    return 1 if wrong or gone else 0


if __name__ == "__main__":
    sys.exit(main())
