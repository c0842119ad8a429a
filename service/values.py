"""Jobs for the engine, its answers, and the values that it shares with worker processes."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Geodetic, MapOutline, SetOutline
from visloc.errors import refuse
from visloc.geometry import Camera
from visloc.localization.acceptance.judge import PlaceAnswer
from visloc.options import Inference, LocalizeOptions
from visloc.priors import NO_PRIORS, Priors
from visloc.sequences.filling import Odometry, TimeUnit
from visloc.types import (
    InstantAnswer,
    MaskedImage,
    Near,
    QueryFeatures,
    Refusal,
    RigSensor,
)

# The sensor of a photo that comes without a rig.
ONLY_SENSOR = "camera"


# Where to search: maps, each ``id`` (its current version) or ``id@version``; or the anchored maps
# that reach into a circle.
Where = tuple[str, ...] | Near


@dataclass(frozen=True, slots=True, eq=False)
class PackedQuery:
    """A photo as it was sent, with the features found so far, pickled by a worker for others.

    Its pixels, which take much more memory, are decoded again where they are needed.
    """

    sent: bytes | MaskedImage | QueryFeatures
    found: bytes


# An encoded photo, or features that were sent instead of it; packed once tiles were ranked by it.
Query = bytes | MaskedImage | QueryFeatures | PackedQuery


# The id of a rig that the map knows, or the cameras by sensor id.
Rig = str | Mapping[str, RigSensor]


@dataclass(frozen=True, slots=True, eq=False)
class ImageJob:
    """One image of an instant. A camera replaces the rig's for this sensor."""

    sensor: str
    query: Query
    camera: Camera | None


@dataclass(frozen=True, slots=True, eq=False)
class RigJob:
    """The images of one instant, each of another sensor.

    A photo on its own is a rig of one camera (``photo_job``).

    Attributes:
        rig: None for a photo on its own.
        ypr: also return the GeoPose as angles.
        debug: also return the matches; for a photo on its own.
        refused: of a photo on its own that was searched as it was sent; other turns are left.
    """

    maps: Where
    rig: Rig | None
    images: tuple[ImageJob, ...]
    timestamp: int | None
    options: LocalizeOptions
    priors: Priors = NO_PRIORS
    ypr: bool = False
    debug: bool = False
    refused: Refusal | None = None


def photo_job(
    maps: Where,
    query: Query,
    camera: Camera | None,
    options: LocalizeOptions,
    priors: Priors = NO_PRIORS,
    *,
    ypr: bool = False,
    debug: bool = False,
) -> RigJob:
    """Return the job of localizing one photo, or its features."""
    image = ImageJob(ONLY_SENSOR, query, camera)
    return RigJob(maps, None, (image,), None, options, priors, ypr, debug)


@dataclass(frozen=True, slots=True, eq=False)
class InstantJob:
    """One instant of a sequence.

    Attributes:
        images: each of another sensor; may be empty when there is odometry.
        priors: None for those of the sequence.
    """

    timestamp: int
    images: tuple[ImageJob, ...]
    odometry: Odometry | None
    priors: Priors | None


