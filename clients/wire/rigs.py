"""Rigs, images and instants of requests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from clients.wire.features import PhotoOrFeatures
from visloc.geometry import Camera
from visloc.priors import Priors
from visloc.sequences.filling import Odometry
from visloc.types import RigSensor

# The id of a rig that the map knows, or the cameras of a rig by name.
Rig = str | Mapping[str, RigSensor]


@dataclass(frozen=True, slots=True, eq=False)
class RigImage:
    """One photo of an instant.

    Attributes:
        sensor: the camera of the rig that took it.
        query: the encoded photo, the path of the file that holds it, a ``MaskedImage``, or the
            features that were found in it.
        camera: its intrinsics, instead of those of the rig.
        timestamp: the same for all photos of a rig.
    """

    sensor: str
    query: PhotoOrFeatures
    camera: Camera | None = None
    timestamp: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """One instant of a sequence.

    Attributes:
        timestamp: greater than that of the instant before.
        images: each of another camera of the rig; without a rig, exactly one.
        odometry: None when there is none.
        priors: of this instant, instead of those of the sequence.
    """

    timestamp: int
    images: tuple[RigImage, ...]
    odometry: Odometry | None = None
    priors: Priors | None = None
