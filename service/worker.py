"""What runs inside a worker process: maps opened, photos looked at, poses solved.

The main process calls these functions through ``service.workers``, with values that can be pickled.
"""

from __future__ import annotations

import ctypes
import io
import logging
import os
import pickle
import signal
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import parent_process
from pathlib import Path
from time import perf_counter, time
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from service.instants import Target, check_images, check_priors, look_at, rig_in_map
from service.jobs import (
    ImageJob,
    Instant,
    InstantLocalization,
    Localization,
    LocalizeJob,
    MatchPicture,
    Rig,
    RigJob,
    SequenceStart,
)
from service.logs import configure_logging
from service.sequences import SequenceRun
from visloc.archive.store import open_published
from visloc.constraints import MapGeometry
from visloc.errors import Conflict, InvalidInput, MapCorrupt, VislocError
from visloc.features import LocalFeatureExtractor, make_local_features
from visloc.features.readymade import is_ready_made
from visloc.images import ImageLimits, read_photo
from visloc.localizer import FeatureCache, Localizer
from visloc.overlay import draw_overlay
from visloc.priors import Priors
from visloc.solving import Look, SeenImage
from visloc.types import Answer, Localized, LocalizeOptions, QueryFeatures

logger = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class WorkerSettings:
    """What a worker process needs to know.

    Attributes:
        weights_dir: network weights, for maps whose features need them.
        threads: processor threads for one photo.
        max_loaded_bytes: of maps that stay open.
        max_images: of one instant.
        max_instants: of one sequence.
        limits: of photos.
        log_level: what is logged to stderr.
        log_format: how: ``text`` or ``json``.
    """

    weights_dir: Path | None
    threads: int
    max_loaded_bytes: int
    max_images: int
    max_instants: int
    limits: ImageLimits
    log_level: str = "info"
    log_format: str = "text"


class MapFolder(NamedTuple):
    """A version of a map on this machine's disk: ``id@version`` and its folder."""

    ref: str
    folder: Path


class Loaded(NamedTuple):
    """A map that is open: ``id@version`` and its bytes."""

    ref: str
    size: int


class Abandoned(Exception):
    """Nobody waits for the task any more."""


class _Process:
    """What a worker process keeps between tasks."""

    def __init__(self, settings: WorkerSettings, abandoned: ctypes.c_bool) -> None:
        self.settings = settings
        self._abandoned = abandoned
        self._localizers: OrderedDict[str, Localizer] = OrderedDict()  # most recently used last
        self._extractors: dict[str, LocalFeatureExtractor] = {}  # by name

    @property
    def loaded(self) -> tuple[Loaded, ...]:
        return tuple(Loaded(ref, one.map.size_bytes) for ref, one in self._localizers.items())

    def step(self) -> None:
        """Stop here when nobody waits any more."""
        if self._abandoned.value:
            raise Abandoned

    def localizer(self, of: MapFolder) -> Localizer:
        """Return the localizer of a map, opened now if it was not before.

        Raises:
            Conflict: for a map of features that are not here.
            MapCorrupt: when it cannot be used.
        """
        found = self._localizers.get(of.ref)
        if found is None:
            found = self._localizers[of.ref] = self._open(of)
        self._localizers.move_to_end(of.ref)
        while len(self._localizers) > 1 and self._size > self.settings.max_loaded_bytes:
            ref, _ = self._localizers.popitem(last=False)
            logger.info("map %s closed, to keep to max_loaded_bytes", ref)
        return found

    def forget(self, ref: str) -> None:
        self._localizers.pop(ref, None)

    @property
    def _size(self) -> int:
        return sum(one.map.size_bytes for one in self._localizers.values())

    def _open(self, of: MapFolder) -> Localizer:
        start = perf_counter()
        with _damage_named(of.ref):
            opened = open_published(of.folder)
            name = opened.manifest.local_features.fingerprint.name
            try:
                if name not in self._extractors and not is_ready_made(name):
                    self._extractors[name] = make_local_features(name, self.settings.weights_dir)
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


