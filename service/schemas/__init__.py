"""The words of the API: what requests and answers look like in JSON.

The messages of ``proto/visloc_api/v1/localization.proto`` have the same fields, and gRPC requests
are checked and its answers made by these models, so that both doors say the same.
"""

from __future__ import annotations

from service.schemas.answer import Debug, LocalizeResponse, PoseEstimate
from service.schemas.evidence import CameraUsed, MapRef, Orientation, Refusal, RetrievedImage
from service.schemas.features import ARRAY_DTYPES, MAX_GLOBAL_DESCRIPTORS, Array, Features
from service.schemas.geometry import Camera, Transform
from service.schemas.geopose import (
    GeoAngles,
    GeoPose,
    GeoPoseYpr,
    GeoPosition,
    GeoQuaternion,
    Near,
)
from service.schemas.instants import (
    ImageAnswer,
    ImageError,
    InstantAnswer,
    LocalizeSequenceResponse,
    RigPose,
)
from service.schemas.localize import MAX_MAPS, LocalizeRequest
from service.schemas.maps import (
    Anchor,
    Extent,
    GeoCircle,
    Geodetic,
    ListMapsResponse,
    MapInfo,
    RigInfo,
    Similarity,
    Tile,
    UseVersionRequest,
    VersionInfo,
)
from service.schemas.options import LocalizeOptions
from service.schemas.priors import GravityPrior, HeightBand, PosePrior, PositionPrior, Priors
from service.schemas.rigs import (
    MAX_SENSORS,
    BatchLimits,
    LocalizeRigRequest,
    Parts,
    RigCalibration,
    RigImage,
    RigSensor,
)
from service.schemas.scene import MapCamera, MapImage, MapImages
from service.schemas.sequences import (
    Instant,
    LocalizeSequenceRequest,
    Odometry,
    SequenceStart,
)
from service.schemas.status import Health, MapNotLoaded, Problem, Readiness

__all__ = [
    "ARRAY_DTYPES",
    "MAX_GLOBAL_DESCRIPTORS",
    "MAX_MAPS",
    "MAX_SENSORS",
    "Anchor",
    "Array",
    "BatchLimits",
    "Camera",
    "CameraUsed",
    "Debug",
    "Extent",
    "Features",
    "GeoAngles",
    "GeoCircle",
    "GeoPose",
    "GeoPoseYpr",
    "GeoPosition",
    "GeoQuaternion",
    "Geodetic",
    "GravityPrior",
    "Health",
    "HeightBand",
    "ImageAnswer",
    "ImageError",
    "Instant",
    "InstantAnswer",
    "ListMapsResponse",
    "LocalizeOptions",
    "LocalizeRequest",
    "LocalizeResponse",
    "LocalizeRigRequest",
    "LocalizeSequenceRequest",
    "LocalizeSequenceResponse",
    "MapCamera",
    "MapImage",
    "MapImages",
    "MapInfo",
    "MapNotLoaded",
    "MapRef",
    "Near",
    "Odometry",
    "Orientation",
    "Parts",
    "PoseEstimate",
    "PosePrior",
    "PositionPrior",
    "Priors",
    "Problem",
    "Readiness",
    "Refusal",
    "RetrievedImage",
    "RigCalibration",
    "RigImage",
    "RigInfo",
    "RigPose",
    "RigSensor",
    "SequenceStart",
    "Similarity",
    "Tile",
    "Transform",
    "UseVersionRequest",
    "VersionInfo",
]
