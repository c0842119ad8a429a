"""The maps and sets that stay open in a worker process, with the networks that they share."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from time import perf_counter
from typing import Protocol

from service.values import Abandoned, MapFolder, OpenMap, Signals, WorkerSettings
from visloc.archive.kinds import kind_of_sets
from visloc.archive.store import open_published
from visloc.errors import Conflict, InvalidInput, VislocError, refuse
from visloc.features import (
    GlobalDescriptor,
    LocalFeatureExtractor,
    make_global_descriptor,
    make_local_features,
)
from visloc.features.local.readymade import is_ready_made
from visloc.features.networks.lightglue.load import make_lightglue
from visloc.localization.localizer import Localizer

logger = logging.getLogger(__name__)


class OpenSet(Protocol):
    """An object that an extension opens for a map id; ``Vision.in_set`` calls its other methods."""

    @property
    def size_bytes(self) -> int: ...

    def warm_up(self) -> None: ...


class OpenMaps:
    """Opens maps and sets when they are asked for, and closes the least recently used ones."""

    def __init__(self, settings: WorkerSettings, signals: Signals) -> None:
        self._settings = settings
        self._signals = signals
        # The most recently used last.
        self._opened: OrderedDict[str, Localizer | OpenSet] = OrderedDict()
        # By name, shared by all maps.
        self._extractors: dict[str, LocalFeatureExtractor] = {}
        self._descriptors: dict[str, GlobalDescriptor] = {}

    @property
    def refs(self) -> tuple[OpenMap, ...]:
        return tuple(OpenMap(ref, _size_of(one)) for ref, one in self._opened.items())

    def localizer(self, version: MapFolder) -> Localizer:
        """Return the localizer of a map; errors as in ``open``."""
        found = self.open(version)
        assert isinstance(found, Localizer)  # a set has no localizer
        return found

    def opened_set(self, version: MapFolder) -> OpenSet:
        """Return an open set; errors as in ``open``."""
        found = self.open(version)
        assert not isinstance(found, Localizer)
        return found

    def open(self, version: MapFolder) -> Localizer | OpenSet:
        """Open a map or a set, unless it is open, and warm it up."""
        found = self._opened.get(version.ref)
        if found is None:
            self._signals.opening = True
            found = self._opened[version.ref] = self._open(version)
        self._opened.move_to_end(version.ref)
        while len(self._opened) > 1 and self._size > self._settings.max_loaded_bytes:
            ref, _ = self._opened.popitem(last=False)
            logger.info("map %s closed, to stay within max_loaded_bytes", ref)
        if self._signals.abandoned:
            raise Abandoned
        self._signals.opening = False
        return found

    def try_out(self, version: MapFolder) -> None:
        """Open a map or a set, warm it up, and close it again; errors as in ``open``."""
        self._open(version)

    def close(self, ref: str) -> None:
        self._opened.pop(ref, None)

    def extractor(self, name: str) -> LocalFeatureExtractor:
        """Return the extractor of local features with this name."""
        if name not in self._extractors:
            s = self._settings
            made = make_local_features(name, s.weights_dir, s.inference, s.threads)
            self._extractors[name] = made
        return self._extractors[name]

    @property
    def _size(self) -> int:
        return sum(map(_size_of, self._opened.values()))

    def _open(self, version: MapFolder) -> Localizer | OpenSet:
        if not version.folder.is_dir():  # by another replica, while a request here still used it
            raise refuse("map.version", "the version was removed", field="map", got=version.ref)
        start = perf_counter()
        with _damage_named(version.ref):
            try:
                opened = self._open_set(version) if version.is_set else self._open_map(version)
            except InvalidInput as error:  # features that are not here: not the caller's mistake
                raise error.about(error.field, Conflict) from error
            opened.warm_up()
        logger.info("map %s loaded in %.1f s", version.ref, perf_counter() - start)
        return opened

    def _open_map(self, version: MapFolder) -> Localizer:
        opened = open_published(version.folder)
        name = opened.manifest.local_features.fingerprint.name
        extractor = None if is_ready_made(name) else self.extractor(name)
        matcher = partial(make_lightglue, weights_dir=self._settings.weights_dir)
        return Localizer(opened, extractor, self._descriptor, matcher)

    def _open_set(self, version: MapFolder) -> OpenSet:
        opened: OpenSet = kind_of_sets(version.ref).open(version.folder, self.extractor)
        return opened

    def _descriptor(self, name: str) -> GlobalDescriptor:
        if name not in self._descriptors:
            s = self._settings
            made = make_global_descriptor(name, s.weights_dir, s.inference, s.threads)
            self._descriptors[name] = made
        return self._descriptors[name]


def _size_of(opened: Localizer | OpenSet) -> int:
    return opened.map.size_bytes if isinstance(opened, Localizer) else opened.size_bytes


@contextmanager
def _damage_named(ref: str) -> Iterator[None]:
    """Turn unexpected errors of opening a map into MapCorrupt ``map.unusable``.

    A damaged map can break the code that reads it in any way, and a plug-in may exit when it is
    first used; neither must stop the other maps.
    """
    try:
        yield
    except VislocError:
        raise
    except (Exception, SystemExit) as error:
        logger.exception("map %s cannot be used", ref)
        raise refuse("map.unusable", field=ref, got=type(error).__name__) from error
