"""The values that travel between the stages. Arrays come with shape, dtype and unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from visloc.errors import VislocError, refuse
from visloc.geometry import Camera, Pose
from visloc.options import ReadAs


@dataclass(frozen=True, slots=True, eq=False)
class LocalFeatures:
    """Keypoints of one photo, strongest first.

    Attributes:
        keypoints: (N, 2) float32, (x, y) in pixels of the photo as stored; the centre of the
            top-left pixel is (0.5, 0.5).
        descriptors: (N, D) float32, rows of unit length.
        scores: (N,) float32, higher is better, comparable within one photo only.
        scales: (N,) float32, diameter in pixels of the patch that was described.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    scores: NDArray[np.float32]
    scales: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.keypoints)

    def of(self, which: NDArray[np.bool_]) -> LocalFeatures:
        """Keep some of the keypoints, by mask (N,)."""
        return LocalFeatures(
            self.keypoints[which],
            self.descriptors[which],
            self.scores[which],
            self.scales[which],
        )

    def strongest(self, most: int) -> LocalFeatures:
        """Keep the first ``most`` keypoints: extractors return the strongest first."""
        return LocalFeatures(
            self.keypoints[:most], self.descriptors[:most], self.scores[:most], self.scales[:most]
        )

    def reduced(self, by: float) -> LocalFeatures:
        """Return these features in a photo whose sides are divided by a number."""
        if by == 1.0:
            return self
        return replace(
            self,
            keypoints=(self.keypoints / by).astype(np.float32),
            scales=(self.scales / by).astype(np.float32),
        )


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """Identifies what was computed: equal fingerprints mean comparable features.

    Attributes:
        name: the registry's name.
        revision: raised whenever the code changes what comes out.
        parameters: everything that shapes the result.
        weights_sha256: of the weights file as published; None without weights.
    """

    name: str
    revision: int
    parameters: Mapping[str, int | float | str]
    weights_sha256: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MaskedImage:
    """A photo of which only a part counts.

    Attributes:
        image: the encoded photo.
        mask: an encoded picture of its size or aspect; black pixels do not count.
    """

    image: bytes
    mask: bytes


@dataclass(frozen=True, slots=True, eq=False)
class QueryFeatures:
    """The features of one photo, sent instead of it; nothing in them is checked yet.

    Attributes:
        kind: the name of the local features, as the map has it.
        keypoints: (N, 2) numbers, (x, y) in pixels of the camera; the centre of the top-left pixel
            is (0.5, 0.5).
        descriptors: (N, D) numbers of any length.
        global_descriptors: by name, as the map has it, (D,) numbers of any length.
        matches: by the name of a mapping photo, (k, 3) numbers: the row of a keypoint, and x, y of
            the keypoint of that photo which it is matched with, in pixels of its camera. When there
            are any, they replace matching by descriptors.
    """

    kind: str
    keypoints: NDArray[np.generic]
    descriptors: NDArray[np.generic]
    global_descriptors: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)
    matches: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)


class PoseSource(StrEnum):
    """The evidence for a pose."""

    ESTIMATED = "estimated"  # the images of this camera or rig, at this instant
    RIG = "rig"  # another camera of the rig at the same instant
    MOTION = "motion"  # images of other instants, through the relative motion that was given
    INTERPOLATED = "interpolated"  # the instants before and after
    NEAREST = "nearest"  # the nearest instant


class CoarseMethod(StrEnum):
    """How the poses of retrieved photos approximate that of the query."""

    EWB = "ewb"  # equal weighted barycentre
    BDI = "bdi"  # barycentric descriptor interpolation
    CSI = "csi"  # weighted by cosine similarity


class Uncertainty(StrEnum):
    """What a covariance covers."""

    WHOLE = "whole"  # errors of the photo's measurements, and those of the map
    PHOTO_ONLY = "photo only"  # the map has no test of its own: its errors are not in it


@dataclass(frozen=True, slots=True, eq=False)
class RigSensor:
    """One camera of a rig.

    Attributes:
        cam_from_rig: where it sits.
        camera: the intrinsics of its photos; None when unknown.
    """

    cam_from_rig: Pose
    camera: Camera | None = None


# Half of the Earth's girth reaches everywhere.
MAX_RADIUS_M = 20_050_000.0


@dataclass(frozen=True, slots=True)
class Near:
    """A circle on the Earth, WGS84; it stands for the anchored maps that reach into it.

    Attributes:
        latitude: degrees.
        longitude: degrees.
        radius: metres.

    Raises:
        InvalidInput: ``near.latitude``, ``near.longitude`` or ``near.radius``.
    """

    latitude: float
    longitude: float
    radius: float

    def __post_init__(self) -> None:
        for name, low, high in (
            ("latitude", -90.0, 90.0),
            ("longitude", -180.0, 180.0),
            ("radius", 0.0, MAX_RADIUS_M),
        ):
            value = getattr(self, name)
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            # NaN fails too.
            if not is_number or not low <= value <= high or (name == "radius" and value == 0):
                raise refuse(
                    f"near.{name}",
                    field=f"near.{name}",
                    expected=f"more than 0, at most {high:.0f} metres"
                    if name == "radius"
                    else f"{low:g} to {high:g} degrees",
                    got=value,
                )


