"""What worker processes do: maps opened, photos looked at, poses solved."""

from __future__ import annotations

import ctypes
import io
import logging
import pickle
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from time import perf_counter, time
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from service.values import (
    ImageJob,
    Instant,
    InstantLocalization,
    Localization,
    LocalizeJob,
    MatchPicture,
    Query,
    Rig,
    RigJob,
    SequenceStart,
)
from service.workers.instants import (
    Target,
    check_images,
    check_options,
    check_priors,
    look_at,
    rig_in_map,
)
from service.workers.judging import judged
from service.workers.process import (
    Abandoned,
    Added,
    Chosen,
    Loaded,
    MapFolder,
    Seen,
    WorkerSettings,
)
from service.workers.sequences import SequenceRun
from service.workers.tiles import Read, TileChooser, read_query, summed, written
from visloc.archive.places import anchor_rms
from visloc.archive.store import open_published, open_published_set
from visloc.drawing.matches_picture import draw_overlay
from visloc.errors import Conflict, InvalidInput, VislocError, refuse
from visloc.features import (
    GlobalDescriptor,
    LocalFeatureExtractor,
    make_global_descriptor,
    make_local_features,
)
from visloc.features.local.readymade import is_ready_made
from visloc.features.networks.lightglue.model import make_lightglue
from visloc.images import ImageLimits, Photo
from visloc.localization.constraints import MapGeometry
from visloc.localization.localizer import Localizer
from visloc.localization.solving import Look, SeenImage
from visloc.priors import Priors
from visloc.types import Answer, LocalizeOptions, QueryFeatures

logger = logging.getLogger(__name__)


