"""Clients of the localization service: synchronous and asynchronous, over HTTP and gRPC."""

from clients.client import AsyncClient, Client
from clients.frames import Axes, blended, camera_matrix, session_from_map
from clients.wire.answers import ImageResult, InstantResult, LocalizeResult, ServerInfo
from clients.wire.features import Features
from clients.wire.rigs import Instant, Rig, RigImage
from visloc.priors import GnssPrior, GravityPrior, HeightBand, PosePrior, PositionPrior, Priors
from visloc.sequences.filling import Odometry
from visloc.types import MaskedImage, Near, PoseSource, RigSensor
from visloc_api.words.answers import (
    CameraUsed,
    Debug,
    Orientation,
    Refusal,
    RetrievedImage,
)
from visloc_api.words.answers import MapRef as MapVersion
from visloc_api.words.geopose import GeoPose, GeoPoseYpr
from visloc_api.words.maps import Anchor, GeoCircle, Geodetic, MapInfo, RigInfo, VersionInfo
from visloc_api.words.maps import Tile as TileInfo
from visloc_api.words.options import LocalizeOptions
from visloc_api.words.poses import PoseEstimate, RigPose
from visloc_api.words.scenes import MapImages

__all__ = [
    "Anchor",
    "AsyncClient",
    "Axes",
    "CameraUsed",
    "Client",
    "Debug",
    "Features",
    "GeoCircle",
    "GeoPose",
    "GeoPoseYpr",
    "Geodetic",
    "GnssPrior",
    "GravityPrior",
    "HeightBand",
    "ImageResult",
    "Instant",
    "InstantResult",
    "LocalizeOptions",
    "LocalizeResult",
    "MapImages",
    "MapInfo",
    "MapVersion",
    "MaskedImage",
    "Near",
    "Odometry",
    "Orientation",
    "PoseEstimate",
    "PosePrior",
    "PoseSource",
    "PositionPrior",
    "Priors",
    "Refusal",
    "RetrievedImage",
    "Rig",
    "RigImage",
    "RigInfo",
    "RigPose",
    "RigSensor",
    "ServerInfo",
    "TileInfo",
    "VersionInfo",
    "blended",
    "camera_matrix",
    "session_from_map",
]
