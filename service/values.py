"""What can be asked of the engine, and what it answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Geodetic
from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.priors import NO_PRIORS, Priors
from visloc.sequences.filling import Odometry, TimeUnit
from visloc.types import Answer, InstantAnswer, LocalizeOptions, QueryFeatures

# The longest time between two measured instants across which gaps are filled, by default.
DEFAULT_MAX_GAP_S = 1.0
# The sensor of the only image of an instant, when no rig is named.
ONLY_SENSOR = "camera"


@dataclass(frozen=True, slots=True)
class Near:
    """A circle on the Earth, WGS84.

    Attributes:
        latitude: degrees.
        longitude: degrees.
        radius: metres.
    """

    latitude: float
    longitude: float
    radius: float


# Where to search: one or several maps, each ``id``, for its current version, or ``id@version``; or
# the anchored maps that reach into a circle.
Where = tuple[str, ...] | Near


@dataclass(frozen=True, slots=True, eq=False)
class ReadQuery:
    """A photo, or what was found in it, as a worker process has read it; no other one needs to.

    Attributes:
        data: the pixels, the features found in them, and how long that took, for worker processes
            only.
    """

    data: bytes


# An encoded photo, or the features that were found in it; once tiles of a set were chosen by them,
# what was read.
Query = bytes | QueryFeatures | ReadQuery


@dataclass(frozen=True, slots=True, eq=False)
class LocalizeJob:
    """One photo to localize.

    Attributes:
        maps: where to search.
        query: the photo.
        camera: its intrinsics for the pixels as stored; None when unknown.
        options: thresholds and the like.
        priors: what is known of the camera.
        ypr: whether to say its GeoPose in angles too.
        debug: whether to show what was matched; needs a photo.
    """

    maps: Where
    query: Query
    camera: Camera | None
    options: LocalizeOptions
    priors: Priors = NO_PRIORS
    ypr: bool = False
    debug: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class RigSensor:
    """One camera of a rig.

    Attributes:
        cam_from_rig: where it sits.
        camera: the intrinsics of its photos; None when unknown.
    """

    cam_from_rig: Pose
    camera: Camera | None


# The id of a rig that the map knows, or a rig as it is.
Rig = str | Mapping[str, RigSensor]


@dataclass(frozen=True, slots=True, eq=False)
class ImageJob:
    """One image of an instant.

    Attributes:
        sensor: the camera of the rig.
        query: the photo.
        camera: its intrinsics, instead of those of the rig; None for those.
    """

    sensor: str
    query: Query
    camera: Camera | None


@dataclass(frozen=True, slots=True, eq=False)
class RigJob:
    """The images of one instant.

    Attributes:
        maps: where to search.
        rig: how the cameras sit; None for one image of one camera.
        images: each of another sensor.
        timestamp: of all of them; None when unknown.
        options: thresholds and the like.
        priors: what is known of the rig.
        ypr: whether to say its GeoPose in angles too.
    """

    maps: Where
    rig: Rig | None
    images: tuple[ImageJob, ...]
    timestamp: int | None
    options: LocalizeOptions
    priors: Priors = NO_PRIORS
    ypr: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """One instant of a sequence.

    Attributes:
        timestamp: greater than that of the instant before.
        images: each of another sensor; there may be none when there is odometry.
        odometry: None when there is none.
        priors: of this instant; None for those of the sequence.
    """

    timestamp: int
    images: tuple[ImageJob, ...]
    odometry: Odometry | None
    priors: Priors | None


@dataclass(frozen=True, slots=True, eq=False)
class SequenceStart:
    """What all instants of a sequence share.

    Attributes:
        maps: where to search; of several maps, one is kept once it alone explains an instant.
        rig: how the cameras sit; None when every instant is one image of one camera.
        time_unit: of the timestamps; None to tell by their size.
        max_gap_s: longest time between measured instants across which gaps are filled; 0: none.
        options: thresholds and the like.
        priors: what is known of the rig at every instant.
        ypr: whether to say its GeoPose in angles too.
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
    """What the solver was given for a photo, and what it made of it.

    Attributes:
        keypoints: (n, 2) pixels of the photo as stored.
        points: (n, 3) in the world.
        inliers: (n,) whether the pose agrees.
        overlay: JPEG of the photo with its matches, beside the retrieved photos.
    """

    keypoints: NDArray[np.float64]
    points: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    overlay: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Localization:
    """An answer and the map that gave it.

    Attributes:
        map_id: of the map, or of the set of maps, in whose frame the answer is.
        geodetic: where that map lies on Earth, when it is known.
        ypr: whether the caller wants the GeoPose in angles too.
        debug: when the caller wants it.
        tile: of a set, ``id@version`` of the map in it that gave the answer.
        reach: how far that map's photos see, in units of the answer's frame (median).
        anchor_rms: how far off its place on Earth the frame may be, in its unit; 0 when unknown.
    """

    answer: Answer
    map_id: str
    map_version: str
    geodetic: Geodetic | None = None
    ypr: bool = False
    debug: MatchPicture | None = None
    tile: str | None = None
    reach: float = 0.0
    anchor_rms: float = 0.0

    @property
    def ref(self) -> str:
        """``id@version`` of the map that gave the answer."""
        return self.tile or f"{self.map_id}@{self.map_version}"


@dataclass(frozen=True, slots=True, eq=False)
class InstantLocalization:
    """The answer to an instant and the map that gave it; attributes as of ``Localization``."""

    answer: InstantAnswer
    map_id: str
    map_version: str
    geodetic: Geodetic | None = None
    ypr: bool = False
    tile: str | None = None
    reach: float = 0.0
    anchor_rms: float = 0.0

    @property
    def ref(self) -> str:
        """``id@version`` of the map that gave the answer."""
        return self.tile or f"{self.map_id}@{self.map_version}"


def check_order(before: int, timestamp: int) -> None:
    """Refuse an instant of a sequence that is not after the one before it.

    Raises:
        InvalidInput: ``sequence.timestamps``.
    """
    if timestamp <= before:
        raise refuse(
            "sequence.timestamps",
            field="timestamp",
            expected=f"more than {before}, that of the instant before",
            got=timestamp,
        )