class Vision:
    """Localizes in maps that stay open. Its methods are the tasks of ``service.workers.process``.

    Args:
        settings: of the process.
        abandoned: set when nobody waits for the task any more.
    """

    def __init__(self, settings: WorkerSettings, abandoned: ctypes.c_bool) -> None:
        torch.set_num_threads(settings.threads)
        cv2.setNumThreads(settings.threads)
        self._settings = settings
        self._limits = ImageLimits(settings.max_image_bytes, settings.max_image_pixels)
        self._abandoned = abandoned
        # Maps and sets, the most recently used last.
        self._opened: OrderedDict[str, Localizer | TileChooser] = OrderedDict()
        # By name, shared by all maps.
        self._extractors: dict[str, LocalFeatureExtractor] = {}
        self._descriptors: dict[str, GlobalDescriptor] = {}

    @property
    def loaded(self) -> tuple[Loaded, ...]:
        """Maps that are open."""
        return tuple(Loaded(ref, _size_of(one)) for ref, one in self._opened.items())

    def _step(self) -> None:
        """Stop here when nobody waits any more."""
        if self._abandoned.value:
            raise Abandoned

    def localizer(self, of: MapFolder) -> Localizer:
        """Return the localizer of a map, opened now if it was not before.

        Raises:
            Conflict: for a map of features that are not here.
            MapCorrupt: when it cannot be used.
        """
        found = self.open(of)
        assert isinstance(found, Localizer)  # a set has no localizer
        return found

    def chooser(self, of: MapFolder) -> TileChooser:
        """Return what ranks the tiles of a set; as ``localizer``."""
        found = self.open(of)
        assert isinstance(found, TileChooser)
        return found

    def open(self, of: MapFolder) -> Localizer | TileChooser:
        """Open a map or a set, if it is not open yet, and close what was not used for longest.

        Raises:
            Conflict: for a map of features that are not here.
            MapCorrupt: when it cannot be used.
        """
        found = self._opened.get(of.ref)
        if found is None:
            found = self._opened[of.ref] = self._open(of)
        self._opened.move_to_end(of.ref)
        while len(self._opened) > 1 and self._size > self._settings.max_loaded_bytes:
            ref, _ = self._opened.popitem(last=False)
            logger.info("map %s closed, to keep to max_loaded_bytes", ref)
        return found

    def forget(self, ref: str) -> None:
        """Close a map that is no longer served."""
        self._opened.pop(ref, None)

    @property
    def _size(self) -> int:
        return sum(_size_of(one) for one in self._opened.values())

    def _open(self, of: MapFolder) -> Localizer | TileChooser:
        start = perf_counter()
        with _damage_named(of.ref):
            try:
                opened = self._opened_set(of) if of.is_set else self._opened_map(of)
            except InvalidInput as error:  # features that are not here: not the caller's mistake
                raise error.about(error.field, Conflict) from error
            opened.warm_up()
        logger.info("map %s loaded in %.1f s", of.ref, perf_counter() - start)
        return opened

    def _opened_map(self, of: MapFolder) -> Localizer:
        opened = open_published(of.folder)
        name = opened.manifest.local_features.fingerprint.name
        extractor = None if is_ready_made(name) else self._extractor(name)
        matcher = partial(make_lightglue, weights_dir=self._settings.weights_dir)
        return Localizer(opened, extractor, self._descriptor, matcher)

    def _opened_set(self, of: MapFolder) -> TileChooser:
        return TileChooser(open_published_set(of.folder), self._extractor)

    def _extractor(self, name: str) -> LocalFeatureExtractor:
        if name not in self._extractors:
            s = self._settings
            made = make_local_features(name, s.weights_dir, s.inference, s.threads)
            self._extractors[name] = made
        return self._extractors[name]

    def _descriptor(self, name: str) -> GlobalDescriptor:
        if name not in self._descriptors:
            s = self._settings
            made = make_global_descriptor(name, s.weights_dir, s.inference, s.threads)
            self._descriptors[name] = made
        return self._descriptors[name]

    def localize(
        self, job: LocalizeJob, maps: Sequence[MapFolder], submitted: float
    ) -> Localization:
        """As ``worker.localize``."""
        started, queued = perf_counter(), time() - submitted
        targets = self._targets(maps, None)
        check_options(targets, job.options)
        loaded = perf_counter()
        looks: list[tuple[Look, NDArray[np.bool_]]] = []
        found: list[Localization] = []
        read = self._read(job.query)
        query = read.query
        before = summed({"queued": max(0.0, queued), "open_map": loaded - started}, read.seconds)
        for target in targets:
            self._step()
            localizer = target.localizer
            if isinstance(query, QueryFeatures):
                look = localizer.look_at_features(query, job.camera, job.options, job.priors)
            else:
                look = localizer.look(query, job.camera, job.options, job.priors, read.found)
            self._step()
            answer, inliers = localizer.solve_look(look, job.options, job.priors)
            looks.append((look, inliers))
            found.append(_localization(localizer, answer, ypr=job.ypr))
        row, best = judged(found, job.priors)
        localizer, answer, (look, inliers) = targets[row].localizer, best.answer, looks[row]
        picture = None
        if job.debug and isinstance(query, Photo):
            self._step()
            picture = MatchPicture(
                look.matches.pixels,
                look.matches.points + localizer.geometry.origin,
                inliers,
                draw_overlay(query, localizer.map, look, answer, inliers),
            )
        evidence = replace(answer.evidence, seconds=summed(before, answer.evidence.seconds))
        return replace(best, answer=replace(answer, evidence=evidence), debug=picture)

    def choose_tiles(
        self,
        query: Query,
        of: MapFolder,
        options: LocalizeOptions,
        allowed: NDArray[np.bool_] | None,
        submitted: float,
    ) -> Chosen:
        """As ``worker.choose_tiles``."""
        queued, started = max(0.0, time() - submitted), perf_counter()
        self._step()
        chooser = self.chooser(of)
        loaded = perf_counter()
        try:
            read = self._read(query)
        except InvalidInput:
            return Chosen(query)  # the tile that is asked says it
        seconds = {"queued": queued, "open_map": loaded - started}
        read = replace(read, seconds=summed(seconds, read.seconds))
        scores = chooser.choose(read, options, allowed)
        return Chosen(written(read), scores)

    def check_rig(self, job: RigJob, maps: Sequence[MapFolder]) -> None:
        """As ``worker.check_rig``."""
        targets = self._targets(maps, job.rig)
        for target in targets:
            check_images(job.images, target.rig, self._settings.max_images, "images")
        check_options(targets, job.options)
        check_priors(targets, job.priors)

    def look_at_image(
        self,
        image: ImageJob,
        maps: Sequence[MapFolder],
        rig: Rig | None,
        options: LocalizeOptions,
        priors: Priors,
        submitted: float,
    ) -> Seen:
        """As ``worker.look_at_image``."""
        queued = max(0.0, time() - submitted)
        self._step()
        targets = self._targets(maps, rig)
        return pickle.dumps(
            look_at(image, targets, options, priors, self._read, queued), pickle.HIGHEST_PROTOCOL
        )

    def solve_rig(
        self, job: RigJob, maps: Sequence[MapFolder], seen: Sequence[Seen]
    ) -> InstantLocalization:
        """As ``worker.solve_rig``."""
        found = []
        for target, images in zip(
            self._targets(maps, job.rig), _by_map(seen, len(maps)), strict=True
        ):
            self._step()
            solved = target.localizer.solve(images, job.options, job.priors, job.timestamp)
            found.append(target.localization(solved.answer, ypr=job.ypr))
        return judged(found, job.priors)[1]

    def open_sequence(self, start: SequenceStart, maps: Sequence[MapFolder]) -> bytes:
        """As ``worker.open_sequence``."""
        settings = self._settings
        targets = self._targets(maps, start.rig)
        return _dumped(SequenceRun(start, targets, settings.max_images, settings.max_instants))

    def check_instants(
        self, state: bytes, maps: Sequence[MapFolder], first: int, instants: Sequence[Instant]
    ) -> tuple[bytes, list[Priors]]:
        """As ``worker.check_instants``."""
        run = self._sequence(state, maps)
        priors = [run.check(first + i, instant) for i, instant in enumerate(instants)]
        return _dumped(run), priors

    def add_instant(
        self,
        state: bytes,
        maps: Sequence[MapFolder],
        instant: Instant,
        seen: Sequence[Seen],
        priors: Priors,
    ) -> Added:
        """As ``worker.add_instant``."""
        self._step()
        run = self._sequence(state, maps)
        found = run.add(instant, _by_map(seen, len(maps)), priors)
        answers = [run.localization(answer) for answer in found]
        kept = tuple(target.localizer.map.ref for target in run.targets)
        return Added(_dumped(run), kept, answers, run.pose)

    def finish_sequence(self, state: bytes, maps: Sequence[MapFolder]) -> list[InstantLocalization]:
        """As ``worker.finish_sequence``."""
        run = self._sequence(state, maps)
        return [run.localization(answer) for answer in run.finish()]

    def _read(self, query: Query) -> Read:
        read = read_query(query, self._limits, self._extractor)
        self._step()
        return read

    def _sequence(self, state: bytes, maps: Sequence[MapFolder]) -> SequenceRun:
        run = _Unpickler(state, {of.ref: self.localizer(of) for of in maps}).load()
        assert isinstance(run, SequenceRun)
        return run

    def _targets(self, maps: Sequence[MapFolder], rig: Rig | None) -> list[Target]:
        localizers = [self.localizer(of) for of in maps]
        return [Target(found, rig_in_map(rig, found.map)) for found in localizers]


