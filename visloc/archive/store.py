"""A folder of maps: ``<maps-dir>/<id>/<version>/`` and ``<maps-dir>/<id>/current``.

A set of maps lies beside its tiles, in a folder of the same kind.

Several threads and processes may read and change one store. Readers take no lock: every change
becomes visible by one rename. Whoever changes something holds the lock ``<maps-dir>/.lock``, so
that what it found is still true when it renames.
"""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from visloc.archive.checks import check_files, read_any_manifest
from visloc.archive.reader import Map, MapOutline, open_map
from visloc.archive.schema import ID_PATTERN
from visloc.archive.set_rules import (
    AnyManifest,
    refuse_if_tile,
    refuse_missing_tiles,
    refuse_other_kind,
    unreadable_set,
)
from visloc.archive.set_schema import SetManifest
from visloc.archive.sets import (
    SET_CODES,
    MapSet,
    SetOutline,
    open_set,
    read_any_outline,
    verify_any,
)
from visloc.errors import (
    MapCorrupt,
    NotFound,
    VislocError,
    refuse,
)

CURRENT = "current"
INCOMING, REMOVED = ".incoming", ".removed-"
# Every map has it, and no set.
IMAGE_POSES = "image_poses.npy"
FULL = (errno.ENOSPC, errno.EDQUOT)


