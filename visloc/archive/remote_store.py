"""Maps of an fsspec URL such as ``s3://bucket/maps``, with copies on this machine.

Objects are laid out as in a folder of maps (docs/map-format.md). Renames are not to be had there:
``manifest.json`` is written last and deleted first, so that its presence publishes a version.

Answers come from an index that is a few seconds old at most. While the storage is away, the last
index and the copies go on; the index is kept with the copies, for a start without the storage.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

import fsspec
from pydantic import RootModel, ValidationError

from visloc.archive.checks import read_any_manifest
from visloc.archive.packed import FILE_NAME, MANIFEST
from visloc.archive.reader import MapOutline
from visloc.archive.schema import ID_PATTERN
from visloc.archive.set_rules import (
    AnyManifest,
    refuse_if_tile,
    refuse_missing_tiles,
    refuse_other_kind,
    unreadable_set,
)
from visloc.archive.set_schema import SetManifest
from visloc.archive.sets import SetOutline, read_any_outline
from visloc.archive.store import (
    CURRENT,
    FULL,
    MapStore,
    checked_name,
    looks_like_map,
    may_be_tile,
    none_in_use,
    outdated,
    read_published_outline,
    refuse_renamed,
    version_exists,
    version_in_use,
)
from visloc.errors import (
    Conflict,
    MapCorrupt,
    NotFound,
    Unavailable,
    VislocError,
    refuse,
)

logger = logging.getLogger(__name__)

# How old an answer may be.
INDEX_S = 5.0
# The same for the answer that there is no such map or version: another server may just have
# published it.
UNKNOWN_S = 1.0
# After a failure the storage is left alone for so long.
AWAY_S = 5.0
CONNECT_TIMEOUT_S, READ_TIMEOUT_S = 3, 10
NEVER = -math.inf
_INDEX_FILE = ".index.json"
_MAX_MANIFEST_BYTES = 16 * 2**20
_AT_ONCE = 256  # manifests that are asked for together


@dataclass(frozen=True, slots=True)
class _Versions:
    """What the storage has of one map: versions, sorted, and what its file ``current`` says."""

    versions: tuple[str, ...]
    current: str | None


_Index = Mapping[str, _Versions]


class RemoteMapStore:
    """Finds, fetches, publishes and removes the maps of a URL; what ``MapStore`` does for a folder.

    One server at a time should publish a given version. Whatever is fetched is verified.
    """

    def __init__(self, url: str, cache_dir: Path, max_cache_bytes: int) -> None:
        """Nothing is asked of the storage yet.

        Args:
            url: as fsspec has it. Credentials come from the environment, as the storage's own
                tools read them; what the URL may carry of them is never shown.
            cache_dir: folder of the copies; several URLs may share it.
            max_cache_bytes: room for copies; the least recently used are deleted first.

        Raises:
            ImportError: when what the URL needs is not installed.
            ValueError: for a URL that cannot be used.
        """
        if "::" in url:
            raise ValueError("URLs of several parts (::) are not for maps")
        self.url = _without_credentials(url)
        self._fs, self._root = fsspec.core.url_to_fs(url, **_options_for(url))
        self._root = self._root.rstrip("/")
        self._is_s3 = urlsplit(url).scheme == "s3"
        if self._is_s3:
            self._fs.retries = 2  # of five, each up to the timeout
        self._copies = MapStore(cache_dir / hashlib.sha256(url.encode()).hexdigest()[:16])
        self._max_bytes = max_cache_bytes
        self._index: _Index | None = None
        self._index_at = self._away_until = NEVER
        self._indexing, self._changing = threading.Lock(), threading.Lock()
        self._guard = threading.Lock()
        self._locks: dict[str, threading.Lock] = {}
        self._compared: set[str] = set()

    @property
    def reachable(self) -> bool:
        """Whether the remote answered when it was last asked."""
        return not self._is_away

    def ids(self) -> list[str]:
        """Ids of the maps that have a current version, sorted."""
        return sorted(name for name, known in self._known().items() if known.current is not None)

    def versions(self, map_id: str) -> list[str]:
        """Published versions of a map, oldest first."""
        checked_name(map_id, "map")
        known = self._known().get(map_id)
        return [] if known is None else list(known.versions)

    def current_version(self, map_id: str) -> str:
        """The version in use.

        Raises:
            NotFound: ``map.unknown``, ``map.none_in_use``.
            MapCorrupt: ``map.current`` when the object that names it is damaged.
            Unavailable: ``maps.storage_away`` when nothing is known of the storage.
        """
        checked_name(map_id, "map")
        known = self._known().get(map_id)
        if known is None or known.current is None:
            known = self._known(UNKNOWN_S).get(map_id)
        if known is None:
            raise self._unknown_map(map_id)
        if known.current is None:
            raise none_in_use(map_id, known.versions)
        if not ID_PATTERN.fullmatch(known.current):
            raise refuse("map.current", field=f"{self.url}/{map_id}/{CURRENT}", got=known.current)
        return known.current

    def at_hand(self, ref: str) -> Path | None:
        """The copy of ``id@version``, None when it has to be fetched or compared first.

        Raises:
            NotFound: ``map.unknown`` or ``map.version``.
        """
        map_id, _, version = ref.partition("@")
        self._refuse_unknown(map_id, version)
        copy = self._copies.root / map_id / version
        if not copy.is_dir() or not (ref in self._compared or self._is_away):
            return None
        with suppress(OSError):  # a copy on a read-only disk has no time of last use
            os.utime(copy)
        return copy

    def outline(self, ref: str) -> MapOutline | SetOutline:
        """Say what ``id`` or ``id@version`` is; of one without a copy here, two files are fetched.

        Raises:
            InvalidInput: ``map.id`` for a reference that is neither.
            NotFound: ``map.unknown`` or ``map.version``.
            MapCorrupt: when what was fetched is not what it should be.
            Unavailable: ``maps.storage_away`` when it is not here and cannot be fetched.
        """
        map_id, at, version = ref.partition("@")
        if not at:
            version = self.current_version(map_id)
        self._refuse_unknown(map_id, version)
        copy = self._copies.root / map_id / version
        if copy.is_dir():
            return read_published_outline(copy)
        with tempfile.TemporaryDirectory() as folder:
            here = Path(folder)
            self._fetch_small(map_id, version, MANIFEST, here)
            if not isinstance(read_any_manifest(here), SetManifest):
                self._fetch_small(map_id, version, "cameras.json", here)
            outline = read_any_outline(here)
        place = Path(self._place(map_id, version))
        refuse_renamed(outline.manifest, place, map_id, version)
        return outline

    def folder(self, ref: str) -> Path:
        """The copy of ``id`` (its current version) or ``id@version``, fetched when it is not here.

        Raises:
            InvalidInput: ``map.id`` for a reference that is neither.
            NotFound: ``map.unknown`` or ``map.version``.
            MapCorrupt: when what was fetched is not what its manifest says.
            Unavailable: ``maps.storage_away`` when it is not here and cannot be fetched.
            StorageFull: ``maps.storage_full`` when there is no room for it.
        """
        map_id, at, version = ref.partition("@")
        if not at:
            version = self.current_version(map_id)
        self._refuse_unknown(map_id, version)
        ref = f"{map_id}@{version}"
        with self._lock_of(ref):
            copy = self._copies.root / map_id / version
            if copy.is_dir() and not self._is_of_today(copy, ref):
                self._copies.remove(map_id, version)
            if not copy.is_dir():
                self._fetch(map_id, version)
                self._compared.add(ref)
            with suppress(OSError):  # a copy on a read-only disk has no time of last use
                os.utime(copy)
            return copy

    def publish(
        self,
        incoming: Path,
        map_id: str,
        version: str,
        *,
        make_current: bool = True,
        based_on: str | None = None,
    ) -> Path:
        """Verify a map and write it to the storage; manifest last, then ``current``.

        Interrupted before the manifest, nothing of it is visible, and the next attempt starts
        anew; before ``current``, the version is there and the one before it stays in use.

        Raises:
            Conflict, NotFound, MapCorrupt: as of ``MapStore.publish``.
            Unavailable: ``maps.storage_away``.
        """
        checked_name(map_id, "map")
        checked_name(version, "map version")
        with self._changing, self._lock_of(f"{map_id}@{version}"):
            known = self._versions_now(map_id)
            if version in known.versions:
                raise version_exists(map_id, version)
            if based_on is not None and known.current != based_on:
                raise outdated(map_id, based_on, known.current)
            manifest = read_any_manifest(incoming)
            refuse_other_kind(manifest, self._any_version(map_id, known))
            refuse_missing_tiles(manifest, self._manifests)
            with suppress(NotFound):  # the copy of one that was removed by another server
                self._copies.remove(map_id, version)
            self._make_room(_size_of(incoming))
            copy = self._copies.keep_copy(incoming, map_id, version)
            try:
                self._write(copy, self._place(map_id, version))
                if make_current:
                    self._write_current(map_id, version)
            except BaseException:
                self._copies.remove(map_id, version)
                raise
            self._compared.add(f"{map_id}@{version}")
            self._keep_changed(
                map_id,
                (*known.versions, version),
                version if make_current else known.current,
            )
        return copy

    def set_current(self, map_id: str, version: str) -> None:
        """Make a published version the one in use.

        Raises:
            NotFound, Conflict: as of ``MapStore.set_current``.
            Unavailable: ``maps.storage_away``.
        """
        with self._changing:
            known = self._versions_now(checked_name(map_id, "map"))
            self._refuse_unknown(map_id, version)
            refuse_missing_tiles(self._manifest(map_id, version), self._manifests)
            self._write_current(map_id, version)
            self._keep_changed(map_id, known.versions, version)

    def remove(self, map_id: str, version: str) -> None:
        """Remove a version, its manifest first; with the last one, the map.

        Raises:
            NotFound, Conflict: as of ``MapStore.remove``.
            Unavailable: ``maps.storage_away``.
        """
        with self._changing, self._lock_of(f"{map_id}@{version}"):
            known = self._versions_now(checked_name(map_id, "map"))
            self._refuse_unknown(map_id, version)
            others = [name for name in known.versions if name != version]
            if others and known.current == version:
                raise version_in_use(map_id, version, others)
            has = self._has_file(map_id, version)
            if may_be_tile(lambda: self._manifest(map_id, version), has):
                refuse_if_tile(map_id, version, self._in_use((map_id, version)))
            place = self._place(map_id, version)
            with self._asking():
                if not others and known.current is not None:
                    self._fs.rm_file(f"{self._root}/{map_id}/{CURRENT}")
                self._fs.rm_file(f"{place}/{MANIFEST}")
                if self._fs.exists(place):
                    self._fs.rm(place, recursive=True)
            self._keep_changed(map_id, others, known.current if others else None)
            with suppress(NotFound):
                self._copies.remove(map_id, version)

    def incoming(self) -> AbstractContextManager[Path]:
        """Give an empty folder beside the copies; as of ``MapStore``."""
        return self._copies.incoming()

    def sweep(self) -> None:
        """Delete what uploads and fetches left behind whose process was killed."""
        self._copies.sweep()

    # What the storage has

    def _known(self, age_s: float | None = None) -> _Index:
        """The index, asked for anew when it is old; the last one while the storage is away.

        Args:
            age_s: from when on it is old; ``INDEX_S`` when None.
        """
        age_s = INDEX_S if age_s is None else min(age_s, INDEX_S)
        index = self._index
        now = monotonic()
        if index is not None and (now - self._index_at < age_s or now < self._away_until):
            return index
        if not self._indexing.acquire(blocking=index is None):
            assert index is not None
            return index  # another thread is asking
        if index is not None and self._is_away:  # nobody shall wait for it again
            threading.Thread(target=self._refresh, args=(age_s,), daemon=True).start()
            return index
        self._refresh(age_s)
        if self._index is None:
            raise self._away("nothing is known of it yet")
        return self._index

    def _refresh(self, age_s: float) -> None:
        """Ask for an index that is old, once ``_indexing`` is held, and release that."""
        try:
            if monotonic() - self._index_at >= age_s:
                self._keep(self._ask())
        except Unavailable:
            if self._index is None:
                self._index = self._read_kept()
        finally:
            self._indexing.release()

    @property
    def _is_away(self) -> bool:
        return self._away_until > NEVER

    def _versions_now(self, map_id: str) -> _Versions:
        """What the storage has of a map at this moment."""
        with self._indexing:
            self._keep(self._ask())
        assert self._index is not None
        return self._index.get(map_id, _Versions((), None))

    def _keep_changed(self, map_id: str, versions: Iterable[str], current: str | None) -> None:
        """Note in the index what was just written, without asking."""
        with self._indexing:
            index = dict(self._index or {})
            index[map_id] = _Versions(tuple(sorted(versions)), current)
            if not index[map_id].versions:
                del index[map_id]
            self._keep(index)

    def _ask(self) -> _Index:
        before = self._index or {}
        with self._asking():
            self._fs.invalidate_cache()
            found: dict[str, _Versions] = {}
            for map_id in self._names_in(self._root):
                known = before.get(map_id, _Versions((), None))
                place = f"{self._root}/{map_id}"
                # One look at the manifest of a version is enough: a version that is removed goes
                # whole, but for the moment that this takes.
                versions = tuple(
                    name
                    for name in self._names_in(place)
                    if name != CURRENT
                    and (name in known.versions or self._fs.exists(f"{place}/{name}/{MANIFEST}"))
                )
                found[map_id] = _Versions(versions, None)
            places = {map_id: f"{self._root}/{map_id}/{CURRENT}" for map_id in found}
            contents = self._fs.cat(list(places.values()), on_error="return") if places else {}
            for map_id, place in places.items():
                content = contents[place]
                if isinstance(content, bytes):
                    text = content[:200].decode("ascii", "backslashreplace").strip()
                    found[map_id] = replace(found[map_id], current=text)
                elif not isinstance(content, FileNotFoundError):
                    raise content
            return {map_id: known for map_id, known in found.items() if known.versions}

    def _names_in(self, place: str) -> list[str]:
        try:
            listed = self._fs.ls(place, detail=False)
        except FileNotFoundError:
            return []
        names = (PurePosixPath(path).name for path in listed)
        return sorted({name for name in names if ID_PATTERN.fullmatch(name)})

    def _keep(self, index: _Index) -> None:
        if index != self._index:
            text = json.dumps({name: asdict(known) for name, known in index.items()})
            partial = self._copies.root / f"{_INDEX_FILE}.{os.getpid()}"
            try:
                self._copies.root.mkdir(parents=True, exist_ok=True)
                partial.write_text(text)
                partial.replace(self._copies.root / _INDEX_FILE)
            except OSError as error:  # it is for the next start only
                logger.warning("what is known of %s cannot be kept: %s", self.url, error)
        published = {f"{name}@{v}" for name, known in index.items() for v in known.versions}
        self._compared &= published  # one that comes again may be another
        self._index, self._index_at = index, monotonic()

    def _read_kept(self) -> _Index | None:
        try:
            text = (self._copies.root / _INDEX_FILE).read_text()
            return RootModel[dict[str, _Versions]].model_validate_json(text).root
        except (FileNotFoundError, UnicodeDecodeError, ValidationError):
            return None

    def _refuse_unknown(self, map_id: str, version: str) -> None:
        checked_name(map_id, "map")
        checked_name(version, "map version")
        versions = self.versions(map_id)
        if version not in versions:
            known = self._known(UNKNOWN_S).get(map_id)
            versions = [] if known is None else list(known.versions)
        if not versions:
            raise self._unknown_map(map_id)
        if version not in versions:
            raise refuse("map.version", field="map", expected=versions, got=version, map_id=map_id)

    def _unknown_map(self, map_id: str) -> VislocError:
        known = ", ".join(self.ids()) or "none"
        return refuse("map.unknown", field="map", expected=f"one of {known}", got=map_id)

    # Manifests

    # Rules go by what the storage has, never by copies: one may be damaged, or of another version
    # that had the same name.

    def _contents(self, refs: Sequence[tuple[str, str]]) -> Iterator[bytes | None]:
        """The files ``manifest.json`` of versions, in their order; None where there is none.

        Raises:
            Unavailable: ``maps.storage_away``.
        """
        for start in range(0, len(refs), _AT_ONCE):
            places = [f"{self._place(*ref)}/{MANIFEST}" for ref in refs[start : start + _AT_ONCE]]
            with self._asking():
                found = self._fs.cat(places, on_error="return")
                for place in places:
                    if not isinstance(found[place], bytes | FileNotFoundError):
                        raise found[place]
            for place in places:
                yield found[place] if isinstance(found[place], bytes) else None

    def _manifests(self, refs: Sequence[tuple[str, str]]) -> Iterator[AnyManifest]:
        """The manifests of versions, in their order.

        Raises:
            NotFound: ``map.unknown`` or ``map.version``.
            MapCorrupt: when one is damaged.
            Unavailable: ``maps.storage_away``.
        """
        for ref, content in zip(refs, self._contents(refs), strict=True):
            self._refuse_unknown(*ref)
            yield self._parsed(*ref, content)

    def _parsed(self, map_id: str, version: str, content: bytes | None) -> AnyManifest:
        if content is None:
            raise self._damaged(map_id, version, MANIFEST, "is missing")
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / MANIFEST).write_bytes(content)
            return read_any_manifest(Path(folder))

    def _manifest(self, map_id: str, version: str) -> AnyManifest:
        """As ``_manifests``, of one."""
        return next(self._manifests([(map_id, version)]))

    def _any_version(self, map_id: str, known: _Versions) -> AnyManifest | None:
        """The manifest of any version of a map or set; None when none can be read."""
        for version in known.versions:
            with suppress(MapCorrupt, NotFound):
                return self._manifest(map_id, version)
        return None

    def _in_use(self, leaving: tuple[str, str]) -> Iterator[tuple[str, AnyManifest]]:
        """What is in use but for ``leaving``; of an id whose ``current`` is damaged, all versions.

        Raises:
            Conflict: ``map.in_set`` for a set that cannot be read.
        """
        refs = []
        for map_id, known in self._known().items():
            if known.current is not None:
                is_name = ID_PATTERN.fullmatch(known.current)
                versions = (known.current,) if is_name else known.versions
                refs += [(map_id, version) for version in versions]
        refs = [ref for ref in refs if ref != leaving]
        for (map_id, version), content in zip(refs, self._contents(refs), strict=True):
            ref = f"{map_id}@{version}"
            if content is None:  # another server has just removed it
                continue
            try:
                yield ref, self._parsed(map_id, version, content)
            except MapCorrupt as error:
                if not looks_like_map(self._has_file(map_id, version)):
                    raise unreadable_set(ref, error) from error

    def _has_file(self, map_id: str, version: str) -> Callable[[str], bool]:
        """What tells whether a version in the storage has a file."""

        def has(name: str) -> bool:
            with self._asking():
                return bool(self._fs.exists(f"{self._place(map_id, version)}/{name}"))

        return has

    def _fetch_small(self, map_id: str, version: str, name: str, folder: Path) -> None:
        place = f"{self._place(map_id, version)}/{name}"
        with self._asking():
            try:
                if self._fs.size(place) > _MAX_MANIFEST_BYTES:
                    raise self._damaged(map_id, version, name, "is too large")
                self._fs.get_file(place, str(folder / name))
            except FileNotFoundError:
                raise self._damaged(map_id, version, name, "is missing") from None

    # Copies

    def _is_of_today(self, copy: Path, ref: str) -> bool:
        """Whether a copy is of what the storage has under its name; told once per version.

        A version never changes, but one may have been removed and another one of its name
        published while this server was down. While the storage is away, copies are trusted.
        """
        if ref in self._compared or self._is_away:
            return True
        place = self._place(copy.parent.name, copy.name)
        try:
            with self._asking():
                try:
                    now = self._fs.cat_file(f"{place}/{MANIFEST}")
                except FileNotFoundError:
                    return False
        except Unavailable:
            return True
        self._compared.add(ref)
        return bool(now == (copy / MANIFEST).read_bytes())

    def _fetch(self, map_id: str, version: str) -> None:
        place = self._place(map_id, version)
        logger.info("fetching %s@%s from %s", map_id, version, self.url)
        start = monotonic()
        with self._copies.incoming() as incoming:
            target = incoming / "map"
            target.mkdir()
            with self._asking():
                try:
                    found = self._fs.find(place, detail=True)
                    sizes = {path[len(place) + 1 :]: info["size"] for path, info in found.items()}
                    if sizes[MANIFEST] > _MAX_MANIFEST_BYTES:
                        raise self._damaged(map_id, version, MANIFEST, "is too large")
                    self._fs.get_file(f"{place}/{MANIFEST}", str(target / MANIFEST))
                except (FileNotFoundError, KeyError):
                    raise refuse(
                        "map.version", "the version was removed", field="map", got=version
                    ) from None
            manifest = read_any_manifest(target)
            self._make_room(sum(entry.size for entry in manifest.files.values()))
            for name, entry in manifest.files.items():
                if not FILE_NAME.fullmatch(name) or sizes.get(name) != entry.size:
                    raise self._damaged(map_id, version, name, "is missing or of another size")
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                with self._asking():
                    self._fs.get_file(f"{place}/{name}", str(target / name))
            with suppress(Conflict):  # another process with the same cache was faster
                self._copies.keep_copy(target, map_id, version)
        logger.info("%s@%s fetched in %.1f s", map_id, version, monotonic() - start)

    def _make_room(self, size: int) -> None:
        """Delete the least recently used copies until a map of ``size`` bytes fits."""
        if size > self._max_bytes:
            raise refuse(
                "maps.storage_full",
                "the map is larger than the space for copies (max_cache_bytes)",
                field=str(self._copies.root),
                expected=f"at least {size} bytes",
                got=f"{self._max_bytes} bytes",
            )
        copies = []
        for folder in self._copies.root.glob("[!.]*/[!.]*"):
            with suppress(FileNotFoundError):  # another process with the same cache deletes it
                copies.append((folder.stat().st_mtime, _size_of(folder), folder))
        used = sum(size for _, size, _ in copies)
        for _, freed, folder in sorted(copies):
            if used + size <= self._max_bytes:
                return
            logger.info("deleting the copy of %s@%s to make room", folder.parent.name, folder.name)
            with suppress(NotFound):
                self._copies.remove(folder.parent.name, folder.name)
            used -= freed

    def _damaged(self, map_id: str, version: str, name: str, why: str) -> VislocError:
        return refuse(
            "map.file_size",
            f"a file of the map in the storage {why}",
            field=f"{self.url}/{map_id}/{version}/{name}",
        )

    # Changes

    def _write(self, folder: Path, place: str) -> None:
        with self._asking():
            if self._fs.exists(place):  # what an interrupted publication left
                self._fs.rm(place, recursive=True)
            files = sorted(path for path in folder.rglob("*") if path.is_file())
            files.sort(key=lambda path: path.name == MANIFEST)
            for path in files:
                target = f"{place}/{path.relative_to(folder).as_posix()}"
                if not self._is_s3:  # where it would create a bucket whose name was mistyped
                    self._fs.makedirs(target.rpartition("/")[0], exist_ok=True)
                self._fs.put_file(str(path), target)

    def _write_current(self, map_id: str, version: str) -> None:
        with self._asking():
            self._fs.pipe_file(f"{self._root}/{map_id}/{CURRENT}", f"{version}\n".encode())

    def _lock_of(self, ref: str) -> threading.Lock:
        with self._guard:
            return self._locks.setdefault(ref, threading.Lock())

    def _place(self, map_id: str, version: str) -> str:
        return f"{self._root}/{map_id}/{version}"

    @contextmanager
    def _asking(self) -> Iterator[None]:
        """Ask the storage; remember for a while when it does not answer.

        Raises:
            Unavailable: ``maps.storage_away``.
        """
        if monotonic() < self._away_until:
            raise self._away("it did not answer a moment ago")
        try:
            yield
        except VislocError:
            raise
        except FileNotFoundError:
            raise self._away("something is missing: removed just now, or no such bucket") from None
        except Exception as error:  # of whatever library serves the URL
            if isinstance(error, OSError) and error.errno in FULL:  # of this machine
                raise
            self._away_until = monotonic() + AWAY_S
            logger.warning("%s is away: %s", self.url, type(error).__name__)
            raise self._away(type(error).__name__) from None  # its text may tell secrets
        self._away_until = NEVER

    def _away(self, why: str) -> VislocError:
        return refuse("maps.storage_away", field=self.url, got=why)


def _options_for(url: str) -> dict[str, Any]:
    options: dict[str, Any] = {"skip_instance_cache": True, "use_listings_cache": False}
    if urlsplit(url).scheme == "s3":
        options["config_kwargs"] = {
            "connect_timeout": CONNECT_TIMEOUT_S,
            "read_timeout": READ_TIMEOUT_S,
            "retries": {"mode": "standard", "total_max_attempts": 1},
        }
    return options


def _without_credentials(url: str) -> str:
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}".rstrip("/")


def _size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
