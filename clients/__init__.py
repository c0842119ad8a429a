"""Clients of the localization service: synchronous and asynchronous, over HTTP and gRPC."""

from clients.client import AsyncClient, Client
from clients.features import Features
from clients.rigs import (
    ImageResult,
    Instant,
    InstantResult,
    Odometry,
    Rig,
    RigImage,
    RigPose,
    RigSensor,
)
from clients.types import (
    CameraUsed,
    LocalizeOptions,
    LocalizeResult,
    MapInfo,
    MapVersion,
    Orientation,
    PoseEstimate,
    Refusal,
    RetrievedImage,
    RigInfo,
    ServerInfo,
)
from visloc.priors import GravityPrior, HeightBand, PosePrior, PositionPrior, Priors
from visloc.trajectory import PoseSource

__all__ = [
    "AsyncClient",
    "CameraUsed",
    "Client",
    "Features",
    "GravityPrior",
    "HeightBand",
    "ImageResult",
    "Instant",
    "InstantResult",
    "LocalizeOptions",
    "LocalizeResult",
    "MapInfo",
    "MapVersion",
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
]
