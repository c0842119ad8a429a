"""Finds and loads what extensions add, by the entry points of installed packages.

An extension registers each thing that it adds with a line in its package's metadata, for ours in
``pyproject.toml``: the group says what it is, the name is the one that users give, and the value
is the object. Features are such groups too (``visloc.features.plugins``).
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

# A function with annotated options, as those of ``mapping.cli``.
MAPPING_COMMANDS = "visloc.mapping_commands"
# A function with annotated options, as those of ``clients.cli``.
LOCALIZE_COMMANDS = "visloc.localize_commands"
# (path, folder of photos or None) -> mapping.importers.ImportedModel
IMPORTERS = "visloc.importers"
# (path) -> name of the importer that reads this file or folder, or None
RECOGNIZERS = "visloc.recognizers"
# (workers, address) -> context manager of a mapping.cluster.executors.Executor
EXECUTORS = "visloc.executors"
# (URL, folder of copies, bytes of copies) -> visloc.archive.MapStore; the name is "url".
MAP_STORES = "visloc.map_stores"
# What opens and searches the ids of sets of maps (visloc_extensions.sets.kind.SetKind); the name
# is the format that their manifest states.
MAP_KINDS = "visloc.map_kinds"
# (app) -> None: adds routes to the ASGI app of the service.
HTTP_ROUTES = "visloc.http_routes"


def extensions(group: str) -> dict[str, EntryPoint]:
    """Return what installed packages add to a group, by name and in the names' order."""
    return {entry.name: entry for entry in sorted(entry_points(group=group), key=lambda e: e.name)}


def load(entry: EntryPoint) -> Any:
    """Load what an extension adds; what its code raises names the extension."""
    try:
        return entry.load()
    except Exception as error:
        package = entry.module if entry.dist is None else entry.dist.name
        error.add_note(f"raised by the extension {entry.name!r} ({entry.value}) of {package}")
        raise
