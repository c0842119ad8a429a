"""What is sent of rigs and sequences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clients.wire.features import PhotoOrFeatures
from visloc.geometry import Camera, Pose
from visloc.priors import Priors


@dataclass(frozen=True, slots=True, eq=False)
class RigSensor:
    """One camera of a rig.

    Attributes:
        cam_from_rig: where it sits.
        camera: the intrinsics of its photos, where they are known.
    """

    cam_from_rig: Pose
    camera: Camera | None = None


# The id of a rig that the map knows, or the cameras of a rig by name.
Rig = str | Mapping[str, RigSensor]


@dataclass(frozen=True, slots=True, eq=False)
class RigImage:
    """One photo of an instant.

    Attributes:
        sensor: the camera of the rig that took it.
        query: the encoded photo, the path of the file that holds it, or the features that were
            found in it.
        camera: its intrinsics, instead of those of the rig.
        timestamp: the same for all photos of a rig.
    """

    sensor: str
    query: PhotoOrFeatures
    camera: Camera | None = None
    timestamp: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Where a tracker (visual-inertial, wheels, ARKit, ARCore) has the rig, in its own world.

    Attributes:
        rig_from_odometry: the pose, in metres; only the motion between instants is used.
        covariance: (6, 6) of the motion ``rig_from_previous_rig`` since the previous instant:
            rotation (rad), then translation; None leaves an allowance for drift to the server.
    """

    rig_from_odometry: Pose
    covariance: NDArray[np.float64] | None = None


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