class MapStore:
    """Finds, opens, publishes and removes maps below one folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    @property
    def reachable(self) -> bool:
        """Always: the folder is on this machine."""
        return True

    def ids(self) -> list[str]:
        """Ids of the maps that have a current version, sorted."""
        return [name for name in _names_in(self.root) if (self.root / name / CURRENT).is_file()]

    def versions(self, map_id: str) -> list[str]:
        """Published versions of a map, oldest first."""
        folder = self.root / checked_name(map_id, "map")
        return [name for name in _names_in(folder) if (folder / name / "manifest.json").is_file()]

    def current_version(self, map_id: str) -> str:
        """The version in use.

        Raises:
            NotFound: ``map.unknown``, ``map.none_in_use``.
            MapCorrupt: ``map.current`` when the file that names it is damaged.
        """
        path = self.root / checked_name(map_id, "map") / CURRENT
        try:
            version = path.read_text(encoding="ascii").strip()
        except FileNotFoundError:
            versions = self.versions(map_id)
            if versions:
                raise none_in_use(map_id, versions) from None
            known = ", ".join(self.ids()) or "none"
            raise refuse(
                "map.unknown", field="map", expected=f"one of {known}", got=map_id
            ) from None
        except (OSError, UnicodeDecodeError) as error:
            raise refuse(
                "map.current",
                "the file that names the version in use cannot be read",
                field=str(path),
            ) from error
        if not ID_PATTERN.fullmatch(version):
            raise refuse("map.current", field=str(path), got=version)
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
        folder = self.root / checked_name(map_id, "map") / checked_name(version, "map version")
        if not folder.is_dir():
            if not self.versions(map_id):
                self.current_version(map_id)  # raises: no such map
            raise refuse(
                "map.version",
                field="map",
                expected=self.versions(map_id),
                got=version,
                map_id=map_id,
            )
        return folder

    def at_hand(self, ref: str) -> Path | None:
        """The same as ``folder``: nothing needs to be fetched."""
        return self.folder(ref)

    def open(self, ref: str) -> Map:
        """Open ``id`` or ``id@version``; raises what ``folder`` and ``open_published`` raise."""
        return open_published(self.folder(ref))

    def open_set(self, ref: str) -> MapSet:
        """Open the set ``id`` or ``id@version``; raises what ``folder`` and ``open_set`` raise."""
        return open_published_set(self.folder(ref))

    def outline(self, ref: str) -> MapOutline | SetOutline:
        """Say what ``id`` or ``id@version`` is, without opening its arrays; raises as ``open``."""
        return read_published_outline(self.folder(ref))

    def publish(
        self,
        incoming: Path,
        map_id: str,
        version: str,
        *,
        make_current: bool = True,
        based_on: str | None = None,
    ) -> Path:
        """Verify a finished map folder, give it its place, and make it current.

        Every byte is read first. The rename and the switch of ``current`` are atomic: a reader
        sees the old map or the new one, never a half. Killed between the two, the version is there
        and the one before it stays in use.

        Args:
            incoming: the map, in a folder on the same file system as the store.
            map_id: the map's id.
            version: the version's name.
            make_current: whether it takes over from the version in use. A map without a current
                version is not among ``ids``.
            based_on: the version that it was made from, if it was made from one, which must still
                be the one in use: what another one brought would be lost.

        Returns:
            The folder of the published version.

        Raises:
            Conflict: ``map.version_exists``, ``map.outdated``; ``set.id_is_map``,
                ``map.id_is_set``; ``set.tile``, ``set.features``.
            NotFound: ``set.tile`` when a tile of a set is not in the store.
            MapCorrupt: what ``verify_any`` finds, or ``map.renamed`` when the manifest names
                another id or version.
        """
        return self._place(
            incoming,
            map_id,
            version,
            make_current=make_current,
            keeps_rules=True,
            based_on=based_on,
        )

    def keep_copy(self, incoming: Path, map_id: str, version: str) -> Path:
        """Take in a version that another store has published: as ``publish``, not made current.

        What else that store has is not here, so that it is not asked for the tiles of a set.
        """
        return self._place(incoming, map_id, version, make_current=False, keeps_rules=False)

    def _place(
        self,
        incoming: Path,
        map_id: str,
        version: str,
        *,
        make_current: bool,
        keeps_rules: bool,
        based_on: str | None = None,
    ) -> Path:
        target = self.root / checked_name(map_id, "map") / checked_name(version, "map version")
        manifest = verify_any(incoming).manifest
        refuse_renamed(manifest, incoming, map_id, version)
        with self._changing():
            if keeps_rules:
                refuse_other_kind(manifest, self._any_version(map_id))
                refuse_missing_tiles(manifest, self._manifests)
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists():
                raise version_exists(map_id, version)
            if based_on is not None and _current_or_none(self, map_id) != based_on:
                raise outdated(map_id, based_on, _current_or_none(self, map_id))
            for folder in (*(path for path in incoming.rglob("*") if path.is_dir()), incoming):
                _sync_folder(folder)
            if make_current:  # first what a full disk could refuse
                switch = _prepare_current(target.parent, version)
            incoming.rename(target)
            _sync_folder(target.parent)
            _sync_folder(self.root)
            if make_current:
                switch.replace(target.parent / CURRENT)
                _sync_folder(target.parent)
        return target

    def set_current(self, map_id: str, version: str) -> None:
        """Make a published version the one in use, atomically.

        Raises:
            NotFound: ``map.unknown`` or ``map.version``; ``set.tile``, and
            Conflict: ``set.tile``, for a set whose tiles are not in the store any more.
        """
        with self._changing():
            parent = self.folder(f"{map_id}@{version}").parent
            refuse_missing_tiles(read_any_manifest(parent / version), self._manifests)
            _prepare_current(parent, version).replace(parent / CURRENT)
            _sync_folder(parent)

    def remove(self, map_id: str, version: str) -> None:
        """Remove a version; with the last one, the map.

        It disappears by one rename before its files are deleted. Whoever has it open can go on.

        Raises:
            NotFound: ``map.unknown`` or ``map.version``.
            Conflict: ``map.version_in_use`` for the current version of a map that has others;
                ``map.in_set`` for a version that a set in use names.
        """
        with self._changing():
            folder = self.folder(f"{map_id}@{version}")
            others = [name for name in self.versions(map_id) if name != version]
            if others and _current_or_none(self, map_id) == version:
                raise version_in_use(map_id, version, others)
            if may_be_tile(lambda: read_any_manifest(folder), has_file(folder)):
                refuse_if_tile(map_id, version, self._sets_in_use(folder))
            leaving = folder if others else folder.parent
            # Beside where it was, as a full disk may have no room for another folder.
            removed = leaving.with_name(f"{REMOVED}{secrets.token_hex(8)}")
            leaving.rename(removed)
            _sync_folder(removed.parent)
        shutil.rmtree(removed, ignore_errors=True)

    @contextmanager
    def incoming(self) -> Iterator[Path]:
        """Give an empty folder on the store's file system, for a map that is to be published.

        What is left in it is deleted in the end; what a process leaves that is killed meanwhile is
        deleted by the next ``sweep``, which comes with every ``incoming``.

        Raises:
            StorageFull: ``maps.storage_full``, also for a full disk within the block.
            Forbidden: ``maps.read_only``, likewise.
        """
        self.sweep()
        folder = self.root / INCOMING / secrets.token_hex(8)
        lock = folder.with_suffix(".lock")
        with storage_errors(self.root), ExitStack() as holding:
            with self._changing():
                folder.parent.mkdir(exist_ok=True)
                # Held while the folder is in use: a process id means nothing in another container.
                fcntl.flock(holding.enter_context(lock.open("w")), fcntl.LOCK_EX)
            try:
                folder.mkdir()
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
                lock.unlink(missing_ok=True)

    def sweep(self) -> None:
        """Delete what uploads and removals left behind whose process was killed."""
        for removed in (*self.root.glob(f"{REMOVED}*"), *self.root.glob(f"*/{REMOVED}*")):
            shutil.rmtree(removed, ignore_errors=True)
        parent = self.root / INCOMING
        if not parent.is_dir() or not os.access(parent, os.W_OK):
            return
        with ExitStack() as holding, self._changing():
            for path in parent.glob("*.lock"):
                lock = holding.enter_context(path.open("w"))
                with suppress(BlockingIOError):
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    holding.callback(path.unlink, missing_ok=True)
                    holding.callback(shutil.rmtree, path.with_suffix(""), ignore_errors=True)

    def _manifest(self, map_id: str, version: str) -> AnyManifest:
        return read_any_manifest(self.folder(f"{map_id}@{version}"))

    def _manifests(self, refs: Sequence[tuple[str, str]]) -> Iterator[AnyManifest]:
        for ref in refs:
            yield self._manifest(*ref)

    def _any_version(self, map_id: str) -> AnyManifest | None:
        """The manifest of any version of a map or set; None when none can be read."""
        for version in self.versions(map_id):
            with suppress(MapCorrupt):
                return self._manifest(map_id, version)
        return None

    def _sets_in_use(self, leaving: Path) -> Iterator[tuple[str, AnyManifest]]:
        """The sets in use but for ``leaving``; of an id whose ``current`` is damaged, all versions.

        A map may be among them.

        Raises:
            Conflict: ``map.in_set`` for one that cannot be read.
        """
        for map_id in self.ids():
            try:
                versions = [self.current_version(map_id)]
            except NotFound:
                continue
            except MapCorrupt:
                versions = self.versions(map_id)
            for version in versions:
                folder, ref = self.root / map_id / version, f"{map_id}@{version}"
                if folder == leaving or not folder.is_dir():
                    continue
                if looks_like_map(has_file(folder)):  # of thousands, no manifest is read
                    continue
                try:
                    yield ref, read_any_manifest(folder)
                except MapCorrupt as error:
                    raise unreadable_set(ref, error) from error

    @contextmanager
    def _changing(self) -> Iterator[None]:
        with storage_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            with (self.root / ".lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                yield


def looks_like_map(has: Callable[[str], bool]) -> bool:
    """Tell by its files that a version is a map and no set; a file that is lost makes no map."""
    return has(IMAGE_POSES) and not has(SET_CODES)


def may_be_tile(read: Callable[[], AnyManifest], has: Callable[[str], bool]) -> bool:
    """Tell whether sets may name a version: whether it is no set.

    Args:
        read: its manifest; raises MapCorrupt when that is damaged, and its files tell.
        has: whether it has a file.
    """
    try:
        return not isinstance(read(), SetManifest)
    except MapCorrupt:
        return has(IMAGE_POSES) or not has(SET_CODES)


def has_file(folder: Path) -> Callable[[str], bool]:
    """Return what tells whether a folder has a file."""
    return lambda name: (folder / name).is_file()


def open_published(folder: Path) -> Map:
    """Open the map in a folder ``<id>/<version>``.

    Raises:
        MapCorrupt: what ``open_map`` finds, or ``map.renamed`` when the folder was copied or
            renamed: answers would carry the old name.
    """
    opened = open_map(folder)
    refuse_renamed(opened.manifest, folder, folder.parent.name, folder.name)
    return opened


def open_published_set(folder: Path) -> MapSet:
    """Open the set in a folder ``<id>/<version>``.

    Raises:
        MapCorrupt: as ``open_published``.
    """
    opened = open_set(folder)
    refuse_renamed(opened.manifest, folder, folder.parent.name, folder.name)
    return opened


def read_published_outline(folder: Path) -> MapOutline | SetOutline:
    """Read what the map or set in a folder ``<id>/<version>`` says, whose files must be there.

    Raises:
        MapCorrupt: as ``open_published``, but the arrays are not opened.
    """
    outline = read_any_outline(folder)
    check_files(folder, outline.manifest)
    refuse_renamed(outline.manifest, folder, folder.parent.name, folder.name)
    return outline


def refuse_renamed(manifest: AnyManifest, folder: Path, map_id: str, version: str) -> None:
    """Raise MapCorrupt ``map.renamed`` unless a manifest is of this name."""
    if (manifest.id, manifest.version) != (map_id, version):
        raise refuse(
            "map.renamed",
            field=str(folder),
            expected=f"{manifest.id}/{manifest.version}",
            got=f"{map_id}/{version}",
        )


def checked_name(name: str, what: str) -> str:
    """Return an id of a map or version; InvalidInput ``map.id`` for what cannot be one."""
    if not ID_PATTERN.fullmatch(name):
        raise refuse(
            "map.id",
            f"this is not a valid name of a {what}",
            field="map",
            expected="up to 64 letters, digits, '.', '_', '-', beginning with a letter or digit",
            got=name,
        )
    return name


def version_exists(map_id: str, version: str) -> VislocError:
    """``map.version_exists``."""
    return refuse("map.version_exists", field="map", got=f"{map_id}@{version}")


def none_in_use(map_id: str, versions: Sequence[str]) -> VislocError:
    """``map.none_in_use``."""
    return refuse(
        "map.none_in_use",
        field="map",
        expected=(f"{map_id}@{version}" for version in versions),
        got=map_id,
    )


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


@contextmanager
def storage_errors(place: Path) -> Iterator[None]:
    """Turn a full or read-only disk into an error for users.

    Raises:
        StorageFull: ``maps.storage_full``.
        Forbidden: ``maps.read_only``.
    """
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise refuse("maps.storage_full", field=str(place)) from error
        if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            raise refuse("maps.read_only", field=str(place), got=error.strerror) from error
        raise


def _names_in(folder: Path) -> list[str]:
    try:
        return sorted(path.name for path in folder.iterdir() if ID_PATTERN.fullmatch(path.name))
    except (FileNotFoundError, NotADirectoryError):  # another process may have removed it
        return []


def _current_or_none(store: MapStore, map_id: str) -> str | None:
    try:
        return store.current_version(map_id)
    except NotFound:
        return None


def _prepare_current(folder: Path, version: str) -> Path:
    """Write what is to replace ``current``; only under the lock, as the name is always the same."""
    switch = folder / f".{CURRENT}.new"
    with switch.open("w", encoding="ascii") as file:
        file.write(version + "\n")
        file.flush()
        os.fsync(file.fileno())
    return switch


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
