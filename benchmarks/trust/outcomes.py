"""Questions, and what came of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.errors import VislocError
from visloc.evaluation import Threshold, pose_error
from visloc.geometry import Camera, Pose
from visloc.photos.reading import Photo
from visloc.pose.motion import position_covariance
from visloc.types import Answer, Evidence, InstantAnswer, Localized, RigPose


@dataclass(frozen=True, slots=True, eq=False)
class RigPhoto:
    """A photo, and the camera of a rig that took it."""

    sensor: str
    cam_from_rig: Pose
    photo: Photo
    camera: Camera | None


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """One question.

    Attributes:
        scenario: what is tried.
        map_id: the map that is asked.
        name: the photo's name.
        photos: one, or those of a rig.
        truth: the pose in the map's frame; None when it is not known.
        within: how near to the truth a right answer is; None when every pose is wrong.
    """

    scenario: str
    map_id: str
    name: str
    photos: tuple[RigPhoto, ...]
    truth: Pose | None
    within: Threshold | None


@dataclass(frozen=True, slots=True)
class Outcome:
    """The answer to one question, held against the truth; written as one line of JSON.

    Attributes:
        scenario: what was tried.
        map_id: the map that was asked.
        photo: its name.
        accepted: whether there was a pose.
        reason: of the refusal, or the code of the error.
        inliers: of the best pose.
        correspondences: that were given to the solver.
        right: whether the pose is right; None without a pose, or when nobody knows.
        error: (x, y, z) of the position in the map's unit; None without a pose or the truth.
        error_deg: error of the orientation, degrees.
        covariance: (3, 3) that was stated for the position.
        probability: that was stated for the pose; None when none was.
        camera: where the intrinsics came from, and the parameters that were used.
        tile: of a set, the map that answered.
    """

    scenario: str
    map_id: str
    photo: str
    accepted: bool = False
    reason: str | None = None
    inliers: int = 0
    correspondences: int = 0
    right: bool | None = None
    error: tuple[float, ...] | None = None
    error_deg: float | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    probability: float | None = None
    camera: str | None = None
    tile: str | None = None

    @property
    def inlier_ratio(self) -> float:
        """Share of inliers among the correspondences, 0 when there are none."""
        return self.inliers / self.correspondences if self.correspondences else 0.0

    @property
    def distance(self) -> float:
        """Norm of the error of the position; NaN when it is not known."""
        return math.nan if self.error is None else float(np.linalg.norm(self.error))


def refused_by_error(query: Query, error: VislocError) -> Outcome:
    """Return the outcome of a query that was an error, such as a camera of another size."""
    return Outcome(query.scenario, query.map_id, query.name, reason=error.code)


def outcome_of(query: Query, answer: Answer | InstantAnswer, tile: str | None = None) -> Outcome:
    """Hold an answer against the truth."""
    if isinstance(answer, InstantAnswer):
        looked = [image.evidence for image in answer.images if image.evidence is not None]
        pose: RigPose | Localized | None = answer.pose
        reason = None if answer.refusal is None else answer.refusal.reason
    else:
        looked = [answer.evidence]
        pose = answer if isinstance(answer, Localized) else None
        reason = None if isinstance(answer, Localized) else answer.reason
    outcome = Outcome(
        query.scenario,
        query.map_id,
        query.name,
        accepted=pose is not None,
        reason=reason,
        inliers=sum(each.num_inliers for each in looked),
        correspondences=sum(each.num_correspondences for each in looked),
        camera=_camera(looked),
        tile=tile,
    )
    if pose is None:
        return outcome
    cam_from_world = pose.rig_from_world if isinstance(pose, RigPose) else pose.cam_from_world
    covariance = position_covariance(cam_from_world, pose.covariance)
    return replace(
        _held_against(query, outcome, cam_from_world),
        covariance=tuple(tuple(map(float, row)) for row in covariance),
        probability=stated_probability(pose),
    )


def stated_probability(pose: RigPose | Localized) -> float | None:
    """Return how probable the answer says its pose is; None when it does not say."""
    found = getattr(pose, "probability", None)
    return None if found is None else float(found)


def _held_against(query: Query, outcome: Outcome, pose: Pose) -> Outcome:
    if query.truth is None:
        return replace(outcome, right=False if query.within is None else None)
    distance, angle = pose_error(pose, query.truth)
    error: NDArray[np.float64] = pose.center - query.truth.center
    right = query.within is not None and (
        distance <= query.within.max_position_error_m
        and angle <= query.within.max_orientation_error_deg
    )
    return replace(outcome, right=right, error=tuple(map(float, error)), error_deg=angle)


def _camera(looked: list[Evidence]) -> str | None:
    if len(looked) != 1:
        return None
    used = looked[0]
    return f"{used.camera_source} {' '.join(f'{value:.6g}' for value in used.camera.params)}"
