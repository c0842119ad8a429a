"""What a caller of the clients sends and receives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.wire.geopose import GeoPose, GeoPoseYpr
from visloc.errors import VislocError, refuse
from visloc.geometry import Camera, Pose, Similarity

OptionValue = int | float | str | Mapping[str, float]

# On the wire whole numbers are uint32. Narrower ranges are the server's to tell.
_MAX_WHOLE = 2**32 - 1
_OPTION_KINDS: Mapping[str, type[OptionValue]] = {
    "preset": str,
    "top_k": int,
    "max_error_px": float,
    "min_inliers": int,
    "min_inlier_ratio": float,
    "read_as": str,
    "extraction": str,
    "fusion": str,
    "fusion_weights": dict,
    "matcher": str,
    "solver": str,
    "seed": int,
}
_EXPECTED = {
    int: f"a whole number from 0 to {_MAX_WHOLE}",
    float: "a finite number",
    str: "a text",
    dict: "a number for each of some global descriptors, such as densevlad=1,localvlad=2",
}


@dataclass(frozen=True, slots=True)
class LocalizeOptions:
    """What may be chosen per photo; None leaves the choice to the server.

    Attributes:
        preset: thresholds to start from: default, config1 or config2.
        top_k: how many mapping photos to match against.
        max_error_px: largest reprojection error of an inlier, pixels.
        min_inliers: fewest inliers of an accepted pose.
        min_inlier_ratio: smallest share of inliers among the correspondences, 0 to 1.
        read_as: ``upright`` (the server's default) to turn the photo by its EXIF orientation
            before features are found, or ``stored``; camera, keypoints and pose are those of the
            stored pixels either way.
        extraction: the effort that goes into finding the photo's features: fast, default or
            accurate. Features that are sent are taken as they are.
        fusion: how similarities under several global descriptors become one ranking, such as
            gharm or mean; None for the map's way.
        fusion_weights: positive weight by global descriptor; those without one are left out. None
            for the map's weights.
        matcher: how keypoints are matched: mutual, ratio or lightglue.
        solver: what searches for the pose: pycolmap, poselib or registration.
        seed: of RANSAC; equal seeds give equal answers.

    Raises:
        InvalidInput: ``options.NAME`` for a value that cannot be sent.
    """

    preset: str | None = None
    top_k: int | None = None
    max_error_px: float | None = None
    min_inliers: int | None = None
    min_inlier_ratio: float | None = None
    read_as: str | None = None
    extraction: str | None = None
    fusion: str | None = None
    fusion_weights: Mapping[str, float] | None = None
    matcher: str | None = None
    solver: str | None = None
    seed: int | None = None

    def __post_init__(self) -> None:
        for name, value in self.given().items():
            if not _can_be_sent(value, _OPTION_KINDS[name]):
                raise _not_usable(name, value)

    @staticmethod
    def from_mapping(values: Mapping[str, Any]) -> LocalizeOptions:
        """Make options from names and values.

        Raises:
            InvalidInput: ``request.unknown_field`` for a name that is none of the attributes.
        """
        for name in values:
            _check_option_name(name)
        return LocalizeOptions(**values)

    @staticmethod
    def from_texts(texts: Iterable[str]) -> LocalizeOptions:
        """Parse ``NAME=VALUE``, as the command line has them; weights are ``NAME=NUMBER,...``.

        Raises:
            InvalidInput: ``options.syntax``, ``request.unknown_field`` or ``options.NAME``.
        """
        values: dict[str, OptionValue] = {}
        for text in texts:
            name, equals, value = text.partition("=")
            if not equals:
                raise refuse("options.syntax", field="option", got=text)
            _check_option_name(name)
            try:
                values[name] = _PARSERS[_OPTION_KINDS[name]](value)
            except ValueError:
                raise _not_usable(name, value) from None
        return LocalizeOptions.from_mapping(values)

    def given(self) -> dict[str, OptionValue]:
        """The options that are not left to the server, by name."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {
            name: dict(value) if isinstance(value, Mapping) else value
            for name, value in values.items()
            if value is not None
        }


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """A pose and how sure it is.

    Attributes:
        cam_from_world: the pose.
        rotation_wxyz: its rotation as a unit quaternion (w, x, y, z), every digit as sent.
        translation: its translation, every digit as sent.
        position: (3,) camera centre in the world, metres when the map is metric.
        orientation: (4,) rotation of ``world_from_cam`` as a quaternion (w, x, y, z).
        covariance: (6, 6) of rotation (rad), then translation, for R <- Exp(w) R and
            t <- t + dt of ``cam_from_world``.
        position_std: (3,) standard deviations of ``position`` along the world's axes.
        orientation_std_deg: (3,) standard deviations about the camera's x, y, z, degrees.
    """

    cam_from_world: Pose
    rotation_wxyz: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    position: NDArray[np.float64]
    orientation: NDArray[np.float64]
    covariance: NDArray[np.float64]
    position_std: NDArray[np.float64]
    orientation_std_deg: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why there is no pose.

    Attributes:
        stage: the stage that gave up: features, retrieval, matching, pose or gate.
        reason: a stable word.
        message: the reason for a person.
    """

    stage: str
    reason: str
    message: str


@dataclass(frozen=True, slots=True)
class RetrievedImage:
    """A mapping photo that the query was matched against.

    Attributes:
        image: its name in the map.
        score: fused similarity, comparable within one answer only.
        similarities: cosine similarity by global descriptor.
    """

    image: str
    score: float
    similarities: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class CameraUsed:
    """The intrinsics that the pose was computed with.

    Attributes:
        camera: for the pixels as stored.
        source: given, given_scaled (from another size), exif, estimated (with the pose), or guess.
    """

    camera: Camera
    source: str


@dataclass(frozen=True, slots=True)
class Orientation:
    """How the photo was turned to find features.

    Camera, keypoints and pose are those of the stored pixels, whatever this says.

    Attributes:
        exif: the photo's EXIF orientation, 1 to 8; 1 when it has none.
        read_as: ``upright``: by its EXIF orientation; ``stored``: not at all, or features were
            sent.
    """

    exif: int
    read_as: str


@dataclass(frozen=True, slots=True)
class MapVersion:
    """The map that answered."""

    id: str
    version: str


@dataclass(frozen=True, slots=True, eq=False)
class Debug:
    """The correspondences behind an answer, and a picture of them.

    Attributes:
        keypoints: (n, 2) pixels of the photo as stored.
        points: (n, 3) in the world.
        inliers: (n,) whether the best pose explains the correspondence, refused or not.
        overlay: JPEG of the photo with its matches, beside the photos that it was found in.
    """

    keypoints: NDArray[np.float64]
    points: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    overlay: bytes


@dataclass(frozen=True, slots=True, eq=False)
class LocalizeResult:
    """The answer to one photo.

    Attributes:
        request_id: names the request in the server's logs.
        pose: None when the photo was not localized; then ``refusal`` says why.
        refusal: None when the photo was localized.
        keypoints: found in the photo.
        correspondences: 2D-3D, given to the solver.
        inliers: correspondences that agree with the pose.
        inlier_ratio: inliers / correspondences.
        retrieved: mapping photos matched against, best first.
        camera: intrinsics used and where they came from.
        orientation: how the pixels were read.
        map: the map that answered.
        seconds: wall time on the server by stage.
        raw: the answer as received; the same over HTTP and gRPC.
        geopose: of the camera; None without a pose, or when the map is not anchored to the Earth.
        geopose_ypr: the same in angles, when asked for.
        debug: the matches; None when they were not asked for.
        tile: of a set of maps, ``id@version`` of the map in it that the answer rests on, or that
            came closest; None for a map on its own.
    """

    request_id: str
    pose: PoseEstimate | None
    refusal: Refusal | None
    keypoints: int
    correspondences: int
    inliers: int
    inlier_ratio: float
    retrieved: tuple[RetrievedImage, ...]
    camera: CameraUsed
    orientation: Orientation
    map: MapVersion
    seconds: Mapping[str, float]
    raw: Mapping[str, Any]
    geopose: GeoPose | None = None
    geopose_ypr: GeoPoseYpr | None = None
    debug: Debug | None = None
    tile: str | None = None

    @property
    def localized(self) -> bool:
        """Whether there is a pose."""
        return self.pose is not None


@dataclass(frozen=True, slots=True)
class Near:
    """A circle on the Earth, WGS84; it stands for the anchored maps that reach into it.

    Attributes:
        latitude: degrees.
        longitude: degrees.
        radius: metres.

    Raises:
        InvalidInput: ``near.NAME`` for what is not a finite number.
    """

    latitude: float
    longitude: float
    radius: float

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not _can_be_sent(value, float):
                raise refuse(
                    f"near.{each.name}",
                    field=f"near.{each.name}",
                    expected=_EXPECTED[float],
                    got=value,
                )


@dataclass(frozen=True, slots=True)
class RigInfo:
    """A rig that a map knows.

    Attributes:
        id: what requests call it.
        sensors: the names of its cameras.
    """

    id: str
    sensors: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Geodetic:
    """Where a map's world lies on Earth.

    ``enu = scale R x + translation`` gives metres east, north and up of the position.

    Attributes:
        latitude_deg: WGS84.
        longitude_deg: WGS84.
        altitude_m: above the ellipsoid.
        scale: metres per unit of the world.
        rotation_wxyz: R as a unit quaternion (w, x, y, z).
        translation: metres.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    scale: float
    rotation_wxyz: tuple[float, ...]
    translation: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Anchor:
    """What a map's position, orientation and scale rest on.

    Attributes:
        kind: dataset, model, gnss, positions, correspondences or none.
        images: photos, or given points, that it rests on.
        rms: how far they are from where they were said to be, in units of the world; None where
            nothing was fitted.
        geodetic: None when the map is not anchored to the Earth.
    """

    kind: str
    images: int
    rms: float | None
    geodetic: Geodetic | None