class CameraSource(StrEnum):
    """Where the intrinsics of a query came from."""

    GIVEN = "given"
    GIVEN_SCALED = "given_scaled"  # given for another size of the same aspect
    MAP = "map"  # of the map's own photos by the same camera
    EXIF = "exif"  # focal length from the photo's EXIF
    GUESS = "guess"  # nothing known: 1.2 times the longer side
    ESTIMATED = "estimated"  # nothing known: found together with the pose


class Reason(StrEnum):
    """Why a photo was not localized."""

    NO_KEYPOINTS = "no_keypoints"
    TOO_FEW_MATCHES = "too_few_matches"
    NO_POSE = "no_pose"
    TOO_FEW_INLIERS = "too_few_inliers"
    LOW_INLIER_RATIO = "low_inlier_ratio"
    UNCERTAIN_POSE = "uncertain_pose"
    CAMERA_CONTRADICTED = "camera_contradicted"  # the photo speaks for other intrinsics
    NO_PHOTO_NEAR = "no_photo_near"  # the map has no photo where the priors allow the device
    CONTRADICTS_PRIOR = "contradicts_prior"
    CONTRADICTS_MOTION = "contradicts_motion"  # the images of its neighbours, and how it moved
    UNLIKELY_POSE = "unlikely_pose"  # what the map has there speaks against it
    AMBIGUOUS = "ambiguous"  # two of several places explain the images about equally well
    NO_USABLE_IMAGE = "no_usable_image"  # none of an instant's images could be read


# The stages that can give up.
Stage = Literal["features", "retrieval", "matching", "pose", "gate"]


@dataclass(frozen=True, slots=True)
class RetrievedImage:
    """A mapping photo that the query was matched against.

    Attributes:
        name: its name in the map.
        score: fused similarity, comparable within one query only.
        similarities: cosine similarity by global descriptor.
    """

    name: str
    score: float
    similarities: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What was seen on the way to an answer, localized or not.

    Attributes:
        camera: the intrinsics used, for the pixels as stored.
        exif_orientation: the photo's EXIF orientation, 1 to 8; 1 when it has none or was not sent.
        read_as: the orientation in which features were found, ``UPRIGHT`` or ``STORED``.
        turned: degrees clockwise by which the photo was turned beyond that, because the map did
            not know it otherwise; 0 to 315.
        num_keypoints: keypoints found in the photo, or sent.
        num_correspondences: 2D-3D correspondences given to the solver.
        num_inliers: those that agree with the pose (of the best pose, when it was refused).
        retrieved: the mapping photos matched against, best first.
        seconds: wall time by stage.
    """

    camera: Camera
    camera_source: CameraSource
    exif_orientation: int
    read_as: ReadAs
    num_keypoints: int = 0
    num_correspondences: int = 0
    num_inliers: int = 0
    retrieved: tuple[RetrievedImage, ...] = ()
    turned: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def inlier_ratio(self) -> float:
        """Share of inliers among the correspondences, 0 when there are none."""
        return self.num_inliers / self.num_correspondences if self.num_correspondences else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One of the places between which an ambiguous query leaves the choice.

    Attributes:
        rig_from_world: the pose there, in the frame of ``map``; of the camera, for a photo on its
            own.
        map: ``id@version`` of the map, or of the set of maps.
        tile: of a set, ``id@version`` of the map in it; None otherwise.
        image: the mapping photo that speaks most for this place; None when none is known.
        preference: how surely the keypoints speak for this place and against the other one, in
            standard deviations; None when they were not compared.
    """

    rig_from_world: Pose
    num_inliers: int
    map: str
    tile: str | None = None
    image: str | None = None
    preference: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CoarsePose:
    """Where retrieved photos say that a photo was taken; no keypoint confirms it.

    Attributes:
        covariance: (6, 6) float64 of rotation (rad) then translation, for R <- Exp(w) R and
            t <- t + dt of ``cam_from_world``: an ellipsoid of 95 % holds for photos of this map.
        position_std: (3,) standard deviations of the camera centre along the world's axes.
        orientation_std: (3,) standard deviations of w (rad), about the camera's x, y, z.
        method: how the poses of the retrieved photos were put together.
    """

    cam_from_world: Pose
    covariance: NDArray[np.float64]
    position_std: NDArray[np.float64]
    orientation_std: NDArray[np.float64]
    method: CoarseMethod


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why the images of an instant gave no pose.

    Attributes:
        stage: the stage that gave up.
        reason: why, as a stable word.
        message: why, for a person.
        candidates: the two places of an ambiguous instant, most inliers first; () otherwise.
    """

    stage: Stage
    reason: Reason
    message: str
    candidates: tuple[Candidate, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class RigPose:
    """Where a rig was, how sure that is, and what it rests on.

    Attributes:
        rig_from_world: the pose.
        covariance: (6, 6) float64 of rotation (rad) then translation, for R <- Exp(w) R and
            t <- t + dt of ``rig_from_world``: the whole, as far as ``uncertainty`` says.
        position_std: (3,) standard deviations of the rig's origin along the world's axes.
        orientation_std: (3,) standard deviations of w (rad), about the rig's x, y, z.
        source: ESTIMATED when the instant's own images measured it.
        photo_covariance: (6, 6) float64, the part of ``covariance`` that the scatter of the
            instant's own images and the errors of their cameras leave open; None for a pose that
            they did not measure.
        uncertainty: what ``covariance`` covers.
        probability: that the pose is right, 0 to 1 (docs/decisions/0029-evidence-against.md),
            judged by the instant's own images; None when they did not measure it, or only with the
            help of other instants, or were not compared with the map around the pose.
    """

    rig_from_world: Pose
    covariance: NDArray[np.float64]
    position_std: NDArray[np.float64]
    orientation_std: NDArray[np.float64]
    source: PoseSource
    photo_covariance: NDArray[np.float64] | None
    uncertainty: Uncertainty
    probability: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Localized:
    """A photo's pose that passed the gate: the pose of the rig of one camera that it is.

    Attributes:
        pose: as its own measurements gave it; the properties below read it as a camera's.
        inlier_keypoints: (N, 2) float32 pixels of the photo as stored.
        inlier_points: (N, 3) float64 in the world.
    """

    evidence: Evidence
    pose: RigPose
    inlier_keypoints: NDArray[np.float32]
    inlier_points: NDArray[np.float64]

    @property
    def status(self) -> Literal["localized"]:
        """The word of the API."""
        return "localized"

    @property
    def cam_from_world(self) -> Pose:
        """The pose of the camera."""
        return self.pose.rig_from_world

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(6, 6) of ``cam_from_world``, as ``RigPose`` has it."""
        return self.pose.covariance

    @property
    def position_std(self) -> NDArray[np.float64]:
        """(3,) standard deviations of the camera centre along the world's axes."""
        return self.pose.position_std

    @property
    def orientation_std(self) -> NDArray[np.float64]:
        """(3,) standard deviations of w (rad), about the camera's x, y, z."""
        return self.pose.orientation_std

    @property
    def photo_covariance(self) -> NDArray[np.float64]:
        """(6, 6), the photo's part of ``covariance``: all of it but the errors of the map."""
        assert self.pose.photo_covariance is not None  # the photo measured it
        return self.pose.photo_covariance

    @property
    def uncertainty(self) -> Uncertainty:
        """What ``covariance`` covers."""
        return self.pose.uncertainty

    @property
    def probability(self) -> float | None:
        """That the pose is right, 0 to 1; None when nothing was compared around the pose."""
        return self.pose.probability


