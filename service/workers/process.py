"""What runs inside a worker process, as the main process knows it: settings, and tasks by name.

The main process calls these functions through ``service.workers.pool``, with values that can be
pickled.
What they need, torch and OpenCV among it, is loaded in worker processes only.
"""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import parent_process
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.telemetry.logs import configure_logging
from service.values import (
    ImageJob,
    Instant,
    InstantLocalization,
    Localization,
    LocalizeJob,
    Query,
    Rig,
    RigJob,
    SequenceStart,
)
from visloc.errors import VislocError
from visloc.priors import Priors
from visloc.sets.choosing import TileScore
from visloc.types import Inference, LocalizeOptions, RigPose

if TYPE_CHECKING:
    from service.workers.vision import Vision

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
        max_image_bytes: of an encoded photo.
        max_image_pixels: of a photo.
        inference: how networks are computed.
        log_level: what is logged to stderr.
        log_format: how: ``text`` or ``json``.
    """

    weights_dir: Path | None
    threads: int
    max_loaded_bytes: int
    max_images: int
    max_instants: int
    max_image_bytes: int
    max_image_pixels: int
    inference: Inference = Inference.AUTO
    log_level: str = "info"
    log_format: str = "text"


class MapFolder(NamedTuple):
    """A version of a map, or of a set, on this machine's disk: ``id@version`` and its folder."""

    ref: str
    folder: Path
    is_set: bool = False


class Loaded(NamedTuple):
    """A map, or a set, that is open: ``id@version`` and its bytes."""

    ref: str
    size: int


class Chosen(NamedTuple):
    """What a photo says of the tiles of a set.

    Attributes:
        query: the photo, read, if it can be.
        scores: of the most similar tiles, best first; none when none were asked for, or the photo
            shows nothing.
    """

    query: Query
    scores: tuple[TileScore, ...] = ()


class Abandoned(Exception):
    """Nobody waits for the task any more."""


# What a photo showed of the maps, as bytes that only worker processes read: the main process passes
# them on without looking.
Seen = bytes

_vision: Vision | None = None


def start(settings: WorkerSettings, abandoned: ctypes.c_bool) -> None:
    """Make the process ready; runs once in each."""
    global _vision
    # Both may reach all processes of a group: when to end is the main process's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    configure_logging(settings)
    from service.workers.vision import Vision

    _vision = Vision(settings, abandoned)


def _end_with_parent() -> None:
    """End when the main process was killed; else this one would wait for tasks for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def _here() -> Vision:
    assert _vision is not None  # start ran
    return _vision


# Tasks. What they take and return is pickled.


def call(work: Callable[[], T]) -> tuple[T, tuple[Loaded, ...]]:
    """Do a task and say which maps are open after it."""
    return work(), _here().loaded


def ping() -> None:
    """Show that the process is alive."""


def load(of: MapFolder) -> None:
    """Open a map, or a set without its tiles, and warm it up.

    Raises:
        Conflict: for a map of features that are not here.
        MapCorrupt: when it cannot be used.
    """
    _here().open(of)


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
    return _here().localize(job, maps, submitted)


def choose_tiles(
    query: Query,
    of: MapFolder,
    options: LocalizeOptions,
    allowed: NDArray[np.bool_] | None,
    submitted: float,
) -> Chosen:
    """Read a photo, find its features, and rank tiles of a set by them.

    Args:
        query: the photo; one that cannot be used comes back as it is, and ranks nothing.
        of: the set.
        options: how features are found.
        allowed: (T,) the tiles to rank; None to rank none.
        submitted: as of ``localize``.

    Raises:
        VislocError: what sets raise that cannot be opened.
    """
    return _here().choose_tiles(query, of, options, allowed, submitted)


def check_rig(job: RigJob, maps: Sequence[MapFolder]) -> None:
    """Refuse a rig's images, not read yet, or options that do not fit.

    Raises:
        InvalidInput: ``rig.*``, ``options.*``, ``priors.*``.
        VislocError: what maps raise.
    """
    _here().check_rig(job, maps)


def look_at_image(
    image: ImageJob,
    maps: Sequence[MapFolder],
    rig: Rig | None,
    options: LocalizeOptions,
    priors: Priors,
    submitted: float,
) -> Seen:
    """Look at one image for every map. An image that cannot be used fails alone.

    Raises:
        VislocError: what concerns more than this image.
    """
    return _here().look_at_image(image, maps, rig, options, priors, submitted)


def solve_rig(job: RigJob, maps: Sequence[MapFolder], seen: Sequence[Seen]) -> InstantLocalization:
    """Find one pose of a rig in the best of the maps.

    Args:
        job: without its images.
        maps: where to search.
        seen: what each of its images showed of them.
    """
    return _here().solve_rig(job, maps, seen)


class Added(NamedTuple):
    """What an instant makes of a sequence.

    Attributes:
        state: the sequence after it.
        maps: references of those that are still searched.
        answers: those that are final.
        pose: what the instant's own images measured; None when they do not localize it.
    """

    state: bytes
    maps: tuple[str, ...]
    answers: list[InstantLocalization]
    pose: RigPose | None


# A sequence lives in the main process, as bytes that only worker processes read: which of them
# takes its next step is open, and none of them dying takes more along than that step.


def open_sequence(start: SequenceStart, maps: Sequence[MapFolder]) -> bytes:
    """Begin a sequence.

    Raises:
        InvalidInput: ``sequence.*``, ``rig.*``, ``options.*``, ``priors.*``.
        VislocError: what maps raise.
    """
    return _here().open_sequence(start, maps)


def check_instants(
    state: bytes, maps: Sequence[MapFolder], first: int, instants: Sequence[Instant]
) -> tuple[bytes, list[Priors]]:
    """Refuse instants, without their photos, that cannot be solved; say what is known at each.

    Raises:
        InvalidInput: ``sequence.*``, ``rig.*``, ``priors.*``.
        TooLarge: ``sequence.too_many_instants``, ``rig.too_many_images``.
    """
    return _here().check_instants(state, maps, first, instants)


def add_instant(
    state: bytes,
    maps: Sequence[MapFolder],
    instant: Instant,
    seen: Sequence[Seen],
    priors: Priors,
) -> Added:
    """Solve the next instant of a sequence, given without its photos."""
    return _here().add_instant(state, maps, instant, seen, priors)


def finish_sequence(state: bytes, maps: Sequence[MapFolder]) -> list[InstantLocalization]:
    """Return the answers that waited for instants which will not come."""
    return _here().finish_sequence(state, maps)
