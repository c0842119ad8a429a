"""What is sent and received of rigs and sequences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.wire.features import PhotoOrFeatures
from clients.wire.geopose import GeoPose, GeoPoseYpr
from clients.wire.types import CameraUsed, MapVersion, Orientation, Refusal, RetrievedImage
from visloc.errors import VislocError
from visloc.geometry import Camera, Pose
from visloc.priors import Priors
from visloc.sequences.filling import PoseSource


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


@dataclass(frozen=True, slots=True, eq=False)
class RigPose:
    """Where a rig was and how sure that is.

    Attributes:
        rig_from_world: the pose.
        rotation_wxyz: its rotation as a unit quaternion (w, x, y, z), every digit as sent.
        translation: its translation, every digit as sent.
        position: (3,) the rig's origin in the world, metres when the map is metric.
        orientation: (4,) rotation of ``world_from_rig`` as a quaternion (w, x, y, z).
        covariance: (6, 6) of rotation (rad), then translation, for R <- Exp(w) R and
            t <- t + dt of ``rig_from_world``.
        position_std: (3,) standard deviations of ``position`` along the world's axes.
        orientation_std_deg: (3,) standard deviations about the rig's x, y, z, degrees.
    """

    rig_from_world: Pose
    rotation_wxyz: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    position: NDArray[np.float64]
    orientation: NDArray[np.float64]
    covariance: NDArray[np.float64]
    position_std: NDArray[np.float64]
    orientation_std_deg: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ImageResult:
    """What became of one photo of an instant.

    Attributes:
        sensor: the camera of the rig.
        error: why the photo could not be used; then at most ``cam_from_world`` is known.
        cam_from_world: where the camera was, by the rig's pose; None without one.
        keypoints: found in the photo.
        correspondences: 2D-3D, given to the solver.
        inliers: correspondences that agree with the rig's pose.
        retrieved: mapping photos matched against, best first.
        camera: intrinsics used and where they came from.
        orientation: how the pixels were read.
    """

    sensor: str
    error: VislocError | None
    cam_from_world: Pose | None
    keypoints: int
    correspondences: int
    inliers: int
    retrieved: tuple[RetrievedImage, ...]
    camera: CameraUsed | None
    orientation: Orientation | None


@dataclass(frozen=True, slots=True, eq=False)
class InstantResult:
    """The answer to the photos of one instant.

    Attributes:
        request_id: names the request in the server's logs.
        timestamp: as it was sent; None when it was not.
        status: ``localized``; ``filled`` when the pose rests on other instants; ``not_localized``.
        source: what the pose rests on; None without one.
        pose: None when there is none.
        refusal: why the instant's own photos gave no pose; None when they did.
        images: of each photo, in the order sent.
        correspondences: 2D-3D, of all photos.
        inliers: correspondences that agree with the pose.
        inlier_ratio: inliers / correspondences.
        map: the map that answered.
        seconds: wall time on the server by stage.
        raw: the answer as received; the same over HTTP and gRPC.
        geopose: of the rig, whose frame is read like a camera's (x right, y down, z forward); None
            without a pose, or when the map is not anchored to the Earth.
        geopose_ypr: the same in angles, when asked for.
        tile: as of ``LocalizeResult``.
    """

    request_id: str
    timestamp: int | None
    status: str
    source: PoseSource | None
    pose: RigPose | None
    refusal: Refusal | None
    images: tuple[ImageResult, ...]
    correspondences: int
    inliers: int
    inlier_ratio: float
    map: MapVersion
    seconds: Mapping[str, float]
    raw: Mapping[str, Any]
    geopose: GeoPose | None = None
    geopose_ypr: GeoPoseYpr | None = None
    tile: str | None = None

    @property
    def localized(self) -> bool:
        """Whether the instant's own photos gave the pose; False when it was filled."""
        return self.status == "localized"
