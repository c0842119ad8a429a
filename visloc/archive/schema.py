"""Schema of a map's manifest and JSON files (docs/map-format.md)."""

from __future__ import annotations

import math
import re
from typing import Annotated, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.dataclasses import dataclass

from visloc.errors import InvalidInput
from visloc.options import Fusion, check_fusion_weights
from visloc.retrieval.fusion import LateFusion
from visloc.types import Fingerprint

FORMAT = "visloc-map"
FORMAT_MAJOR, FORMAT_MINOR = 3, 2

ID_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
# Names of a map's files: a path below the map on every operating system.
FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}(/[A-Za-z0-9][A-Za-z0-9._-]{0,127}){0,3}")

INDEX_FOLDER = "index/"

# A photo that a map keeps: pixels of its longer side, and bytes.
MAX_PHOTO_SIDE = 640
MAX_PHOTO_BYTES = 2**20

Vector = tuple[float, float, float]
# Farther than Earth-centred coordinates reach, and near enough for millimetres in float64.
_Metres = Annotated[float, Field(ge=-1e9, le=1e9)]
Origin = tuple[_Metres, _Metres, _Metres]
VectorT = TypeVar("VectorT", bound=tuple[float, ...])
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


def _of_unit_length(vector: VectorT) -> VectorT:
    length = math.hypot(*vector)
    if abs(length - 1.0) > 1e-6:
        raise ValueError(f"the vector should have the length 1, not {length:g}")
    return vector


Direction = Annotated[Vector, AfterValidator(_of_unit_length)]
UnitQuaternion = Annotated[tuple[float, float, float, float], AfterValidator(_of_unit_length)]


def photo_file(image: int) -> str:
    """Name of the file of the photo in a row of ``images.json``, in maps that keep photos."""
    return f"photos/{image:06d}.jpg"


class Record(BaseModel):
    """A frozen JSON object without infinities."""

    # Unknown fields are allowed: a reader must open maps of a newer minor format.
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class FileEntry(Record):
    """Size and checksum of one file of the map."""

    size: Annotated[int, Field(ge=0)]
    sha256: Sha256


class FingerprintRecord(Record):
    """``visloc.types.Fingerprint`` as JSON; ready-made features are named ``kapture:TYPE``."""

    name: Annotated[
        str, Field(pattern=r"^([a-z0-9][a-z0-9_.-]*|kapture:[A-Za-z0-9][A-Za-z0-9_.-]{0,63})$")
    ]
    revision: int
    parameters: dict[str, int | float | str]
    weights_sha256: Sha256 | None = None

    @staticmethod
    def of(fingerprint: Fingerprint) -> FingerprintRecord:
        return FingerprintRecord(
            name=fingerprint.name,
            revision=fingerprint.revision,
            parameters=dict(fingerprint.parameters),
            weights_sha256=fingerprint.weights_sha256,
        )

    @property
    def file_stem(self) -> str:
        """The name as part of a file name; not every file system allows colons."""
        return self.name.replace(":", "-")


class LocalFeaturesRecord(Record):
    """The local feature of a map, and how its observations are stored."""

    fingerprint: FingerprintRecord
    max_keypoints: Annotated[int, Field(ge=1)]
    descriptor_dim: Annotated[int, Field(ge=1)]
    # value = stored int8 x scale
    descriptor_scale: Annotated[float, Field(gt=0)]
    # pixel = stored int16 x step; None: pixels are stored as float32, as in all maps before 2.0.
    keypoint_step_px: Annotated[float, Field(gt=0, le=1)] | None = None
    computed_with: str | None = None  # for people


class GlobalFeaturesRecord(Record):
    """One global descriptor of a map.

    Attributes:
        bits: 8 for int8 with a scale for each row; 32 for float32, as in all maps before 2.0.
        lists: number of lists of the inverted file; None where all rows are compared with a query.
        clusters: of another index, which maps before 3.1 may have; it is not read.
    """

    fingerprint: FingerprintRecord
    dim: Annotated[int, Field(ge=1)]
    bits: Literal[8, 32] = 32
    lists: Annotated[int, Field(ge=1)] | None = None
    clusters: Annotated[int, Field(ge=1)] | None = None


class RetrievalRecord(Record):
    """How queries rank the map's photos unless they say otherwise; ``LateFusion`` as JSON."""

    fusion: Fusion = Fusion.GHARM
    weights: dict[str, float] | None = None

    @staticmethod
    def of(fusion: LateFusion) -> RetrievalRecord:
        weights = None if fusion.weights is None else dict(fusion.weights)
        return RetrievalRecord(fusion=fusion.operator, weights=weights)

    @property
    def late_fusion(self) -> LateFusion:
        return LateFusion(self.fusion, self.weights)


