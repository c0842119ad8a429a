"""The maps of a store, opened and warm, always in the version that is current."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from visloc.archive import Map, MapStore
from visloc.errors import Conflict, InvalidInput, MapCorrupt, VislocError
from visloc.features import LocalFeatureExtractor, make_local_features
from visloc.features.readymade import is_ready_made
from visloc.localizer import Localizer

logger = logging.getLogger(__name__)

# How long a published version that could not take over is left alone before it is tried again.
RETRY_AFTER_S = 30.0


@dataclass(frozen=True, slots=True)
class _Refused:
    """What is current on disk and could not be loaded.

    Attributes:
        ref: ``id@version``; ``id`` when the map does not say which version is current.
        error: why.
        at: when, by ``perf_counter``.
    """

    ref: str
    error: VislocError
    at: float


class LoadedMaps:
    """Opens maps when they are asked for and keeps them. Safe to use from several threads.

    The store is asked every time which version is current, so that a map that was published a
    moment ago is served without a restart. A version that cannot be opened leaves the one before
    it in service.

    Args:
        store: where the maps are.
        weights_dir: network weights, for maps whose features need them.
    """

    def __init__(self, store: MapStore, weights_dir: Path | None) -> None:
        self._store = store
        self._weights_dir = weights_dir
        self._loading = threading.Lock()
        self._localizers: dict[str, Localizer] = {}  # by id@version
        self._extractors: dict[str, LocalFeatureExtractor] = {}  # by name
        self._serving: dict[str, str] = {}  # id -> id@version last served as the current one
        self._refused: dict[str, _Refused] = {}  # by map id

    @property
    def refs(self) -> tuple[str, ...]:
        """``id@version`` of what is loaded, of the maps that are still there."""
        ids = set(self._store.ids())
        return tuple(ref for ref in sorted(self._localizers) if ref.partition("@")[0] in ids)

    @property
    def not_loaded(self) -> Mapping[str, VislocError]:
        """Why the current version of a map cannot be served, by map id."""
        ids = set(self._store.ids())
        return {
            map_id: refused.error
            for map_id, refused in sorted(self._refused.items())
            if map_id in ids
        }

    def load_all(self) -> None:
        """Open and warm up all current maps. One that is broken does not keep back the others."""
        for map_id in self._store.ids():
            try:
                self.localizer(map_id)
            except VislocError as error:
                logger.error("map %s is not loaded: %s", map_id, error)  # noqa: TRY400

    def localizer(self, ref: str) -> Localizer:
        """Return the localizer of a map, opened now if it was not before.

        Raises:
            Conflict: for a map of features that are not here.
            VislocError: what the store raises.
        """
        if "@" in ref:
            return self._loaded(ref)
        try:
            current = f"{ref}@{self._store.current_version(ref)}"
        except MapCorrupt as error:
            return self._fall_back(ref, ref, error)
        before, refused = self._serving.get(ref), self._refused.get(ref)
        if (
            before is not None
            and refused is not None
            and refused.ref == current
            and perf_counter() < refused.at + RETRY_AFTER_S
        ):
            return self._loaded(before)
        try:
            localizer = self._loaded(current)
        except VislocError as error:
            return self._fall_back(ref, current, error)
        self._refused.pop(ref, None)
        if before != current:
            self._serving[ref] = current
            if before is not None:
                self._localizers.pop(before, None)
        return localizer

    def _fall_back(self, map_id: str, current: str, error: VislocError) -> Localizer:
        """Note that what is current cannot be served, and return what was served before it."""
        before, known = self._serving.get(map_id), self._refused.get(map_id)
        self._refused[map_id] = _Refused(current, error, perf_counter())
        if before is None:
            raise error
        if known is None or known.ref != current:
            logger.error("map %s cannot take over, %s stays in service: %s", current, before, error)
        return self._loaded(before)

    def _loaded(self, ref: str) -> Localizer:
        found = self._localizers.get(ref)
        if found is not None:
            return found
        with self._loading:
            found = self._localizers.get(ref)  # another thread may have been faster
            if found is None:
                found = self._load(ref)
                self._localizers[ref] = found
            return found

    def _load(self, ref: str) -> Localizer:
        start = perf_counter()
        with _damage_named(ref):
            opened = self._store.open(ref)
            name = opened.manifest.local_features.fingerprint.name
            try:
                if name not in self._extractors and not is_ready_made(name):
                    self._extractors[name] = make_local_features(name, self._weights_dir)
                localizer = Localizer(opened, self._extractors.get(name))
            except InvalidInput as error:  # features that are not here: not the caller's mistake
                raise Conflict(
                    error.code,
                    error.message,
                    field=error.field,
                    expected=error.expected,
                    got=error.got,
                ) from error
            localizer.warm_up()
        logger.info("map %s loaded in %.1f s", opened.ref, perf_counter() - start)
        return localizer

    def find(self, ref: str) -> Map:
        """Return one map, ``id`` or ``id@version``, without keeping it open.

        Raises:
            VislocError: what the store raises.
        """
        wanted = ref if "@" in ref else self._served(ref)
        loaded = self._localizers.get(wanted)
        if loaded is not None:
            return loaded.map
        with _damage_named(wanted):
            return self._store.open(wanted)

    def _served(self, map_id: str) -> str:
        """Return ``id@version`` of what ``id`` stands for."""
        before, refused = self._serving.get(map_id), self._refused.get(map_id)
        try:
            current = f"{map_id}@{self._store.current_version(map_id)}"
        except MapCorrupt:
            if before is None:
                raise
            return before
        return before if before and refused and refused.ref == current else current

    def list(self) -> Sequence[Map]:
        """Return all maps that can be opened, in the version that is served, by id."""
        found = []
        for map_id in self._store.ids():
            try:
                found.append(self.find(map_id))
            except VislocError as error:
                logger.warning("map %s is not listed: %s", map_id, error)
        return found


@contextmanager
def _damage_named(ref: str) -> Iterator[None]:
    """Turn what should not happen while a map is opened into MapCorrupt ``map.unusable``.

    A damaged map can break the code that reads it in any way, and must not stop the others.
    """
    try:
        yield
    except VislocError:
        raise
    except Exception as error:
        logger.exception("map %s cannot be used", ref)
        raise MapCorrupt(
            "map.unusable",
            "the map cannot be used; rebuild it, or see the server's log for the cause",
            field=ref,
            got=type(error).__name__,
        ) from error