@dataclass(frozen=True, slots=True, eq=False)
class NotLocalized:
    """The map was searched and gave no pose that can be trusted.

    Attributes:
        candidates: the places of an ambiguous photo that have a pose; () otherwise.
        coarse: a pose told by retrieval alone, if the query asked for one.
    """

    evidence: Evidence
    stage: Stage
    reason: Reason
    message: str
    candidates: tuple[Candidate, ...] = ()
    coarse: CoarsePose | None = None

    @property
    def status(self) -> Literal["coarse", "not_localized"]:
        """The word of the API."""
        return "not_localized" if self.coarse is None else "coarse"


Answer = Localized | NotLocalized


@dataclass(frozen=True, slots=True, eq=False)
class ImageAnswer:
    """What one image of an instant contributed.

    Attributes:
        sensor: the camera's id in the rig.
        evidence: what was seen in it; inliers are those of the rig's pose. None when the image
            could not be used.
        error: why it could not be used, or None.
    """

    sensor: str
    cam_from_rig: Pose
    evidence: Evidence | None
    error: VislocError | None


@dataclass(frozen=True, slots=True, eq=False)
class InstantAnswer:
    """The answer to the images of a rig, or of one camera, at one instant.

    Attributes:
        timestamp: as it was sent; None when it was not.
        images: in the order of the request.
        pose: None when there is none.
        refusal: why the instant's own images gave no pose; None when they did. A filled pose has
            both.
        seconds: wall time by stage, of all images together.
        scores: (k,) float32, how much each keypoint of the images speaks for the pose
            (``visloc.localization.acceptance.rivals.score``); empty when that is not known. Never
            sent.
        coarse: of a photo on its own that asked for it, the pose that retrieval alone tells;
            answers state it only when ``pose`` is None.
    """

    timestamp: int | None
    images: tuple[ImageAnswer, ...]
    pose: RigPose | None
    refusal: Refusal | None
    seconds: Mapping[str, float]
    scores: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    coarse: CoarsePose | None = None

    @property
    def num_correspondences(self) -> int:
        """The number of 2D-3D correspondences of all images together."""
        return sum(i.evidence.num_correspondences for i in self.images if i.evidence is not None)

    @property
    def num_inliers(self) -> int:
        """The number of them that agree with the pose, or with the best one when it was refused."""
        return sum(i.evidence.num_inliers for i in self.images if i.evidence is not None)
