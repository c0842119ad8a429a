"""Maps in object storage, such as ``s3://bucket/maps``, with copies on this machine.

Objects are laid out as in a folder of maps (docs/map-format.md). Whatever is fetched is verified.
While the storage is away, the last index and the copies go on.
"""

from __future__ import annotations

import hashlib
import logging
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from time import monotonic

from visloc.archive.backends.base import CURRENT, MANIFEST
from visloc.archive.checks import (
    MAX_MANIFEST_BYTES,
    check_files,
    parse_any_manifest,
    read_any_manifest,
)
from visloc.archive.kinds import verify_any
from visloc.archive.reader import MapOutline
from visloc.archive.schema import FILE_NAME
from visloc.archive.set_outline import SetOutline, read_any_outline
from visloc.archive.set_rules import AnyManifest
from visloc.archive.set_schema import SetManifest
from visloc.archive.version_rules import refuse_renamed
from visloc.errors import Conflict, MapCorrupt, Unavailable, VislocError, refuse
from visloc_extensions.object_storage.copies import Copies, size_of
from visloc_extensions.object_storage.publication import Publisher
from visloc_extensions.object_storage.published_index import PublishedIndex
from visloc_extensions.object_storage.storage import Storage

logger = logging.getLogger(__name__)


class ObjectBackend:
    """The backend of an fsspec URL; ``Backend`` says what each method does."""

    is_local = False

    def __init__(self, url: str, cache_dir: Path, max_cache_bytes: int) -> None:
        self.storage = Storage(url)
        name = hashlib.sha256(url.encode()).hexdigest()[:16]
        self.copies = Copies(cache_dir / name, max_cache_bytes)
        self._index = PublishedIndex(self.storage, self.copies.root / ".index.json")
        self._publisher = Publisher(self.storage)
        self._changing = threading.Lock()
        self._guard, self._locks = threading.Lock(), dict[str, threading.Lock]()

    @property
    def reachable(self) -> bool:
        return not self.storage.is_away

    def ids(self) -> list[str]:
        maps = self._index.maps()
        return sorted(map_id for map_id, published in maps.items() if published.current is not None)

    def versions(self, map_id: str) -> list[str]:
        return list(self._index.of(map_id).versions)

    def current(self, map_id: str) -> str | None:
        return self._index.current(map_id)

    def has_version(self, map_id: str, version: str) -> bool:
        return self._index.has(map_id, version)

    def has_file(self, map_id: str, version: str, name: str) -> bool:
        return self.storage.exists(self.storage.path(map_id, version, name))

    def address(self, *names: str) -> str:
        return "/".join((self.storage.url, *names))

    # Rules go by what the storage has, never by copies: one may be damaged, or of another version
    # that had the same name.
    def manifests(
        self, refs: Sequence[tuple[str, str]]
    ) -> Iterator[AnyManifest | MapCorrupt | None]:
        contents = self.storage.contents([self.storage.path(*ref, MANIFEST) for ref in refs])
        for ref, content in zip(refs, contents, strict=True):
            if content is None:
                yield None
                continue
            try:
                yield parse_any_manifest(content, self.address(*ref, MANIFEST))
            except MapCorrupt as error:
                yield error

    def local_folder(self, map_id: str, version: str) -> Path | None:
        copy = self.copies.get(map_id, version)
        if copy is None or not (self._is_compared(map_id, version) or self.storage.is_away):
            return None
        return self.copies.used(copy)

    def folder(self, map_id: str, version: str) -> Path:
        with self._lock_of(map_id, version):
            copy = self.copies.get(map_id, version)
            if copy is not None and not self._is_up_to_date(copy, map_id, version):
                self.copies.remove(map_id, version)
                copy = None
            if copy is None:
                copy = self._fetch(map_id, version)
                self._index.compared.add(f"{map_id}@{version}")
            return self.copies.used(copy)

    def outline(self, map_id: str, version: str) -> MapOutline | SetOutline:
        copy = self.copies.get(map_id, version)
        if copy is not None:
            outline = read_any_outline(copy)
            check_files(copy, outline.manifest)
        else:
            with tempfile.TemporaryDirectory() as folder:
                here = Path(folder)
                self._fetch_small(map_id, version, MANIFEST, here)
                if not isinstance(read_any_manifest(here), SetManifest):
                    self._fetch_small(map_id, version, "cameras.json", here)
                outline = read_any_outline(here)
        refuse_renamed(outline.manifest, self.address(map_id, version), map_id, version)
        return outline

    @contextmanager
    def changing(self) -> Iterator[None]:
        with self._changing:
            self._index.update()
            yield

    def publish(
        self,
        incoming: Path,
        map_id: str,
        version: str,
        *,
        make_current: bool,
        based_on: str | None,
    ) -> Path:
        known = self._index.of(map_id)
        with self._lock_of(map_id, version):
            self.copies.remove(map_id, version)  # of one that another server has removed
            self.copies.make_room(size_of(incoming))
            copy = self.copies.keep(incoming, map_id, version)
            try:
                self._publisher.write(copy, map_id, version)
                versions = (*known.versions, version)
                self._index.note(map_id, versions, known.current)
                if make_current:
                    self._publisher.write_current(map_id, version, based_on)
                    self._index.note(map_id, versions, version)
            except BaseException:
                self.copies.remove(map_id, version)
                raise
            self._index.compared.add(f"{map_id}@{version}")
        return copy

    def set_current(self, map_id: str, version: str) -> None:
        self._publisher.write_current(map_id, version)
        self._index.note(map_id, self.versions(map_id), version)

    def withdraw(self, map_id: str) -> None:
        with self.storage.asking(), suppress(FileNotFoundError):
            self.storage.fs.rm_file(self.storage.path(map_id, CURRENT))
        self._index.note(map_id, self.versions(map_id), None)

    def remove(self, map_id: str, version: str, *, is_last: bool) -> Callable[[], object]:
        known, fs = self._index.of(map_id), self.storage.fs
        with self._lock_of(map_id, version):
            place = self.storage.path(map_id, version)
            with self.storage.asking():
                if is_last and known.current is not None:
                    fs.rm_file(self.storage.path(map_id, CURRENT))
                fs.rm_file(f"{place}/{MANIFEST}")
                if fs.exists(place):
                    fs.rm(place, recursive=True)
            others = [name for name in known.versions if name != version]
            self._index.note(map_id, others, None if is_last else known.current)
        return lambda: self.copies.remove(map_id, version)

    def incoming(self) -> AbstractContextManager[Path]:
        return self.copies.incoming()

    def sweep(self) -> None:
        self.copies.sweep()

    def _is_compared(self, map_id: str, version: str) -> bool:
        return f"{map_id}@{version}" in self._index.compared

    def _is_up_to_date(self, copy: Path, map_id: str, version: str) -> bool:
        """Tell whether a copy is of the version that the storage has; compared once per version.

        A version never changes, but it may have been removed and another one of its name published
        while this server was down. While the storage is away, copies are trusted.
        """
        if self._is_compared(map_id, version) or self.storage.is_away:
            return True
        try:
            (now,) = self.storage.contents([self.storage.path(map_id, version, MANIFEST)])
        except Unavailable:
            return True
        if now is None:
            return False
        self._index.compared.add(f"{map_id}@{version}")
        return now == (copy / MANIFEST).read_bytes()

    def _fetch(self, map_id: str, version: str) -> Path:
        place = self.storage.path(map_id, version)
        logger.info("fetching %s@%s from %s", map_id, version, self.storage.url)
        start = monotonic()
        with self.copies.incoming() as incoming:
            target = incoming / "map"
            target.mkdir()
            with self.storage.asking():
                sizes = self.storage.sizes_in(place)
            if MANIFEST not in sizes:
                raise refuse("map.version", "the version was removed", field="map", got=version)
            self._fetch_small(map_id, version, MANIFEST, target)
            manifest = read_any_manifest(target)
            self.copies.make_room(sum(entry.size for entry in manifest.files.values()))
            for name, entry in manifest.files.items():
                if not FILE_NAME.fullmatch(name) or sizes.get(name) != entry.size:
                    raise self._damaged(map_id, version, name, "is missing or of another size")
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                self.storage.fetch(f"{place}/{name}", target / name)
            refuse_renamed(verify_any(target).manifest, str(target), map_id, version)
            with suppress(Conflict):  # another process with the same copies was faster
                self.copies.keep(target, map_id, version)
        logger.info("%s@%s fetched in %.1f s", map_id, version, monotonic() - start)
        return self.copies.root / map_id / version

    def _fetch_small(self, map_id: str, version: str, name: str, folder: Path) -> None:
        path = self.storage.path(map_id, version, name)
        with self.storage.asking():
            try:
                if self.storage.fs.size(path) > MAX_MANIFEST_BYTES:
                    raise self._damaged(map_id, version, name, "is too large")
                self.storage.fs.get_file(path, str(folder / name))
            except FileNotFoundError:
                raise self._damaged(map_id, version, name, "is missing") from None

    def _damaged(self, map_id: str, version: str, name: str, why: str) -> VislocError:
        return refuse(
            "map.file_size",
            f"a file of the map in the storage {why}",
            field=self.address(map_id, version, name),
        )

    def _lock_of(self, map_id: str, version: str) -> threading.Lock:
        with self._guard:
            return self._locks.setdefault(f"{map_id}@{version}", threading.Lock())
