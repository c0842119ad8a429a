"""The words of the API: what requests and answers look like in JSON.

The messages of ``proto/visloc_api/v1/localization.proto`` have the same fields, and gRPC requests
are checked and its answers made by these models, so that both doors say the same.
"""

from __future__ import annotations

from service.api.answer import Debug, LocalizeResponse, PoseEstimate
from service.api.evidence import CameraUsed, MapRef, Orientation, Refusal, RetrievedImage
from service.api.features import ARRAY_DTYPES, MAX_GLOBAL_DESCRIPTORS, Array, Features
from service.api.geometry import Camera, Transform
from service.api.geopose import (
    GeoAngles,
    GeoPose,
    GeoPoseYpr,
    GeoPosition,
    GeoQuaternion,
    Near,
)
from service.api.instants import (
    ImageAnswer,
    ImageError,
    InstantAnswer,
    LocalizeSequenceResponse,
    RigPose,
)
from service.api.localize import MAX_MAPS, LocalizeRequest
from service.api.maps import (
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
from service.api.options import LocalizeOptions
from service.api.priors import GravityPrior, HeightBand, PosePrior, PositionPrior, Priors
from service.api.rigs import (
    MAX_SENSORS,
    BatchLimits,
    LocalizeRigRequest,
    Parts,
    RigCalibration,
    RigImage,
    RigSensor,
)
from service.api.scene import MapCamera, MapImage, MapImages
from service.api.sequences import (
    Instant,
    LocalizeSequenceRequest,
    Odometry,
    SequenceStart,
)
from service.api.status import Health, MapNotLoaded, Problem, Readiness

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