class _Pickler(pickle.Pickler):
    """Leaves maps where they are."""

    def persistent_id(self, obj: Any) -> Any:
        if isinstance(obj, Localizer):
            return "localizer", obj.map.ref
        if isinstance(obj, MapGeometry):
            return "geometry", obj.ref
        return None


class _Unpickler(pickle.Unpickler):
    """Puts this process's maps back in. Reads only what ``_Pickler`` wrote, in this service."""

    def __init__(self, state: bytes, localizers: Mapping[str, Localizer]) -> None:
        super().__init__(io.BytesIO(state))
        self._localizers = localizers

    def persistent_load(self, pid: Any) -> Any:
        kind, ref = pid
        localizer = self._localizers[ref]
        return localizer if kind == "localizer" else localizer.geometry


def _localization(localizer: Localizer, answer: Answer, *, ypr: bool) -> Localization:
    opened = localizer.map
    return Localization(
        answer,
        opened.manifest.id,
        opened.manifest.version,
        opened.geodetic,
        ypr,
        reach=localizer.geometry.reach,
        anchor_rms=anchor_rms(opened.manifest.world),
    )


def _size_of(opened: Localizer | TileChooser) -> int:
    return opened.size_bytes if isinstance(opened, TileChooser) else opened.map.size_bytes


def _dumped(run: SequenceRun) -> bytes:
    buffer = io.BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(run)
    return buffer.getvalue()


def _by_map(seen: Sequence[Seen], num_maps: int) -> list[tuple[SeenImage, ...]]:
    """Return what ``look_at_image`` of this service found in the images of an instant, by map."""
    looks: list[list[SeenImage]] = [pickle.loads(each) for each in seen]
    return [tuple(look[i] for look in looks) for i in range(num_maps)]


@contextmanager
def _damage_named(ref: str) -> Iterator[None]:
    """Turn what should not happen while a map is opened into MapCorrupt ``map.unusable``.

    A damaged map can break the code that reads it in any way, and must not stop the others. Nor
    must a plug-in that exits when it is first used.
    """
    try:
        yield
    except VislocError:
        raise
    except (Exception, SystemExit) as error:
        logger.exception("map %s cannot be used", ref)
        raise refuse("map.unusable", field=ref, got=type(error).__name__) from error
