"""Rules that keep names and versions of a store unambiguous."""

from __future__ import annotations

from collections.abc import Sequence

from visloc.archive.schema import ID_PATTERN
from visloc.archive.set_rules import AnyManifest
from visloc.errors import VislocError, refuse


def checked_name(name: str, what: str) -> str:
    """Return an id of a map or version; raise InvalidInput ``map.id`` for any other text."""
    if not ID_PATTERN.fullmatch(name):
        raise refuse(
            "map.id",
            f"this is not a valid name of a {what}",
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
        raise refuse(
            "map.renamed",
            field=address,
            expected=f"{manifest.id}/{manifest.version}",
            got=f"{map_id}/{version}",
        )


def unknown_version(map_id: str, version: str, versions: Sequence[str]) -> VislocError:
    """``map.version``."""
    return refuse(
        "map.version",
        field="map",
        expected=f"one of: {', '.join(versions) or 'none'}",
        got=version,
        map_id=map_id,
    )


def none_in_use(map_id: str, versions: Sequence[str]) -> VislocError:
    """``map.none_in_use``."""
    return refuse(
        "map.none_in_use",
        field="map",
        expected=(f"{map_id}@{version}" for version in versions),
        got=map_id,
    )


def version_exists(map_id: str, version: str) -> VislocError:
    """``map.version_exists``."""
    return refuse("map.version_exists", field="map", got=f"{map_id}@{version}")


def version_in_use(map_id: str, version: str, others: Sequence[str]) -> VislocError:
    """``map.version_in_use``."""
    return refuse("map.version_in_use", field="map", expected=others, got=f"{map_id}@{version}")


def outdated(map_id: str, based_on: str, current: str | None) -> VislocError:
    """``map.outdated``."""
    return refuse(
        "map.outdated",
        field="map",
        expected=f"{map_id}@{based_on}",
        got="no version" if current is None else f"{map_id}@{current}",
    )
