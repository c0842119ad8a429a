"""Gates: acceptance tests that a solved pose must pass before it is an answer.

A gate takes the problem and its best pose and returns a refusal, or None to accept. ``GATES`` look
at the pose; ``CONFIRMATIONS`` solve again, so they come last. The reasons behind them:
docs/decisions/0002-refuse-instead-of-guess.md, 0012-halves-must-agree.md and
0027-a-camera-that-is-checked.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose
from visloc.localization.acceptance.camera_check import camera_contradiction
from visloc.localization.acceptance.evidence import SeenView, Shown, evidence_of
from visloc.localization.acceptance.probability import against, shipped_model
from visloc.localization.map_view.constraints import Constraints, PosePriors
from visloc.options import (
    DEFAULT_PRESET,
    LEAST_PROBABILITY,
    PRESETS,
    LocalizeOptions,
    RegistrationPreset,
)
from visloc.pose.covariance import mahalanobis2
from visloc.pose.generalized import (
    GeneralizedPose,
    estimate_generalized_pose,
    refine_generalized_pose,
)
from visloc.pose.reprojection import MatchedView
from visloc.types import CameraSource, Reason, Refusal

# The default max_error_px applies to photos whose longer side has at least this many pixels, and
# shrinks with smaller ones. In a photo of 256 px, 12 px let wrong poses explain up to 10 % of the
# matches by chance.
FULL_ERROR_FROM_PX = 640
# When a photo fits two poses, a prior decides between them. It fits both when the pose that the
# prior allows has at least this share of the other's inliers.
_AMBIGUOUS_SHARE = 0.7
# A pose with fewer inliers must be confirmed by two halves of the matches. Their distance is
# chi-square with six degrees of freedom: above the limit once in a thousand times.
_SURE_INLIERS = 100
_MAX_HALVES_MAHALANOBIS2 = 22.46


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """The search for one pose: views, options and constraints.

    Attributes:
        views: of the images, relative to the map's origin.
        sources: where the camera of each view came from.
        shown: all that each image shows; () or None where a pose shall not be compared with it.
        reduced: how many pixels of each image, as it was sent, a side of a view's pixel spans.
    """

    views: tuple[MatchedView, ...]
    sources: tuple[CameraSource, ...]
    options: LocalizeOptions
    constraints: Constraints
    shown: tuple[Shown | None, ...] = ()
    reduced: tuple[float, ...] = ()

    @property
    def registration(self) -> RegistrationPreset:
        return registration_for(self.options, [view.camera for view in self.views])

    @property
    def num_matches(self) -> int:
        return sum(len(view) for view in self.views)

    def of(self, views: Sequence[MatchedView]) -> Problem:
        """Return the same search with other views."""
        return replace(self, views=tuple(views))

    def near_prior(self) -> Sequence[MatchedView]:
        """Return the views with what a pose prior allows; all without one.

        A pose prior may have decided between two places that explain the images.
        """
        threshold = self.registration.max_error_px
        return self.constraints.near_pose_prior(self.views, threshold) or self.views

    def solve(
        self, *, with_gravity: bool = True, seed: int | None = None
    ) -> GeneralizedPose | None:
        """Search; with the seed of the options, unless another one is given."""
        return estimate_generalized_pose(
            self.views,
            max_error_px=self.registration.max_error_px,
            seed=self.options.seed if seed is None else seed,
            gravity=self.constraints.gravity if with_gravity else None,
            solver=self.options.solver,
        )


def asks_for_weak_poses(options: LocalizeOptions) -> bool:
    """Whether a caller names a preset of the paper, or fewer inliers than the default."""
    by_default = PRESETS[DEFAULT_PRESET].min_inliers
    return options.preset != DEFAULT_PRESET or options.registration.min_inliers < by_default


Gate = Callable[[Problem, GeneralizedPose], Refusal | None]


def registration_for(options: LocalizeOptions, cameras: Sequence[Camera]) -> RegistrationPreset:
    """Return the thresholds for photos of these cameras.

    The default inlier threshold shrinks with the smallest photo.
    """
    registration = options.registration
    if options.preset != DEFAULT_PRESET or options.max_error_px is not None:
        return registration
    smallest = min(max(camera.width, camera.height) for camera in cameras)
    share = min(1.0, smallest / FULL_ERROR_FROM_PX)
    return replace(registration, max_error_px=registration.max_error_px * share)


def accepted(problem: Problem, best: GeneralizedPose) -> tuple[GeneralizedPose, Refusal | None]:
    """Judge the best pose of a problem.

    If the images fit two places, a pose prior decides: the returned pose may not be ``best``.

    Returns:
        The judged pose, and the reason to refuse it or None.
    """
    refusal = first_refusal(GATES, problem, best)
    if refusal is not None and refusal.reason is Reason.CONTRADICTS_PRIOR:
        other = _near_pose_prior(problem, best)
        if other is not None and first_refusal(GATES, problem, other) is None:
            best, refusal = other, None
    refusal = refusal or first_refusal(CONFIRMATIONS, problem, best)
    # Last: a wrong camera makes a pose unlikely too, and its own refusal says what to mend.
    return (best, refusal) if refusal is not None else likely(problem, best)


def first_refusal(gates: Sequence[Gate], problem: Problem, pose: GeneralizedPose) -> Refusal | None:
    """Return the refusal of the first gate that the pose does not pass."""
    return next((refusal for gate in gates if (refusal := gate(problem, pose))), None)


def enough_inliers(problem: Problem, pose: GeneralizedPose) -> Refusal | None:
    """Refuse a pose with fewer than ``min_inliers`` inliers."""
    needed = problem.registration.min_inliers
    if pose.num_inliers >= needed:
        return None
    return _refused(
        Reason.TOO_FEW_INLIERS,
        f"the best pose explains {pose.num_inliers} matches, but {needed} are "
        f"needed; {_doubt(problem)}",
    )


def enough_of_the_matches(problem: Problem, pose: GeneralizedPose) -> Refusal | None:
    """Refuse a pose whose inliers are a smaller share of the matches than ``min_inlier_ratio``."""
    ratio, needed = pose.num_inliers / problem.num_matches, problem.registration.min_inlier_ratio
    if ratio >= needed:
        return None
    return _refused(
        Reason.LOW_INLIER_RATIO,
        f"the best pose explains {ratio:.1%} of the matches, but {needed:.1%} are "
        f"needed; {_doubt(problem)}",
    )


def determined(_: Problem, pose: GeneralizedPose) -> Refusal | None:
    """Refuse a pose that its inliers leave undetermined."""
    if pose.covariance is not None:
        return None
    if pose.camera is None:
        why = "the matched landmarks lie on one line or in one spot: they do not fix the pose"
    else:
        why = (
            "the matched landmarks lie in one plane or spot: they do not fix "
            "focal length and distance: send the camera"
        )
    return _refused(Reason.UNCERTAIN_POSE, why)


def within_the_priors(problem: Problem, pose: GeneralizedPose) -> Refusal | None:
    """Refuse a pose that contradicts a prior."""
    assert pose.covariance is not None  # ``determined`` comes first
    constraints, where = problem.constraints, pose.rig_from_world
    whole = constraints.errors.whole(where, pose.covariance, pose.of_camera)
    return contradicts_priors(constraints, where, whole)


def not_better_without_gravity(problem: Problem, pose: GeneralizedPose) -> Refusal | None:
    """Refuse an upright pose when one that is not upright explains the images better."""
    if problem.constraints.gravity is None or pose.camera is not None:  # gravity was not used
        return None
    num_others = problem.num_matches - pose.num_inliers
    if pose.num_inliers >= _AMBIGUOUS_SHARE * num_others:  # no other pose can have enough
        return None
    other = problem.solve(with_gravity=False)
    if other is None or pose.num_inliers >= _AMBIGUOUS_SHARE * other.num_inliers:
        return None
    return _refused(
        Reason.CONTRADICTS_PRIOR,
        f"a pose that the prior gravity excludes explains {other.num_inliers} "
        f"matches, but the best allowed pose only {pose.num_inliers}: the gravity "
        "is wrong, or two places look alike",
    )


def halves_agree(problem: Problem, pose: GeneralizedPose) -> Refusal | None:
    """Refuse a pose of few inliers when two halves of the matches give different poses.

    Dozens of matches of a blurred photo can agree within 12 pixels on a pose that is metres off.
    The covariance does not show it. If the focal length was estimated too, halves agree too easily:
    such a pose needs more inliers instead.
    """
    options = problem.options
    if pose.num_inliers >= _SURE_INLIERS or asks_for_weak_poses(options):
        return None
    if pose.camera is not None:
        return _refused(
            Reason.UNCERTAIN_POSE,
            "the focal length was estimated with the pose; such a pose needs "
            f"{_SURE_INLIERS} inliers, but has {pose.num_inliers}: send the camera",
        )
    views = problem.near_prior()
    random = np.random.default_rng(options.seed)
    first = [random.permutation(len(view)) < len(view) // 2 for view in views]
    halves = []
    for masks in (first, [~mask for mask in first]):
        half = [view.selected(mask) for view, mask in zip(views, masks, strict=True)]
        found = problem.of(half).solve()
        if found is not None and found.covariance is not None:
            halves.append((found.rig_from_world, found.covariance))
    if len(halves) == 2 and mahalanobis2(*halves[0], *halves[1]) <= _MAX_HALVES_MAHALANOBIS2:
        return None
    return _refused(
        Reason.UNCERTAIN_POSE,
        f"the best pose explains only {pose.num_inliers} matches, and two halves of "
        "the matches give contradictory poses: the photo is blurred, or shows "
        "another place",
    )


def cameras_agree(problem: Problem, pose: GeneralizedPose) -> Refusal | None:
    """Refuse a pose when the matches of a camera speak for other intrinsics.

    Each camera is looked at on its own, so that wrong ``cam_from_rig`` accuse no camera.
    """
    max_error_px = problem.registration.max_error_px
    sizes = problem.reduced or (1.0,) * len(problem.views)
    for view, source, reduced in zip(problem.views, problem.sources, sizes, strict=True):
        if pose.camera is not None:
            view, source = replace(view, camera=pose.camera), CameraSource.ESTIMATED
        contradiction = camera_contradiction(
            view, source, pose.rig_from_world, max_error_px, reduced=reduced
        )
        if contradiction is not None:
            return _refused(Reason.CAMERA_CONTRADICTED, contradiction)
    return None


def likely(problem: Problem, pose: GeneralizedPose) -> tuple[GeneralizedPose, Refusal | None]:
    """Add the probability that a pose is right, and refuse one that is probably wrong.

    A raised ``min_probability`` counts once rivals were compared
    (``visloc.localization.acceptance.judge.not_probable_enough``). A pose has no probability when
    no image may be compared with the map.
    """
    seen = [
        (view if pose.camera is None else replace(view, camera=pose.camera), shown, inliers)
        for view, shown, inliers in zip(problem.views, problem.shown, pose.inliers, strict=False)
        if shown is not None
    ]
    if not seen or pose.covariance is None:
        return pose, None
    features = evidence_of(
        problem.constraints.geometry,
        [SeenView(*each) for each in seen],
        pose.rig_from_world,
        pose.covariance,
        problem.registration.max_error_px,
    )
    probability = float(shipped_model().probability(features))
    pose = replace(pose, probability=probability)
    if probability >= min(problem.options.least_probability, LEAST_PROBABILITY):
        return pose, None
    return pose, _refused(
        Reason.UNLIKELY_POSE,
        f"the best pose explains {pose.num_inliers} matches, but is right with a probability of "
        f"{probability:.2f} only: {against(features)}. Is this a print, a screen or a mirror, or "
        "another place that looks alike?",
    )


GATES: tuple[Gate, ...] = (enough_inliers, enough_of_the_matches, determined, within_the_priors)
CONFIRMATIONS: tuple[Gate, ...] = (not_better_without_gravity, cameras_agree, halves_agree)


def not_better_elsewhere(elsewhere: Problem, pose: GeneralizedPose | None) -> Refusal | None:
    """Refuse the best allowed pose when a pose that the priors exclude explains the images better.

    Args:
        pose: the best pose that the priors allow; None when there is none.
    """
    if elsewhere.num_matches < elsewhere.options.registration.min_inliers:
        return None
    registration = elsewhere.registration
    other = elsewhere.solve(with_gravity=False)
    num_inliers = 0 if pose is None else pose.num_inliers
    if (
        other is None
        or other.num_inliers < registration.min_inliers
        or other.num_inliers < registration.min_inlier_ratio * elsewhere.num_matches
        or num_inliers >= _AMBIGUOUS_SHARE * other.num_inliers
    ):
        return None
    return _refused(
        Reason.CONTRADICTS_PRIOR,
        f"a place that the priors exclude explains {other.num_inliers} matches, but "
        f"the allowed area only {num_inliers}: the priors are wrong, or both places "
        "look alike",
    )


def contradicts_priors(
    constraints: PosePriors, rig_from_world: Pose, covariance: NDArray[np.float64]
) -> Refusal | None:
    """Refuse a pose that contradicts the priors, both from the map's origin.

    Args:
        covariance: (6, 6), the errors of the map included.
    """
    contradiction = constraints.contradiction(rig_from_world, covariance)
    if contradiction is None:
        return None
    return _refused(Reason.CONTRADICTS_PRIOR, f"the best pose contradicts a prior: {contradiction}")


def _near_pose_prior(problem: Problem, forbidden: GeneralizedPose) -> GeneralizedPose | None:
    """Return the best pose near the pose prior, if the images fit it about as well."""
    max_error_px = problem.registration.max_error_px
    near = problem.constraints.near_pose_prior(problem.views, max_error_px)
    start = None if near is None else problem.of(near).solve()
    if start is None:
        return None
    views = problem.views
    if start.camera is not None:
        views = tuple(replace(view, camera=start.camera) for view in views)
    found = refine_generalized_pose(views, start.rig_from_world, max_error_px=max_error_px)
    if found is None or found.num_inliers < _AMBIGUOUS_SHARE * forbidden.num_inliers:
        return None
    return found


def _doubt(problem: Problem) -> str:
    if problem.constraints.narrow:
        return "only the area that the priors allow was searched: are the priors right?"
    return "is this photo of the mapped place?"


def _refused(reason: Reason, message: str) -> Refusal:
    return Refusal("gate", reason, message)
