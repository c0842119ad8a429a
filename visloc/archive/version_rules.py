"""What a store refuses so that names and versions stay unambiguous."""

from __future__ import annotations

from collections.abc import Sequence

from visloc.archive.schema import ID_PATTERN
from visloc.archive.set_rules import AnyManifest
from visloc.errors import Conflict, InvalidInput, MapCorrupt, NotFound


def checked_name(name: str, what: str) -> str:
    """Return an id of a map or version; raise InvalidInput ``map.id`` for any other text."""
    if not ID_PATTERN.fullmatch(name):
        raise InvalidInput(
            "map.id",
            f"not a {what} name",
            field="map",
            expected="up to 64 letters, digits, '.', '_', '-', beginning with a letter or digit",
            got=name,
        )
    return name


def refuse_renamed(manifest: AnyManifest, address: str, map_id: str, version: str) -> None:
    """Raise MapCorrupt ``map.renamed`` if a manifest has another id or version.

    Answers from such a map would carry its old name.
    """
    if (manifest.id, manifest.version) != (map_id, version):
        raise MapCorrupt(
            "map.renamed",
            "the map's folder was copied or renamed; build the map under its new id",
            field=address,
            expected=f"{manifest.id}/{manifest.version}",
            got=f"{map_id}/{version}",
        )


def unknown_version(map_id: str, version: str, versions: Sequence[str]) -> NotFound:
    """``map.version``."""
    return NotFound(
        "map.version",
        f"map {map_id!r} has no such version",
        field="map",
        expected=f"one of: {', '.join(versions) or 'none'}",
        got=version,
    )


def none_in_use(map_id: str, versions: Sequence[str]) -> NotFound:
    """``map.none_in_use``."""
    return NotFound(
        "map.none_in_use",
        "no version of the map is in use; put one into use, or name one",
        field="map",
        expected=f"one of: {', '.join(f'{map_id}@{version}' for version in versions)}",
        got=map_id,
    )


def version_exists(map_id: str, version: str) -> Conflict:
    """``map.version_exists``."""
    return Conflict(
        "map.version_exists",
        "the version exists already; versions never change, publish under another name",
        field="map",
        got=f"{map_id}@{version}",
    )


def version_in_use(map_id: str, version: str, others: Sequence[str]) -> Conflict:
    """``map.version_in_use``."""
    return Conflict(
        "map.version_in_use",
        "the version is in use; make another one current first",
        field="map",
        expected=f"one of: {', '.join(others)}",
        got=f"{map_id}@{version}",
    )


def outdated(map_id: str, based_on: str, current: str | None) -> Conflict:
    """``map.outdated``."""
    return Conflict(
        "map.outdated",
        "another version of the map came into use meanwhile; run the same command again on it",
        field="map",
        expected=f"{map_id}@{based_on}",
        got="no version" if current is None else f"{map_id}@{current}",
    )
