"""From what the images of an instant show to one pose that can be believed, or a refusal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.errors import VislocError, refuse
from visloc.geometry import Camera, Pose
from visloc.localization.constraints import Constraints, MapGeometry
from visloc.pose.centre import position_covariance, with_origin
from visloc.pose.distance import mahalanobis2
from visloc.pose.generalized import (
    GeneralizedPose,
    estimate_generalized_pose,
    refine_generalized_pose,
)
from visloc.pose.views import MatchedView
from visloc.priors import Priors
from visloc.sequences.filling import PoseSource
from visloc.timing import timed
from visloc.types import (
    DEFAULT_PRESET,
    CameraSource,
    Evidence,
    ImageAnswer,
    InstantAnswer,
    LocalizeOptions,
    ReadAs,
    Reason,
    Refusal,
    RegistrationPreset,
    RigPose,
    Solver,
)

# The default max_error_px holds for photos of this longer side and more; for smaller ones it
# shrinks with them. 12 px are so large a part of a photo of 256 px that poses by chance explain
# up to 10 % of the matches.
FULL_ERROR_FROM_PX = 640
# A prior decides between two poses when the photo leaves them open: when the one that it allows
# has at least this share of the inliers of the one that it forbids.
_AMBIGUOUS_SHARE = 0.7
# A pose with fewer inliers must be confirmed by two halves of the matches: their distance is
# chi-square with six degrees of freedom, above this once in a thousand times.
_SURE_INLIERS = 100
_MAX_HALVES_MAHALANOBIS2 = 22.46
# What becomes of a photo whose features were found on its side.
_REASONS_OF_TURNED_PHOTOS = (
    *(Reason.TOO_FEW_MATCHES, Reason.NO_POSE, Reason.TOO_FEW_INLIERS, Reason.LOW_INLIER_RATIO),
)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """2D-3D correspondences of one image, best first.

    Attributes:
        pixels: (n, 2) float64.
        points: (n, 3) float64, relative to the map's origin.
    """

    pixels: NDArray[np.float64]
    points: NDArray[np.float64]

    @staticmethod
    def none() -> Matches:
        """Return no correspondences."""
        return Matches(np.empty((0, 2)), np.empty((0, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What one image shows of the map, before any pose is looked for.

    Attributes:
        evidence: without inliers.
        matches: with landmarks.
        landmarks: (n,) int64 rows of the map's landmarks, those of ``matches``.
        elsewhere: with landmarks of photos that the priors exclude, though they look more like
            the query; mostly none.
        refusal: why there is nothing to solve; None when there may be.
    """

    evidence: Evidence
    matches: Matches
    landmarks: NDArray[np.int64]
    elsewhere: Matches
    refusal: Refusal | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SeenImage:
    """One image of an instant, looked at.

    Attributes:
        sensor: the camera's id in the rig.
        cam_from_rig: where it sits; the identity for a camera on its own.
        look: None when the image could not be used.
        error: why it could not.
    """

    sensor: str
    cam_from_rig: Pose
    look: Look | None
    error: VislocError | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """An instant's pose, or why there is none.

    Attributes:
        answer: for the caller.
        views: what each usable image contributed, relative to the map's origin; nothing where its
            camera was left out. A ``focal_unknown`` was found where there is a pose, and is still a
            guess where there is none.
        pose: the accepted pose, relative to the map's origin; None when there is none.
        inliers: of each view, (n,) whether the best pose explains the match, were the pose
            accepted or not; () when no pose was found.
    """

    answer: InstantAnswer
    views: tuple[MatchedView, ...]
    pose: GeneralizedPose | None
    inliers: tuple[NDArray[np.bool_], ...]

    def refused(self, refusal: Refusal) -> Solved:
        """Return the same without its pose."""
        return replace(self, answer=replace(self.answer, pose=None, refusal=refusal), pose=None)


