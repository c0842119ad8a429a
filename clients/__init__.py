"""Clients of the localization service: synchronous and asynchronous, over HTTP and gRPC."""

from clients.client import AsyncClient, Client
from clients.features import Features
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
    ServerInfo,
)

__all__ = [
    "AsyncClient",
    "CameraUsed",
    "Client",
    "Features",
    "LocalizeOptions",
    "LocalizeResult",
    "MapInfo",
    "MapVersion",
    "Orientation",
    "PoseEstimate",
    "Refusal",
    "RetrievedImage",
    "ServerInfo",
]