@dataclass(frozen=True, slots=True)
class GeoCircle:
    """A circle on Earth that holds a map.

    Attributes:
        latitude: degrees, WGS84.
        longitude: degrees.
        radius: metres.
    """

    latitude: float
    longitude: float
    radius: float


@dataclass(frozen=True, slots=True)
class VersionInfo:
    """A published version of a map, and whether it is in use."""

    version: str
    current: bool


@dataclass(frozen=True, slots=True)
class TileInfo:
    """One map of a set: ``x_set = scale R x + translation`` of a point x in its world.

    Attributes:
        map: its id.
        version: of it.
        scale: units of the set's world in one of its own.
        rotation_wxyz: R as a unit quaternion (w, x, y, z).
        translation: in the set's world.
        extent: least and greatest x, y, z of its landmarks and photos, in the world of the set.
        images: mapping photos.
    """

    map: str
    version: str
    scale: float
    rotation_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    extent: tuple[tuple[float, ...], tuple[float, ...]]
    images: int

    @property
    def ref(self) -> str:
        """``id@version``."""
        return f"{self.map}@{self.version}"

    @property
    def set_from_tile(self) -> Similarity:
        """From its world to that of the set."""
        pose = Pose.from_quaternion(self.rotation_wxyz, self.translation)
        return Similarity(self.scale, pose.rotation, pose.translation)