def solve_instant(
    images: Sequence[SeenImage],
    geometry: MapGeometry,
    options: LocalizeOptions,
    priors: Priors,
    timestamp: int | None = None,
) -> Solved:
    """Find one pose from all images of an instant; a photo on its own is a rig of one camera.

    Where the camera of a photo on its own is a guess, its focal length is found with the pose. The
    answer has the guess when the pose is refused. Otherwise nothing rests on a guess, whose poses
    are metres off with centimetres of covariance: beside other images of a rig, one whose camera
    is a guess is left out; ``registration``, which takes cameras as they are, leaves it out, too.
    Where that leaves too few matches, the pose is refused: ``uncertain_pose``, "send the camera".

    Args:
        images: each of another camera of the rig.
        geometry: of the map.
        options: those that the images were looked at with.
        priors: what is known of the rig.
        timestamp: for the answer.

    Raises:
        InvalidInput: ``priors.*`` that mean nothing in this map; ``options.solver`` for several
            images with ``registration``.
    """
    check_solver(options, len(images))
    constraints = Constraints(geometry, priors)
    looks = [image.look for image in images if image.look is not None]
    views = _views_of(images, [look.matches for look in looks], options)
    seconds = _summed([look.evidence.seconds for look in looks])
    with timed(seconds, "pose"):
        found, refusal = _find_pose(images, views, options, constraints)
        if refusal is None or refusal.reason is not Reason.CONTRADICTS_PRIOR:
            elsewhere = _views_of(images, [look.elsewhere for look in looks], options)
            refusal = _better_elsewhere(elsewhere, found, options) or refusal
        refusal = refusal and _with_turned_photos(refusal, looks)
    pose = None
    if refusal is None and found is not None and found.covariance is not None:
        pose = rig_pose(found.rig_from_world, found.covariance, geometry, PoseSource.ESTIMATED)
    inliers = () if found is None else tuple(found.inliers)
    camera = None if refusal is not None or found is None else found.camera
    shown = with_inliers([_shown(image, camera) for image in images], inliers)
    answer = InstantAnswer(timestamp, shown, pose, refusal, seconds)
    views = tuple(replace(view, camera=camera or view.camera) for view in views)
    return Solved(answer, views, found if refusal is None else None, inliers)


def check_solver(options: LocalizeOptions, num_cameras: int) -> None:
    """Refuse a solver that does not take so many images at once.

    Raises:
        InvalidInput: ``options.solver``.
    """
    if options.solver is Solver.REGISTRATION and num_cameras > 1:
        raise refuse(
            "options.solver",
            field="options.solver",
            expected=f"{Solver.PYCOLMAP} or {Solver.POSELIB} for a rig",
            got=options.solver,
        )


def _views_of(
    images: Sequence[SeenImage], matches: Sequence[Matches], options: LocalizeOptions
) -> tuple[MatchedView, ...]:
    """The views of the images that could be used, with their ``matches`` in order.

    One whose camera is a guess is empty unless its focal length will be found.
    """
    usable = [(image.cam_from_rig, image.look) for image in images if image.look is not None]
    finds_focal = len(usable) == 1 and options.solver is not Solver.REGISTRATION
    views = []
    for (cam_from_rig, look), of_image in zip(usable, matches, strict=True):
        guessed = look.evidence.camera_source is CameraSource.GUESS
        counted = of_image if finds_focal or not guessed else Matches.none()
        views.append(
            MatchedView(
                look.evidence.camera,
                cam_from_rig,
                counted.pixels,
                counted.points,
                focal_unknown=guessed and finds_focal,
            )
        )
    return tuple(views)


def _shown(image: SeenImage, found: Camera | None) -> ImageAnswer:
    """What an image shows, with the camera that was ``found`` together with the pose."""
    evidence = None if image.look is None else image.look.evidence
    if evidence is not None and found is not None:
        evidence = replace(evidence, camera=found, camera_source=CameraSource.ESTIMATED)
    return ImageAnswer(image.sensor, image.cam_from_rig, evidence, image.error)


