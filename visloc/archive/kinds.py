"""What a map id may name besides a map: an extension opens and searches it.

The archive knows the manifest of a set of maps, so that a store can list it and keeps its tiles.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from visloc.archive.checks import read_any_manifest
from visloc.archive.reader import MapOutline, verify_map
from visloc.archive.set_outline import SetOutline
from visloc.archive.set_schema import SET_FORMAT, SetManifest
from visloc.errors import refuse
from visloc.extensions import MAP_KINDS, extensions, load


def kind_of_sets(ref: str) -> Any:
    """Return what the extension registers for sets of maps (``visloc.extensions``)."""
    entry = extensions(MAP_KINDS).get(SET_FORMAT)
    if entry is None:
        raise refuse("set.extension", field="map", got=ref)
    return load(entry)


def verify_any(folder: Path) -> MapOutline | SetOutline:
    """Open a map or a set and read every byte of it.

    Raises:
        MapCorrupt: with the file and what is wrong.
        Conflict: ``set.extension``.
    """
    manifest = read_any_manifest(folder)
    if isinstance(manifest, SetManifest):
        outline: SetOutline = kind_of_sets(f"{manifest.id}@{manifest.version}").verify(folder)
        return outline
    return verify_map(folder)