class Extent(Record):
    """Axis-aligned bounding box of all landmarks."""

    min: Vector
    max: Vector


_Bounded = Annotated[float, Field(ge=-1e12, le=1e12)]
_Row = tuple[_Bounded, _Bounded, _Bounded, _Bounded, _Bounded, _Bounded, _Bounded]


class PlaceError(Record):
    """How far off a place on Earth may be that was fitted to fixes or given points.

    Attributes:
        middle: of these, metres east, north and up of the place.
        covariance: 7 x 7 of w, t and s, for ``enu' = middle + exp(s) Exp(w) (enu - middle) + t``:
            rad, metres, and the logarithm of the scale.
        level: standard deviation of one of these, metres east and north.
        up: the same upwards.
    """

    middle: tuple[_Bounded, _Bounded, _Bounded]
    covariance: tuple[_Row, _Row, _Row, _Row, _Row, _Row, _Row]
    level: Annotated[float, Field(ge=0, le=1e6)]
    up: Annotated[float, Field(ge=0, le=1e6)]


class Geodetic(Record):
    """Where the world lies on Earth, WGS84.

    ``enu = scale R x + translation`` gives metres east, north and up of the position. Maps of
    formats before 1.3 have the identity: their axes point east, north and up, in metres. ``error``
    does not depend on the world's frame; None when it is unknown.
    """

    latitude_deg: Annotated[float, Field(ge=-90, le=90)]
    longitude_deg: Annotated[float, Field(ge=-180, le=180)]
    altitude_m: float
    scale: Annotated[float, Field(gt=0)] = 1.0
    rotation_wxyz: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)
    translation: Vector = (0.0, 0.0, 0.0)
    error: PlaceError | None = None


class Anchor(Record):
    """What the world's position, orientation and scale rest on.

    Attributes:
        kind: ``dataset``: poses from the dataset; ``model``: poses from an imported
            reconstruction; ``gnss`` or ``positions``: aligned to fixes or known positions;
            ``correspondences``: tied to the Earth by given points; ``none``: arbitrary frame.
        images: number of photos or given points that it rests on.
        rms: root mean square distance between these and their given positions, in units of the
            world; None where nothing was fitted.
        geodetic: where the world lies on Earth; None when unknown.
    """

    kind: Literal["dataset", "model", "gnss", "positions", "correspondences", "none"]
    images: Annotated[int, Field(ge=0)]
    rms: Annotated[float, Field(ge=0)] | None = None
    geodetic: Geodetic | None = None


class World(Record):
    """The frame of the map. Format 1.0 had no anchor, format 1.1 no gravity.

    ``gravity`` points down. ``visloc.archive.Map.gravity`` also derives it from a geodetic anchor.
    """

    metric: bool
    origin: Origin
    extent: Extent
    anchor: Anchor | None = None
    gravity: Direction | None = None


class Counts(Record):
    """Numbers of photos, landmarks and observations.

    Without landmarks, which format 3.2 allows, each observation stands for one of its own, and
    queries triangulate them.
    """

    images: Annotated[int, Field(ge=1)]
    landmarks: Annotated[int, Field(ge=0)]
    observations: Annotated[int, Field(ge=1)]


class Method(Record):
    """How the landmarks were made."""

    name: str
    settings: dict[str, JsonValue]


# A pose is off by more than its photo tells, but not without bounds.
MAX_FACTOR = 1000.0
MAX_WRONG_SCORES = 32
_MOST_PHOTOS = 2**31


class Score(Record):
    """What spoke for a wrong pose of the own test."""

    inliers: Annotated[int, Field(ge=0)]
    inlier_ratio: Annotated[float, Field(ge=0, le=1)]


class OwnTest(Record):
    """What a map learned from its own photos, each localized in the map without itself.

    Attributes:
        tested: photos that were tried.
        localized: of these, those that got a pose.
        wrong: of these, those at another place than the photo.
        position_factor: by how much poses are further off than the scatter of their photos tells;
            ``visloc.pose.covariance.MapErrors``.
        orientation_factor: likewise.
        independent: whether the photos' own poses came from elsewhere than the map's landmarks.
        wrong_at: the scores of wrong poses, the most convincing first.
    """

    tested: Annotated[int, Field(ge=0, le=_MOST_PHOTOS)]
    localized: Annotated[int, Field(ge=0, le=_MOST_PHOTOS)]
    wrong: Annotated[int, Field(ge=0, le=_MOST_PHOTOS)]
    position_factor: Annotated[float, Field(ge=1, le=MAX_FACTOR)]
    orientation_factor: Annotated[float, Field(ge=1, le=MAX_FACTOR)]
    independent: bool
    wrong_at: Annotated[tuple[Score, ...], Field(max_length=MAX_WRONG_SCORES)] = ()

    @model_validator(mode="after")
    def _counts_fit(self) -> OwnTest:
        if not len(self.wrong_at) <= self.wrong <= self.localized <= self.tested:
            raise ValueError("wrong, localized and tested photos do not fit each other")
        return self