def with_inliers(
    images: Sequence[ImageAnswer], inliers: Sequence[NDArray[np.bool_]]
) -> tuple[ImageAnswer, ...]:
    """Say what each image contributed to a pose with these ``inliers``, one mask per usable image.

    No masks mean no inliers.
    """
    masks = iter(inliers)
    counted = []
    for image in images:
        evidence = image.evidence
        if evidence is not None:
            num_inliers = int(next(masks).sum()) if inliers else 0
            evidence = replace(evidence, num_inliers=num_inliers)
        counted.append(replace(image, evidence=evidence))
    return tuple(counted)


def rig_pose(
    rig_from_local: Pose,
    covariance: NDArray[np.float64],
    geometry: MapGeometry,
    source: PoseSource,
) -> RigPose:
    """Move a pose and its covariance (6, 6) from the map's own coordinates to the world."""
    position_variance = np.diag(position_covariance(rig_from_local, covariance))
    rig_from_world, covariance = with_origin(rig_from_local, covariance, geometry.origin)
    return RigPose(
        rig_from_world,
        covariance,
        position_std=np.sqrt(position_variance),
        orientation_std=np.sqrt(np.diag(covariance)[:3]),
        source=source,
    )


def registration_for(options: LocalizeOptions, cameras: Sequence[Camera]) -> RegistrationPreset:
    """The thresholds for photos: the default's inlier distance shrinks with the smallest."""
    registration = options.registration
    if options.preset != DEFAULT_PRESET or options.max_error_px is not None:
        return registration
    smallest = min(max(camera.width, camera.height) for camera in cameras)
    share = min(1.0, smallest / FULL_ERROR_FROM_PX)
    return replace(registration, max_error_px=registration.max_error_px * share)


def _find_pose(
    images: Sequence[SeenImage],
    views: Sequence[MatchedView],
    options: LocalizeOptions,
    constraints: Constraints,
) -> tuple[GeneralizedPose | None, Refusal | None]:
    """Return the best pose, if any, and why it is not believed, if it is not."""
    looks = [image.look for image in images if image.look is not None]
    if not looks:
        why = "none of the images could be used" if images else "there is no image"
        return None, Refusal("features", Reason.NO_USABLE_IMAGE, why)
    refusals = [look.refusal for look in looks if look.refusal is not None]
    if len(refusals) == len(looks):
        return None, refusals[0]
    registration = registration_for(options, [view.camera for view in views])
    num_pairs = sum(len(view) for view in views)
    num_matches = sum(len(look.matches.pixels) for look in looks)
    if num_matches < registration.min_inliers:
        return None, Refusal(
            "matching",
            Reason.TOO_FEW_MATCHES,
            f"only {num_matches} keypoints match the map, {registration.min_inliers} are needed",
        )
    if num_pairs < registration.min_inliers:
        return None, Refusal(
            "gate",
            Reason.UNCERTAIN_POSE,
            f"{num_matches - num_pairs} of {num_matches} matches do not count: the focal length "
            "of their photo is a guess, and found only for a photo on its own, by a solver other "
            f"than {Solver.REGISTRATION}: send the camera",
        )
    found = _estimate(views, registration, options, constraints)
    if found is None:
        return None, Refusal("pose", Reason.NO_POSE, "no camera pose explains the matches")
    refusal = _gate(found, num_pairs, registration, constraints)
    if refusal is not None and refusal.reason is Reason.CONTRADICTS_PRIOR:
        other = _near_pose_prior(views, found, registration, options, constraints)
        if other is not None and _gate(other, num_pairs, registration, constraints) is None:
            found, refusal = other, None
    if refusal is None and constraints.gravity is not None:
        refusal = _better_without_gravity(views, found, registration, options)
    if refusal is None:
        refusal = _halves_disagree(views, found, registration, options, constraints)
    return found, refusal