_process: _Process | None = None


def start(settings: WorkerSettings, abandoned: ctypes.c_bool) -> None:
    """Make the process ready; runs once in each."""
    global _process
    # Both may reach all processes of a group: when to end is the main process's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    configure_logging(settings)
    torch.set_num_threads(settings.threads)
    cv2.setNumThreads(settings.threads)
    _process = _Process(settings, abandoned)


def _end_with_parent() -> None:
    """End when the main process was killed; else this one would wait for tasks for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def _here() -> _Process:
    assert _process is not None  # start ran
    return _process


# Tasks. What they take and return is pickled.


def call(work: Callable[[], T]) -> tuple[T, tuple[Loaded, ...]]:
    """Do a task and say which maps are open after it."""
    return work(), _here().loaded


def ping() -> None:
    """Show that the process is alive."""


def load(of: MapFolder) -> None:
    """Open a map and warm it up.

    Raises:
        Conflict: for a map of features that are not here.
        MapCorrupt: when it cannot be used.
    """
    _here().localizer(of)


def warm(maps: Sequence[MapFolder]) -> None:
    """Open maps; one that is broken does not keep back the others."""
    for of in maps:
        try:
            load(of)
        except VislocError as error:
            logger.error("map %s is not loaded: %s", of.ref, error)  # noqa: TRY400


def forget(ref: str) -> None:
    """Close a map that is no longer served."""
    _here().forget(ref)


def localize(job: LocalizeJob, maps: Sequence[MapFolder], submitted: float) -> Localization:
    """Localize a photo, decoded first, or its features, in the best of the maps.

    Args:
        job: what to do.
        maps: where to search.
        submitted: when the job was given to the workers, by ``time.time``, which the clocks of
            two processes share.

    Raises:
        VislocError: what ``read_photo``, maps and ``Localizer`` raise.
    """
    here, started, queued = _here(), perf_counter(), time() - submitted
    localizers = [here.localizer(of) for of in maps]
    loaded = perf_counter()
    before = {"queued": max(0.0, queued), "open_map": loaded - started}
    found: list[tuple[Localizer, Look, Answer, NDArray[np.bool_]]] = []
    cache: FeatureCache = {}
    photo = None
    if not isinstance(job.query, QueryFeatures):
        photo = read_photo(job.query, here.settings.limits)
        before["decode"] = perf_counter() - loaded
    for localizer in localizers:
        here.step()
        if isinstance(job.query, QueryFeatures):
            look = localizer.look_at_features(job.query, job.camera, job.options, job.priors)
        else:
            assert photo is not None
            look = localizer.look(photo, job.camera, job.options, job.priors, cache)
        here.step()
        answer, inliers = localizer.solve_look(look, job.options, job.priors)
        found.append((localizer, look, answer, inliers))
    localizer, look, answer, inliers = max(
        found, key=lambda one: (isinstance(one[2], Localized), one[2].evidence.num_inliers)
    )
    picture = None
    if job.debug and photo is not None:
        here.step()
        picture = MatchPicture(
            look.matches.pixels,
            look.matches.points + localizer.geometry.origin,
            inliers,
            draw_overlay(photo, localizer.map, look, answer, inliers),
        )
    evidence = replace(answer.evidence, seconds={**before, **answer.evidence.seconds})
    manifest = localizer.map.manifest
    return Localization(
        replace(answer, evidence=evidence),
        manifest.id,
        manifest.version,
        localizer.map.geodetic,
        job.ypr,
        picture,
    )


def check_rig(job: RigJob, maps: Sequence[MapFolder]) -> None:
    """Refuse a rig's images, not read yet, that do not fit.

    Raises:
        InvalidInput: ``rig.*``, ``priors.*``.
        VislocError: what maps raise.
    """
    targets = _targets(maps, job.rig)
    for target in targets:
        check_images(job.images, target.rig, _here().settings.max_images, "images")
    check_priors(targets, job.priors)


def look_at_image(
    image: ImageJob,
    maps: Sequence[MapFolder],
    rig: Rig | None,
    options: LocalizeOptions,
    priors: Priors,
    submitted: float,
) -> list[SeenImage]:
    """Look at one image for every map. An image that cannot be used fails alone.

    Raises:
        VislocError: what concerns more than this image.
    """
    here, queued = _here(), max(0.0, time() - submitted)
    here.step()
    return look_at(image, _targets(maps, rig), options, priors, here.settings.limits, queued)


def solve_rig(
    job: RigJob, maps: Sequence[MapFolder], seen: Sequence[Sequence[SeenImage]]
) -> InstantLocalization:
    """Find one pose of a rig in the best of the maps.

    Args:
        job: without its images.
        maps: where to search.
        seen: what its images showed, by map.
    """
    here = _here()
    found = []
    for target, images in zip(_targets(maps, job.rig), seen, strict=True):
        here.step()
        solved = target.localizer.solve(images, job.options, job.priors, job.timestamp)
        found.append(target.localization(solved.answer, ypr=job.ypr))
    return max(found, key=lambda one: (one.answer.pose is not None, one.answer.num_inliers))


# A sequence lives in the main process, as bytes that only worker processes read: which of them
# takes its next step is open, and none of them dying takes more along than that step.


def open_sequence(start: SequenceStart, maps: Sequence[MapFolder]) -> bytes:
    """Begin a sequence.

    Raises:
        InvalidInput: ``sequence.*``, ``rig.*``, ``priors.*``.
        VislocError: what maps raise.
    """
    settings = _here().settings
    targets = _targets(maps, start.rig)
    return _dumped(SequenceRun(start, targets, settings.max_images, settings.max_instants))


def check_instants(
    state: bytes, maps: Sequence[MapFolder], first: int, instants: Sequence[Instant]
) -> tuple[bytes, list[Priors]]:
    """Refuse instants, without their photos, that cannot be solved; say what is known at each.

    Raises:
        InvalidInput: ``sequence.*``, ``rig.*``, ``priors.*``.
        TooLarge: ``sequence.too_many_instants``, ``rig.too_many_images``.
    """
    run = _sequence(state, maps)
    priors = [run.check(first + i, instant) for i, instant in enumerate(instants)]
    return _dumped(run), priors


def add_instant(
    state: bytes,
    maps: Sequence[MapFolder],
    instant: Instant,
    seen: Sequence[tuple[SeenImage, ...]],
    priors: Priors,
) -> tuple[bytes, tuple[str, ...], list[InstantLocalization]]:
    """Solve the next instant of a sequence, given without its photos.

    Returns:
        The sequence after it, the maps that are still searched, and the answers that are final.
    """
    _here().step()
    run = _sequence(state, maps)
    answers = [run.localization(answer) for answer in run.add(instant, seen, priors)]
    return _dumped(run), tuple(target.localizer.map.ref for target in run.targets), answers


def finish_sequence(state: bytes, maps: Sequence[MapFolder]) -> list[InstantLocalization]:
    """Return the answers that waited for instants which will not come."""
    run = _sequence(state, maps)
    return [run.localization(answer) for answer in run.finish()]


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


def _dumped(run: SequenceRun) -> bytes:
    buffer = io.BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(run)
    return buffer.getvalue()


def _sequence(state: bytes, maps: Sequence[MapFolder]) -> SequenceRun:
    run = _Unpickler(state, {of.ref: _here().localizer(of) for of in maps}).load()
    assert isinstance(run, SequenceRun)
    return run


def _targets(maps: Sequence[MapFolder], rig: Rig | None) -> list[Target]:
    localizers = [_here().localizer(of) for of in maps]
    return [Target(found, rig_in_map(rig, found.map)) for found in localizers]


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
