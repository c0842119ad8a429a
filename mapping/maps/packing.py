"""``mapping pack``: a map as one file."""

from __future__ import annotations

from pathlib import Path

from mapping.stages.outputs import complete_output, refuse_existing
from visloc.archive import verify_any
from visloc.archive.packed import pack_map
from visloc.archive.set_rules import AnyManifest

_EXISTS = "pack.output_exists"


def write_packed(folder: Path, output: Path) -> AnyManifest:
    """Pack a map or a set, every byte of which is checked first.

    Args:
        output: the file, which must not exist; it appears when it is complete.
    """
    refuse_existing(output, _EXISTS)  # before the long part
    verify_any(folder)
    with complete_output(output, _EXISTS) as partial:
        return pack_map(folder, partial)