def _estimate(
    views: Sequence[MatchedView],
    registration: RegistrationPreset,
    options: LocalizeOptions,
    constraints: Constraints,
) -> GeneralizedPose | None:
    return estimate_generalized_pose(
        views,
        max_error_px=registration.max_error_px,
        seed=options.seed,
        gravity=constraints.gravity,
        solver=options.solver,
    )


def _gate(
    found: GeneralizedPose,
    num_pairs: int,
    registration: RegistrationPreset,
    constraints: Constraints,
) -> Refusal | None:
    """Why a pose is not believed, or None (docs/decisions/0002-refuse-instead-of-guess.md)."""
    doubt = "is this photo of the mapped place?"
    if constraints.narrow:
        doubt = "only what the priors allow was searched: are they right?"
    if found.num_inliers < registration.min_inliers:
        return Refusal(
            "gate",
            Reason.TOO_FEW_INLIERS,
            f"the best pose explains {found.num_inliers} matches, "
            f"{registration.min_inliers} are needed; {doubt}",
        )
    if found.num_inliers / num_pairs < registration.min_inlier_ratio:
        return Refusal(
            "gate",
            Reason.LOW_INLIER_RATIO,
            f"the best pose explains {found.num_inliers / num_pairs:.1%} of the matches, "
            f"{registration.min_inlier_ratio:.1%} are needed; {doubt}",
        )
    if found.covariance is None:
        return Refusal(
            "gate",
            Reason.UNCERTAIN_POSE,
            "the matched landmarks leave the pose undetermined: they lie in a line or a spot"
            if found.camera is None
            else "the matched landmarks, in a plane or a spot, leave focal length and distance "
            "undetermined: send the camera",
        )
    contradiction = constraints.contradiction(found.rig_from_world, found.covariance)
    if contradiction is not None:
        return Refusal(
            "gate",
            Reason.CONTRADICTS_PRIOR,
            f"the best pose contradicts what is known: {contradiction}",
        )
    return None