class Doubt(Record):
    """A reason why a version was not put into use by itself.

    Attributes:
        kind: ``own_test``, ``left_out``, ``pieces``, ``places``, ``matches`` or ``unit``; of given
            poses and depth maps ``poses`` or ``depth``; of a capture also ``order``, ``scale`` or
            ``size``.
        photos: names of those that it is about, or of the first of them.
    """

    kind: Annotated[str, Field(max_length=100)]
    message: Annotated[str, Field(max_length=1000)]
    photos: Annotated[tuple[str, ...], Field(max_length=100)] = ()


class Parts(Record):
    """Parts that a map may have or not; a reader ignores those that it does not know."""

    own_test: OwnTest | None = None
    doubts: Annotated[tuple[Doubt, ...], Field(max_length=100)] = ()


# In the settings of the largest of several maps of one build; there also if it is the only one.
# Updates and merges drop it: nothing tells which versions of the pieces belong to what they make.
PIECES = "pieces"
_REF = re.compile(rf"{ID_PATTERN.pattern}@{ID_PATTERN.pattern}")


class Manifest(Record):
    """``manifest.json``."""

    format: Literal["visloc-map"]
    format_version: Annotated[str, Field(pattern=r"^[0-9]{1,8}\.[0-9]{1,8}$")]
    id: Annotated[str, Field(pattern=rf"^{ID_PATTERN.pattern}$")]
    version: Annotated[str, Field(pattern=rf"^{ID_PATTERN.pattern}$")]
    created: str
    world: World
    method: Method
    local_features: LocalFeaturesRecord
    global_features: Annotated[tuple[GlobalFeaturesRecord, ...], Field(min_length=1)]
    # Maps of formats before 2.1 have none and use the default.
    retrieval: RetrievalRecord = RetrievalRecord()
    counts: Counts
    # Maps of formats before 3.0 have none.
    parts: Parts = Parts()
    notes: tuple[str, ...] = ()
    content_hash: Sha256
    manifest_hash: Sha256
    files: dict[str, FileEntry]

    @field_validator("retrieval")
    @classmethod
    def _weighs_what_there_is(
        cls, retrieval: RetrievalRecord, info: ValidationInfo
    ) -> RetrievalRecord:
        if retrieval.weights is not None:
            try:
                check_fusion_weights(retrieval.weights, "map.manifest", "weights")
            except InvalidInput as error:
                raise ValueError(str(error)) from error
            known = {g.fingerprint.name for g in info.data.get("global_features", ())}
            if not retrieval.weights.keys() <= known:
                raise ValueError(f"weights of others than the map's {', '.join(sorted(known))}")
        return retrieval

    @property
    def pieces(self) -> list[str]:
        """``id@version`` of the other pieces of the build that made this map, largest first."""
        pieces = self.method.settings.get(PIECES)
        refs = map(str, pieces) if isinstance(pieces, list) else ()
        return [ref for ref in refs if _REF.fullmatch(ref)]


class CameraRecord(Record):
    """``visloc.geometry.Camera`` as JSON."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class CamerasFile(Record):
    """``cameras.json``: cameras by sensor id; of each rig, cam_from_rig by sensor id."""

    cameras: dict[str, CameraRecord]
    # qw qx qy qz tx ty tz
    rigs: dict[str, dict[str, tuple[float, float, float, float, float, float, float]]] = {}


# A dataclass takes a fifth of the memory of a pydantic model, and there may be 100 000.
@dataclass(frozen=True, slots=True)
class ImageRecord:
    """One mapping photo; its pose is the same row of ``image_poses.npy``.

    ``turn`` is the EXIF orientation by which the photo was turned for feature extraction. Its
    camera, pose and keypoints refer to the pixels as stored.
    """

    name: str
    camera: str
    timestamp: int
    turn: Annotated[int, Field(ge=1, le=8)] = 1


class ImagesFile(Record):
    """``images.json``."""

    images: tuple[ImageRecord, ...]
