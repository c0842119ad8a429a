"""The index of what object storage has published, at most a few seconds old.

While the storage is away, the last index goes on. It is also kept in a file, for a start without
the storage.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic

from pydantic import RootModel, ValidationError

from visloc.archive.backends.base import CURRENT, MANIFEST, text_of_current
from visloc.errors import Unavailable
from visloc_extensions.object_storage.storage import NEVER, Storage

logger = logging.getLogger(__name__)

# How old an answer may be.
INDEX_S = 5.0
# The same for the answer that there is no such map or version: another server may just have
# published it.
UNKNOWN_S = 1.0


@dataclass(frozen=True, slots=True)
class Published:
    """The versions of one map, sorted, and the text of its file ``current``."""

    versions: tuple[str, ...] = ()
    current: str | None = None


class PublishedIndex:
    """Knows the versions of all maps in a storage.

    Attributes:
        compared: references ``id@version`` whose local copy was compared with the storage. One
            that disappears is dropped: under the same name, another version may come.
    """

    def __init__(self, storage: Storage, file: Path) -> None:
        self.compared: set[str] = set()
        self._storage, self._file = storage, file
        self._maps: Mapping[str, Published] | None = None
        self._asked_at = NEVER
        self._asking = threading.Lock()

    def maps(self, age_s: float | None = None) -> Mapping[str, Published]:
        """The published maps by id; the last known index while the storage is away.

        Args:
            age_s: how old it may be; ``INDEX_S`` when None.
        """
        age_s = INDEX_S if age_s is None else min(age_s, INDEX_S)
        maps, now = self._maps, monotonic()
        if maps is not None and (now - self._asked_at < age_s or now < self._storage.away_until):
            return maps
        if not self._asking.acquire(blocking=maps is None):
            assert maps is not None
            return maps  # another thread is asking
        if maps is not None and self._storage.is_away:  # nobody shall wait for it again
            threading.Thread(target=self._refresh, args=(age_s,), daemon=True).start()
            return maps
        self._refresh(age_s)
        if self._maps is None:
            raise self._storage.away("nothing is known of it yet")
        return self._maps

    def of(self, map_id: str, age_s: float | None = None) -> Published:
        """The published versions of one map."""
        return self.maps(age_s).get(map_id, Published())

    def current(self, map_id: str) -> str | None:
        """The text of the file ``current``; asked again soon if there is none."""
        current = self.of(map_id).current
        return self.of(map_id, UNKNOWN_S).current if current is None else current

    def has(self, map_id: str, version: str) -> bool:
        """Tell whether a version is published; asked again soon if it is not."""
        return any(version in self.of(map_id, age_s).versions for age_s in (None, UNKNOWN_S))

    def update(self) -> None:
        """Ask now."""
        with self._asking:
            self._keep(self._ask())

    def note(self, map_id: str, versions: Iterable[str], current: str | None) -> None:
        """Note what this process has just written, without asking."""
        with self._asking:
            maps = dict(self._maps or {})
            maps[map_id] = Published(tuple(sorted(versions)), current)
            if not maps[map_id].versions:
                del maps[map_id]
            self._keep(maps)

    def _refresh(self, age_s: float) -> None:
        """Ask if the index is old, once the lock is held, and release that."""
        try:
            if monotonic() - self._asked_at >= age_s:
                self._keep(self._ask())
        except Unavailable:
            if self._maps is None:
                self._maps = self._read_kept()
        finally:
            self._asking.release()

    def _ask(self) -> dict[str, Published]:
        before, storage = self._maps or {}, self._storage
        versions: dict[str, tuple[str, ...]] = {}
        with storage.asking():
            storage.fs.invalidate_cache()
            for map_id in storage.names_in(storage.root):
                known = before.get(map_id, Published()).versions
                # One look at the manifest of a version is enough: a version that is removed goes
                # whole, except for the moment that this takes.
                versions[map_id] = tuple(
                    name
                    for name in storage.names_in(storage.path(map_id))
                    if name != CURRENT
                    and (name in known or storage.fs.exists(storage.path(map_id, name, MANIFEST)))
                )
        contents = storage.contents([storage.path(map_id, CURRENT) for map_id in versions])
        return {
            map_id: Published(names, None if content is None else text_of_current(content))
            for (map_id, names), content in zip(versions.items(), contents, strict=True)
            if names
        }

    def _keep(self, maps: Mapping[str, Published]) -> None:
        if maps != self._maps:
            text = json.dumps({map_id: asdict(published) for map_id, published in maps.items()})
            partial = self._file.with_name(f"{self._file.name}.{os.getpid()}")
            try:
                self._file.parent.mkdir(parents=True, exist_ok=True)
                partial.write_text(text)
                partial.replace(self._file)
            except OSError as error:  # it is for the next start only
                logger.warning("cannot keep the index of %s: %s", self._storage.url, error)
        self.compared &= {f"{map_id}@{v}" for map_id, one in maps.items() for v in one.versions}
        self._maps, self._asked_at = maps, monotonic()

    def _read_kept(self) -> Mapping[str, Published] | None:
        try:
            text = self._file.read_text()
            return RootModel[dict[str, Published]].model_validate_json(text).root
        except (FileNotFoundError, UnicodeDecodeError, ValidationError):
            return None