def _halves_disagree(
    views: Sequence[MatchedView],
    found: GeneralizedPose,
    registration: RegistrationPreset,
    options: LocalizeOptions,
    constraints: Constraints,
) -> Refusal | None:
    """Refuse a pose of few inliers when two halves of the matches give poses that differ.

    Matches of a blurred photo agree within 12 pixels by the dozen and with a pose metres off, whose
    covariance cannot know (docs/decisions/0012-halves-must-agree.md). With a focal length to find,
    two halves agree too easily: such a pose is not believed.
    """
    if (
        found.num_inliers >= _SURE_INLIERS
        or options.preset != DEFAULT_PRESET
        or options.min_inliers is not None
    ):
        return None
    if found.camera is not None:
        return Refusal(
            "gate",
            Reason.UNCERTAIN_POSE,
            f"the best pose, with a focal length found together with it, explains only "
            f"{found.num_inliers} matches, {_SURE_INLIERS} are needed: send the camera",
        )
    # Of two places that explain the photo, a pose prior may have decided for one.
    views = constraints.near_pose_prior(views, registration.max_error_px) or views
    random = np.random.default_rng(options.seed)
    first = [random.permutation(len(view)) < len(view) // 2 for view in views]
    halves = []
    for masks in (first, [~mask for mask in first]):
        half = [view.selected(mask) for view, mask in zip(views, masks, strict=True)]
        pose = _estimate(half, registration, options, constraints)
        if pose is not None and pose.covariance is not None:
            halves.append((pose.rig_from_world, pose.covariance))
    if len(halves) == 2 and mahalanobis2(*halves[0], *halves[1]) <= _MAX_HALVES_MAHALANOBIS2:
        return None
    return Refusal(
        "gate",
        Reason.UNCERTAIN_POSE,
        f"the best pose explains only {found.num_inliers} matches, and two halves of the matches "
        "give poses that contradict each other: the photo is blurred, or of another place",
    )


def _with_turned_photos(refusal: Refusal, looks: Sequence[Look]) -> Refusal:
    """Add to the message that photos were read on their side, where that may be the cause."""
    orientations = sorted(
        {
            look.evidence.exif_orientation
            for look in looks
            if look.evidence.read_as is ReadAs.STORED and look.evidence.exif_orientation != 1
        }
    )
    if not orientations or refusal.reason not in _REASONS_OF_TURNED_PHOTOS:
        return refusal
    exif = ", ".join(map(str, orientations))
    hint = f"stored turned, EXIF orientation {exif}, and was read as stored: try read_as=upright"
    return replace(refusal, message=f"{refusal.message} (the photo is {hint})")


def _near_pose_prior(
    views: Sequence[MatchedView],
    forbidden: GeneralizedPose,
    registration: RegistrationPreset,
    options: LocalizeOptions,
    constraints: Constraints,
) -> GeneralizedPose | None:
    """Where the images leave the place open, return the pose that the pose prior decides for."""
    near = constraints.near_pose_prior(views, registration.max_error_px)
    if near is None:
        return None
    start = _estimate(near, registration, options, constraints)
    if start is None:
        return None
    if start.camera is not None:
        views = [replace(view, camera=start.camera) for view in views]
    found = refine_generalized_pose(
        views, start.rig_from_world, max_error_px=registration.max_error_px
    )
    if found is None or found.num_inliers < _AMBIGUOUS_SHARE * forbidden.num_inliers:
        return None
    return found


def _better_without_gravity(
    views: Sequence[MatchedView],
    found: GeneralizedPose,
    registration: RegistrationPreset,
    options: LocalizeOptions,
) -> Refusal | None:
    """Refuse a pose that was only looked for upright when another explains the images better."""
    if found.camera is not None:  # gravity took no part
        return None
    num_others = sum(len(view) for view in views) - found.num_inliers
    if found.num_inliers >= _AMBIGUOUS_SHARE * num_others:  # it cannot
        return None
    other = estimate_generalized_pose(
        views, max_error_px=registration.max_error_px, seed=options.seed, solver=options.solver
    )
    if other is None or found.num_inliers >= _AMBIGUOUS_SHARE * other.num_inliers:
        return None
    return Refusal(
        "gate",
        Reason.CONTRADICTS_PRIOR,
        f"a pose that the prior gravity excludes explains {other.num_inliers} matches, the one "
        f"that it allows {found.num_inliers}: the gravity is wrong, or the place looks alike twice",
    )


def _better_elsewhere(
    elsewhere: Sequence[MatchedView],
    found: GeneralizedPose | None,
    options: LocalizeOptions,
) -> Refusal | None:
    """Refuse what priors allow when a pose that they forbid explains the images better."""
    num_pairs = sum(len(view) for view in elsewhere)
    if num_pairs < options.registration.min_inliers:
        return None
    registration = registration_for(options, [view.camera for view in elsewhere])
    other = estimate_generalized_pose(
        elsewhere,
        max_error_px=registration.max_error_px,
        seed=options.seed,
        solver=options.solver,
    )
    num_inliers = 0 if found is None else found.num_inliers
    if (
        other is None
        or other.num_inliers < registration.min_inliers
        or other.num_inliers < registration.min_inlier_ratio * num_pairs
        or num_inliers >= _AMBIGUOUS_SHARE * other.num_inliers
    ):
        return None
    return Refusal(
        "gate",
        Reason.CONTRADICTS_PRIOR,
        f"a place that the priors exclude explains {other.num_inliers} matches, the one that "
        f"they allow {num_inliers}: the priors are wrong, or both places look alike",
    )


def _summed(parts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Seconds by stage of several images together."""
    total: dict[str, float] = {}
    for part in parts:
        for stage, seconds in part.items():
            total[stage] = total.get(stage, 0.0) + seconds
    return total