@dataclass(frozen=True, slots=True, eq=False)
class SequenceJob:
    """The values that all instants of a sequence share.

    Attributes:
        maps: of several maps, the first that alone explains an instant is kept.
        rig: None when every instant is one image of one camera.
        time_unit: of the timestamps; None to infer it from their size.
        max_gap_s: longest time between measured instants across which gaps are filled; 0: none.
        ypr: also return the GeoPose as angles.
    """

    maps: Where
    rig: Rig | None
    time_unit: TimeUnit | None
    max_gap_s: float
    options: LocalizeOptions
    priors: Priors = NO_PRIORS
    ypr: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MatchPicture:
    """The correspondences of a photo, and a picture of them.

    Attributes:
        keypoints: (n, 2) pixels of the photo as stored.
        points: (n, 3) in the world.
        inliers: (n,) whether the best pose explains the match.
        overlay: JPEG of the photo with its matches, beside the retrieved photos.
    """

    keypoints: NDArray[np.float64]
    points: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    overlay: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Localization:
    """The answer to an instant, and the map that gave it.

    Attributes:
        map_id: the map, or the set of maps, in whose frame the answer is.
        geodetic: where that map lies on Earth, when it is known.
        ypr: whether the caller wants the GeoPose as angles too.
        tile: of a set, ``id@version`` of the map in it that gave the answer.
        reach: how far that map's photos see, in units of the answer's frame (median).
        anchor_rms: rms error of the map's anchor on Earth, in its unit; 0 when unknown.
        metric: whether the unit of that frame is the metre.
    """

    answer: InstantAnswer
    map_id: str
    map_version: str
    geodetic: Geodetic | None = None
    ypr: bool = False
    debug: MatchPicture | None = None
    tile: str | None = None
    reach: float = 0.0
    anchor_rms: float = 0.0
    metric: bool = False

    @property
    def place(self) -> PlaceAnswer:
        """The answer for the judge, with the map, or the set and its tile, that gave it."""
        return PlaceAnswer(f"{self.map_id}@{self.map_version}", self.answer, self.tile)

    @property
    def ref(self) -> str:
        """``id@version`` of the map, or, for a set, of the tile, that gave the answer."""
        return self.place.ref


def check_order(before: int, timestamp: int) -> None:
    """Refuse an instant of a sequence that is not after the one before it."""
    if timestamp <= before:
        raise refuse(
            "sequence.timestamps",
            field="timestamp",
            expected=f"more than {before}, that of the instant before",
            got=timestamp,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ServedMap:
    """A version of a map, or of a set of maps.

    Attributes:
        current: whether this version is the current one.
        versions: all published versions of the map, oldest first, and whether each is current.
    """

    outline: MapOutline | SetOutline
    current: bool
    versions: tuple[tuple[str, bool], ...]


class MapFolder(NamedTuple):
    """A version of a map, or of a set, on this machine's disk; ``ref`` is ``id@version``."""

    ref: str
    folder: Path
    is_set: bool = False


@dataclass(frozen=True, slots=True)
class WorkerSettings:
    """The settings of a worker process.

    Attributes:
        threads: most processor threads for one photo.
        max_loaded_bytes: maps that stay open.
        max_image_bytes: of an encoded photo.
        max_image_pixels: of a photo.
        configure_logging: runs first in every process, which pickles it; None to log as Python
            does.
    """

    weights_dir: Path | None
    threads: int
    max_loaded_bytes: int
    max_images: int
    max_instants: int
    max_image_bytes: int
    max_image_pixels: int
    inference: Inference = Inference.AUTO
    configure_logging: Callable[[], None] | None = None


class OpenMap(NamedTuple):
    """A map, or a set, that a worker process has open: ``id@version`` and its bytes."""

    ref: str
    size: int


# Matches of an image with each map. Pickled, because only worker processes read it.
PackedLooks = bytes
# What a map makes of an instant of a sequence, likewise.
PackedSolved = bytes
# A sequence between two of its instants. The main process keeps it pickled, so that any worker can
# take its next step, and a worker that dies loses only that step.
PackedSequence = bytes


class SequenceStep(NamedTuple):
    """What an instant makes of a sequence.

    Attributes:
        maps: references of those that are still searched.
    """

    sequence: PackedSequence
    maps: tuple[str, ...]
    answers: list[Localization]


class Signals(ctypes.Structure):
    """Flags in shared memory that the main process and a worker process exchange during a task.

    Attributes:
        abandoned: nobody waits for the task any more; the main process sets it.
        opening: a map is being opened; the worker process sets it, until the task ends if that
            fails.
    """

    abandoned: bool
    opening: bool
    _fields_ = (("abandoned", ctypes.c_bool), ("opening", ctypes.c_bool))


class Abandoned(Exception):
    """Nobody waits for a task any more: what a worker says of it.

    It is here because the main process, which unpickles it, must not load a worker's libraries.
    """
