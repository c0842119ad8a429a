"""Ask maps in this process, and sets as the service's engine does."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from benchmarks.engines import engine_of
from benchmarks.trust.maps import floor_of
from benchmarks.trust.outcomes import Outcome, Query, outcome_of, refused_by_error
from service.engine.engine import Engine
from service.values import photo_job
from visloc.archive import MapStore
from visloc.errors import InvalidInput
from visloc.features import LocalFeatureExtractor, make_global_descriptor, make_local_features
from visloc.localization.localizer import Localizer
from visloc.localization.query.feature_cache import FeatureCache
from visloc.localization.solving import SeenImage
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo
from visloc.types import Answer, InstantAnswer

OPTIONS = LocalizeOptions()


class Maps:
    """The maps of a store, opened when they are asked first.

    Consecutive queries of the same photo share its features.
    """

    def __init__(self, store: MapStore, weights_dir: Path | None) -> None:
        self._store, self._weights_dir = store, weights_dir
        self._photo: Photo | None = None
        self._features: FeatureCache = {}
        self._extractor = cache(self._make_extractor)
        self.localizer = cache(self._open)

    def ask(self, queries: Iterable[Query]) -> Iterator[Outcome]:
        """Ask each query's map; a camera that does not fit its photo is an outcome too."""
        for query in queries:
            try:
                yield outcome_of(query, self._answer(query))
            except InvalidInput as error:
                yield refused_by_error(query, error)

    def _answer(self, query: Query) -> Answer | InstantAnswer:
        localizer = self.localizer(query.map_id)
        if len(query.photos) == 1:
            (only,) = query.photos
            if only.photo is not self._photo:
                self._photo, self._features = only.photo, {}
            return localizer.localize(only.photo, only.camera, OPTIONS, cache=self._features)
        seen = [
            SeenImage(p.sensor, p.cam_from_rig, localizer.look(p.photo, p.camera, OPTIONS))
            for p in query.photos
        ]
        return localizer.solve(seen, OPTIONS).answer

    def _open(self, map_id: str) -> Localizer:
        opened = self._store.open(map_id)
        name = opened.manifest.local_features.fingerprint.name
        describe = partial(make_global_descriptor, weights_dir=self._weights_dir)
        return Localizer(opened, self._extractor(name), describe)

    def _make_extractor(self, name: str) -> LocalFeatureExtractor:
        return make_local_features(name, self._weights_dir)


def ask_floors(
    store: MapStore, weights_dir: Path | None, queries: Iterator[tuple[Query, Path]]
) -> Iterator[Outcome]:
    """Ask a set of floors about photos in files, through an engine with one worker.

    An answer is right when it is on the photo's floor.
    """
    engine = engine_of(store, weights_dir)
    for outcome in asyncio.run(_ask_engine(engine, queries)):
        if outcome.accepted and outcome.tile is not None:
            yield replace(outcome, right=floor_of(outcome.tile) == floor_of(outcome.photo))
        else:  # a refusal may name a tile as well
            yield outcome


async def _ask_engine(engine: Engine, queries: Iterator[tuple[Query, Path]]) -> list[Outcome]:
    await engine.start()
    try:
        outcomes = []
        for query, path in queries:
            job = photo_job((query.map_id,), path.read_bytes(), query.photos[0].camera, OPTIONS)
            try:
                found = await engine.localize(job)
            except InvalidInput as error:
                outcomes.append(refused_by_error(query, error))
            else:
                outcomes.append(outcome_of(query, found.answer, found.tile))
        return outcomes
    finally:
        await engine.close()
