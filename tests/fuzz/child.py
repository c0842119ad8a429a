"""One fuzzing process: ``python -m tests.fuzz.child TARGET FOLDER FIGURES LIBFUZZER-OPTIONS``."""

from __future__ import annotations

import importlib
import resource
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.fuzz.target import Target

# name -> module, class, and the modules whose branches guide the search.
TARGETS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "images": ("tests.fuzz.images", "Images", ("visloc.photos.reading", "PIL")),
    "archive": ("tests.fuzz.archive", "Archive", ("visloc.archive", "visloc.geometry", "zipfile")),
    "packed": ("tests.fuzz.packed", "Packed", ("visloc.archive", "zipfile")),
    "kapture": ("tests.fuzz.kapture", "Kapture", ("visloc.kapture", "visloc.geometry", "tarfile")),
    "features": (
        "tests.fuzz.features",
        "Features",
        ("visloc_api.words", "service.api", "service.grpc.messages", "visloc"),
    ),
}
MAX_SECONDS = 10  # of one input
# Backstops; the watch ends the process long before.
MAX_RSS_MIB = 2048
_MAX_ADDRESS_SPACE = 8 * 2**30


def make_target(name: str, folder: Path) -> Target:
    """Make the target of a name, with a folder for itself."""
    module, kind, _ = TARGETS[name]
    made: Target = getattr(importlib.import_module(module), kind)(folder)
    return made


def main() -> None:
    """Fuzz until libFuzzer ends the process."""
    import atheris  # type: ignore[import-untyped]

    name, folder, figures, *options = sys.argv[1:]
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_ADDRESS_SPACE, _MAX_ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with atheris.instrument_imports(include=list(TARGETS[name][2])):
        target = make_target(name, Path(folder))
    from tests.fuzz.target import Watch

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        mutated = atheris.Mutate(data, max_size)
        repaired = mutated if seed % 4 == 0 else target.repair(mutated)
        return repaired[:max_size]

    atheris.Setup([sys.argv[0], *options], Watch(target, Path(figures)), custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