@dataclass(frozen=True, slots=True)
class MapInfo:
    """A map that the server has, or a set of maps.

    Attributes:
        id: its name.
        version: of the map that ``id`` alone stands for, or the one asked for.
        created: ISO 8601, UTC.
        metric: whether one unit of the world is a metre.
        method: how its landmarks were made; None of a set.
        local_features: registry name.
        global_features: registry names.
        images: mapping photos.
        landmarks: 3D points.
        observations: sightings of landmarks in mapping photos; None of a set.
        extent: least and greatest x, y, z of the landmarks, in the world.
        size_bytes: on the server's disk.
        down: unit vector that points down in the world; None when the map does not know it.
        rigs: the rigs of the mapping photos, for requests that name one.
        anchor: what its world rests on; None for old maps, which do not tell.
        place: where it lies on Earth; None when it is not anchored there.
        current: whether this version is in use.
        versions: all published ones of the map, oldest first.
        content_hash: equal maps have equal ones, whatever they are called.
        fusion: of the global features, unless a query says otherwise; None of a set, and when an
            older server does not say.
        fusion_weights: by global feature; empty when all count alike.
        kind: map, or set.
        num_tiles: maps of a set; None of a map.
        tiles: of a set that was asked for alone; empty in lists.
    """

    id: str
    version: str
    created: str
    metric: bool
    method: str | None
    local_features: str
    global_features: tuple[str, ...]
    images: int
    landmarks: int
    observations: int | None
    extent: tuple[tuple[float, ...], tuple[float, ...]]
    size_bytes: int
    down: tuple[float, ...] | None
    rigs: tuple[RigInfo, ...]
    anchor: Anchor | None
    place: GeoCircle | None
    current: bool
    versions: tuple[VersionInfo, ...]
    content_hash: str
    fusion: str | None = None
    fusion_weights: Mapping[str, float] = field(default_factory=dict)
    kind: str = "map"
    num_tiles: int | None = None
    tiles: tuple[TileInfo, ...] = ()

    @property
    def ref(self) -> str:
        """``id@version``: this version, even after the server has switched to a newer one."""
        return f"{self.id}@{self.version}"


@dataclass(frozen=True, slots=True)
class ServerInfo:
    """The server itself.

    Attributes:
        version: of the service; None when a gRPC server does not say.
    """

    version: str | None


def _check_option_name(name: str) -> None:
    if name not in _OPTION_KINDS:
        raise refuse(
            "request.unknown_field", field=f"options.{name}", expected=_OPTION_KINDS, got=name
        )


def _weights(text: str) -> dict[str, float]:
    weights: dict[str, float] = {}
    for part in text.split(","):
        name, _, number = part.rpartition("=")
        name = name.strip()
        if not name or name in weights:
            raise ValueError(part)
        weights[name] = float(number)
    return weights


_PARSERS: Mapping[type, Callable[[str], OptionValue]] = {
    int: int,
    float: float,
    str: str,
    dict: _weights,
}


def _can_be_sent(value: object, kind: type) -> bool:
    if isinstance(value, bool):
        return False
    if kind is int:
        return isinstance(value, int) and 0 <= value <= _MAX_WHOLE
    if kind is float:
        return isinstance(value, int | float) and math.isfinite(value)
    if kind is dict:
        return (
            isinstance(value, Mapping)
            and len(value) > 0
            and all(name and _can_be_sent(name, str) for name in value)
            and all(_can_be_sent(weight, float) for weight in value.values())
        )
    return isinstance(value, str) and value.isprintable()


def _not_usable(name: str, value: object) -> VislocError:
    return refuse(
        f"options.{name}",
        "the value of the option is not valid",
        field=f"options.{name}",
        expected=_EXPECTED[_OPTION_KINDS[name]],
        got=value,
    )
