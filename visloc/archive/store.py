"""A store of maps: its rules, over a folder or another backend.

A set of maps lies beside its tiles, as a version of the same kind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path

from visloc.archive.backends.base import CURRENT, MANIFEST, Backend
from visloc.archive.backends.folder import FolderBackend
from visloc.archive.kinds import verify_any
from visloc.archive.reader import Map, MapOutline, open_map
from visloc.archive.schema import ID_PATTERN, Manifest
from visloc.archive.set_outline import SetOutline
from visloc.archive.set_rules import (
    AnyManifest,
    refuse_if_tile,
    refuse_missing_tiles,
    refuse_other_kind,
    unreadable_set,
)
from visloc.archive.set_schema import SET_OFFSETS
from visloc.archive.version_rules import (
    checked_name,
    none_in_use,
    outdated,
    refuse_renamed,
    unknown_version,
    version_exists,
    version_in_use,
)
from visloc.errors import MapCorrupt, NotFound, VislocError, refuse
from visloc.extensions import MAP_STORES, extensions, load

# Every map has it, and no set.
_IMAGE_POSES = "image_poses.npy"


def open_remote_store(url: str, cache_dir: Path, max_cache_bytes: int) -> MapStore:
    """Return the store at a URL, which an extension opens.

    Args:
        url: as fsspec has it.
        cache_dir: folder of the copies; several URLs may share it.
        max_cache_bytes: room for copies; the least recently used are deleted first.

    Raises:
        ImportError: when no extension opens URLs, or what this one needs is not installed.
        ValueError: for a URL that cannot be used.
    """
    entry = extensions(MAP_STORES).get("url")
    if entry is None:
        raise ImportError("maps at URLs need the extension object_storage")
    store: MapStore = load(entry)(url, cache_dir, max_cache_bytes)
    return store


class MapStore:
    """Finds, opens, publishes and removes the maps of one folder or bucket. Thread-safe.

    Remote storage that does not answer raises Unavailable ``maps.storage_away``, unless the answer
    is already known.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.backend: Backend = FolderBackend(root)

    @property
    def reachable(self) -> bool:
        """Whether the place answered when it was last asked."""
        return self.backend.reachable

    def ids(self) -> list[str]:
        """Ids of the maps that have a current version, sorted."""
        return self.backend.ids()

    def versions(self, map_id: str) -> list[str]:
        """Published versions of a map, oldest first."""
        return self.backend.versions(checked_name(map_id, "map"))

    def current_version(self, map_id: str) -> str:
        """The current version.

        Raises:
            NotFound: ``map.unknown``, ``map.none_in_use``.
            MapCorrupt: ``map.current`` when the file that names it is damaged.
        """
        version = self.backend.current(checked_name(map_id, "map"))
        if version is None:
            versions = self.versions(map_id)
            raise none_in_use(map_id, versions) if versions else self._unknown_map(map_id)
        if not ID_PATTERN.fullmatch(version):
            field = self.backend.address(map_id, CURRENT)
            raise refuse("map.current", field=field, got=version)
        return version

    def folder(self, ref: str) -> Path:
        """The local folder of ``id`` (its current version) or ``id@version``, fetched if necessary.

        Raises:
            InvalidInput: ``map.id`` for a reference that is neither.
            NotFound: ``map.unknown`` or ``map.version``.
            MapCorrupt: when what was fetched is not what its manifest says.
            StorageFull: ``maps.storage_full`` when there is no room for a copy.
        """
        return self.backend.folder(*self._found(ref))

    def at_hand(self, ref: str) -> Path | None:
        """The same as ``folder``, without fetching; None when it must be fetched first."""
        return self.backend.local_folder(*self._found(ref))

    def open(self, ref: str) -> Map:
        """Open ``id`` or ``id@version``; raises what ``folder`` and ``open_published`` raise."""
        return open_published(self.folder(ref))

    def outline(self, ref: str) -> MapOutline | SetOutline:
        """Describe ``id`` or ``id@version`` without opening its arrays; raises as ``open``."""
        map_id, version = self._found(ref)
        try:
            return self.backend.outline(map_id, version)
        except MapCorrupt:
            self._found(f"{map_id}@{version}")  # NotFound, where it was deleted meanwhile
            raise

    def publish(
        self,
        incoming: Path,
        map_id: str,
        version: str,
        *,
        make_current: bool = True,
        based_on: str | None = None,
        accept: Callable[[AnyManifest], None] | None = None,
    ) -> Path:
        """Verify a finished map folder, give it its place, and make it current.

        Every byte is verified first. A reader sees the old map or the new one, never a mixture. If
        the process is killed before ``current`` is switched, the new version exists but the
        previous one stays current.

        Args:
            incoming: the map, within a folder that ``incoming()`` gave.
            map_id: the map's id.
            version: the version's name.
            make_current: whether it takes over from the current version. A map without a current
                version is not among ``ids``.
            based_on: the version that it was made from, if any. It must still be the current one;
                otherwise the changes that became current meanwhile would be lost.
            accept: called once the map is verified; what it raises refuses the map.

        Returns:
            The local folder of the published version.

        Raises:
            Conflict: ``map.version_exists``, ``map.outdated``; ``set.id_is_map``,
                ``map.id_is_set``; ``set.tile``, ``set.features``; in object storage also
                ``map.upload_runs``.
            NotFound: ``set.tile`` when a tile of a set is not in the store.
            MapCorrupt: what ``verify_any`` finds, or ``map.renamed`` when the manifest names
                another id or version.
        """
        checked_name(map_id, "map")
        checked_name(version, "map version")
        manifest = verify_any(incoming).manifest
        refuse_renamed(manifest, str(incoming), map_id, version)
        if accept is not None:
            accept(manifest)
        with self.backend.changing():
            refuse_other_kind(manifest, self._any_version(map_id))
            refuse_missing_tiles(manifest, self._manifests)
            if self.backend.has_version(map_id, version):
                raise version_exists(map_id, version)
            current = self.backend.current(map_id)
            if based_on is not None and current != based_on:
                raise outdated(map_id, based_on, current)
            return self.backend.publish(
                incoming, map_id, version, make_current=make_current, based_on=based_on
            )

    def set_current(self, map_id: str, version: str) -> None:
        """Make a published version current, atomically.

        Raises:
            NotFound: ``map.unknown`` or ``map.version``; ``set.tile``, and
            Conflict: ``set.tile``, for a set whose tiles are not in the store any more.
        """
        with self.backend.changing():
            self._found(f"{map_id}@{version}")
            (manifest,) = self._manifests([(map_id, version)])
            refuse_missing_tiles(manifest, self._manifests)
            self.backend.set_current(map_id, version)

    def withdraw(self, map_id: str) -> None:
        """Take a map out of use, atomically: none of its versions is current, and all stay.

        Nothing happens when none was. Sets that name a version keep it.
        """
        with self.backend.changing():
            if self.backend.current(checked_name(map_id, "map")) is not None:
                self.backend.withdraw(map_id)

    def remove(self, map_id: str, version: str) -> None:
        """Remove a version; with the last one, the map.

        It disappears at once, before its files are deleted. Maps that are open stay readable.

        Raises:
            NotFound: ``map.unknown`` or ``map.version``.
            Conflict: ``map.version_in_use`` for the current version of a map that has others;
                ``map.in_set`` for a version that a current set names.
            MapCorrupt: ``map.current`` when nothing says which of several versions is current.
        """
        with self.backend.changing():
            self._found(f"{map_id}@{version}")
            others = [name for name in self.versions(map_id) if name != version]
            if others and self._current_or_none(map_id) == version:
                raise version_in_use(map_id, version, others)
            if self._may_be_tile(map_id, version):
                refuse_if_tile(map_id, version, self._sets_in_use((map_id, version)))
            delete = self.backend.remove(map_id, version, is_last=not others)
        delete()

    def incoming(self) -> AbstractContextManager[Path]:
        """Yield an empty folder for a map that will be published.

        The folder is deleted when the block ends. If the process is killed before that, the next
        ``sweep`` deletes it; every ``incoming`` begins with a sweep.

        Raises:
            StorageFull: ``maps.storage_full``, also for a full disk within the block.
            Forbidden: ``maps.read_only``, likewise.
        """
        return self.backend.incoming()

    def sweep(self) -> None:
        """Delete leftovers of uploads and removals whose process was killed."""
        self.backend.sweep()

    def _current_or_none(self, map_id: str) -> str | None:
        with suppress(NotFound):
            return self.current_version(map_id)
        return None

    def _found(self, ref: str) -> tuple[str, str]:
        """The id and version of ``id`` (its current version) or ``id@version``; raise NotFound."""
        map_id, at, version = ref.partition("@")
        if not at:
            version = self.current_version(map_id)
        checked_name(map_id, "map")
        checked_name(version, "map version")
        if not self.backend.has_version(map_id, version):
            versions = self.versions(map_id)
            raise (
                unknown_version(map_id, version, versions)
                if versions or self.backend.current(map_id) is not None
                else self._unknown_map(map_id)
            )
        return map_id, version

    def _unknown_map(self, map_id: str) -> VislocError:
        known = ", ".join(self.ids())
        expected = f"one of {known}" if known else "a map that exists; there is none yet"
        return refuse("map.unknown", field="map", expected=expected, got=map_id)

    def _manifests(self, refs: Sequence[tuple[str, str]]) -> Iterator[AnyManifest]:
        """The manifests of versions; raises NotFound and MapCorrupt in their turn."""
        for (map_id, version), found in zip(refs, self.backend.manifests(refs), strict=True):
            if found is None:
                self._found(f"{map_id}@{version}")
                field = self.backend.address(map_id, version, MANIFEST)
                raise refuse(
                    "map.manifest", "two global descriptors have the same name", field=field
                )
            if isinstance(found, MapCorrupt):
                raise found
            yield found

    def _any_version(self, map_id: str) -> AnyManifest | None:
        """The manifest of any version of a map or set; None when none can be read."""
        found = self.backend.manifests([(map_id, version) for version in self.versions(map_id)])
        return next((one for one in found if one and not isinstance(one, MapCorrupt)), None)

    def _may_be_tile(self, map_id: str, version: str) -> bool:
        """Tell whether sets may name a version; a damaged one is judged by its files."""
        (manifest,) = self.backend.manifests([(map_id, version)])
        if manifest is None or isinstance(manifest, MapCorrupt):
            has_poses = self.backend.has_file(map_id, version, _IMAGE_POSES)
            return has_poses or not self.backend.has_file(map_id, version, SET_OFFSETS)
        return isinstance(manifest, Manifest)

    def _looks_like_map(self, map_id: str, version: str) -> bool:
        """Whether a version's files show that it is a map; a damaged map may lack them."""
        has_poses = self.backend.has_file(map_id, version, _IMAGE_POSES)
        return has_poses and not self.backend.has_file(map_id, version, SET_OFFSETS)

    def _sets_in_use(self, leaving: tuple[str, str]) -> Iterator[tuple[str, AnyManifest]]:
        """The current sets except ``leaving``; every version of an id whose ``current`` is damaged.

        Maps may be among them.
        """
        refs = []
        for map_id in self.ids():
            current = self.backend.current(map_id)
            if current is not None:
                is_name = ID_PATTERN.fullmatch(current)
                versions = [current] if is_name else self.versions(map_id)
                refs += [(map_id, version) for version in versions]
        refs = [ref for ref in refs if ref != leaving]
        if self.backend.is_local:  # with thousands of maps, reading their manifests takes longer
            refs = [ref for ref in refs if not self._looks_like_map(*ref)]
        for (map_id, version), found in zip(refs, self.backend.manifests(refs), strict=True):
            ref = f"{map_id}@{version}"
            if isinstance(found, MapCorrupt):
                if not self._looks_like_map(map_id, version):
                    raise unreadable_set(ref, found) from found
            elif found is not None:  # it is None if another server has just removed it
                yield ref, found


def open_published(folder: Path) -> Map:
    """Open the map in a folder ``<id>/<version>``."""
    opened = open_map(folder)
    refuse_renamed(opened.manifest, str(folder), folder.parent.name, folder.name)
    return opened
