"""A folder of maps: ``<maps-dir>/<id>/<version>/`` and ``<maps-dir>/<id>/current``."""

from __future__ import annotations

import os
from pathlib import Path

from visloc.archive.reader import Map, open_map, verify_map
from visloc.archive.schema import ID_PATTERN
from visloc.errors import Conflict, InvalidInput, MapCorrupt, NotFound

CURRENT = "current"


class MapStore:
    """Finds, opens and publishes maps below one folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def ids(self) -> list[str]:
        """Ids of the maps that have a current version, sorted."""
        if not self.root.is_dir():
            return []
        return sorted(
            path.name
            for path in self.root.iterdir()
            if ID_PATTERN.fullmatch(path.name) and (path / CURRENT).is_file()
        )

    def versions(self, map_id: str) -> list[str]:
        """Published versions of a map, oldest first."""
        folder = self.root / _checked(map_id, "map")
        if not folder.is_dir():
            return []
        return sorted(
            path.name
            for path in folder.iterdir()
            if ID_PATTERN.fullmatch(path.name) and (path / "manifest.json").is_file()
        )

    def current_version(self, map_id: str) -> str:
        """The version in use.

        Raises:
            NotFound: ``map.unknown``.
            MapCorrupt: ``map.current`` when the file that names it is damaged.
        """
        path = self.root / _checked(map_id, "map") / CURRENT
        try:
            version = path.read_text(encoding="ascii").strip()
        except FileNotFoundError:
            known = ", ".join(self.ids()) or "none"
            raise NotFound(
                "map.unknown", "no such map", field="map", expected=f"one of: {known}", got=map_id
            ) from None
        except (OSError, UnicodeDecodeError) as error:
            raise MapCorrupt("map.current", "cannot be read", field=str(path)) from error
        if not ID_PATTERN.fullmatch(version):
            raise MapCorrupt("map.current", "does not name a version", field=str(path), got=version)
        return version

    def folder(self, ref: str) -> Path:
        """The folder of ``id`` (its current version) or ``id@version``.

        Raises:
            InvalidInput: ``map.id`` for a reference that is neither.
            NotFound: ``map.unknown`` or ``map.version``.
        """
        map_id, at, version = ref.partition("@")
        if not at:
            version = self.current_version(map_id)
        folder = self.root / _checked(map_id, "map") / _checked(version, "map version")
        if not folder.is_dir():
            if not self.versions(map_id):
                self.current_version(map_id)  # raises: no such map
            raise NotFound(
                "map.version",
                f"map {map_id!r} has no such version",
                field="map",
                expected=f"one of: {', '.join(self.versions(map_id)) or 'none'}",
                got=version,
            )
        return folder

    def open(self, ref: str) -> Map:
        """Open ``id`` or ``id@version``.

        Raises:
            MapCorrupt: ``map.renamed`` when the folder was copied or renamed: answers would
                carry the old name.
        """
        folder = self.folder(ref)
        opened = open_map(folder)
        if (opened.manifest.id, opened.manifest.version) != (folder.parent.name, folder.name):
            raise MapCorrupt(
                "map.renamed",
                "the map's folder was copied or renamed; build the map under its new id",
                field=str(folder),
                expected=f"{opened.manifest.id}/{opened.manifest.version}",
                got=f"{folder.parent.name}/{folder.name}",
            )
        return opened

    def publish(self, incoming: Path, map_id: str, version: str) -> Path:
        """Verify a finished map folder, give it its place, and make it current.

        Every byte is read first. The rename and the switch of ``current`` are atomic: a reader
        sees the old map or the new one, never a half.

        Args:
            incoming: the map, in a folder on the same file system as the store.
            map_id: the map's id.
            version: the version's name.

        Returns:
            The folder of the published version.
        """
        verify_map(incoming)
        parent = self.root / _checked(map_id, "map")
        target = parent / _checked(version, "map version")
        parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            raise Conflict("map.version_exists", "the version exists already", field=str(target))
        for folder in (*(path for path in incoming.rglob("*") if path.is_dir()), incoming):
            _sync_folder(folder)
        incoming.rename(target)
        _sync_folder(parent)
        _sync_folder(self.root)
        switch = parent / f".{CURRENT}.new"
        with switch.open("w", encoding="ascii") as file:
            file.write(version + "\n")
            file.flush()
            os.fsync(file.fileno())
        switch.replace(parent / CURRENT)
        _sync_folder(parent)
        return target


def _checked(name: str, what: str) -> str:
    if not ID_PATTERN.fullmatch(name):
        raise InvalidInput(
            "map.id",
            f"not a {what} name",
            field="map",
            expected="up to 64 letters, digits, '.', '_', '-', beginning with a letter or digit",
            got=name,
        )
    return name


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
