"""Solve an instant: from the matches of its images to one accepted pose, or a refusal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.errors import VislocError, refuse
from visloc.geometry import Camera, Pose
from visloc.localization.acceptance.camera_check import only_focal_length_contradicts
from visloc.localization.acceptance.corrections import (
    NO_CAMERAS,
    CamerasSoFar,
    with_corrected_cameras,
    with_redraws,
)
from visloc.localization.acceptance.evidence import Shown
from visloc.localization.acceptance.gates import Problem, accepted, not_better_elsewhere
from visloc.localization.acceptance.judge import not_probable_enough
from visloc.localization.acceptance.rivals import Proposed, stronger_place
from visloc.localization.map_view.constraints import Constraints, MapGeometry
from visloc.localization.query.camera import guessed_camera
from visloc.localization.turning import REASONS_OF_TURNED_PHOTOS
from visloc.options import LocalizeOptions, ReadAs, Solver
from visloc.pose.generalized import GeneralizedPose
from visloc.pose.motion import MapErrors, position_covariance, with_origin
from visloc.pose.reprojection import MatchedView
from visloc.priors import Priors
from visloc.runtime.threads import summed, timed
from visloc.types import (
    CameraSource,
    CoarsePose,
    Evidence,
    ImageAnswer,
    InstantAnswer,
    PoseSource,
    Reason,
    Refusal,
    RigPose,
    Uncertainty,
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
    """What one image shows of the map, before a pose is solved.

    Pixels are those of the image reduced by ``reduced``. In these, thresholds mean the same as in
    mapping photos (``visloc.features.resolution``).

    Attributes:
        evidence: without inliers; its camera is that of the stored pixels.
        landmarks: (n,) int64 rows of the map's landmarks, those of ``matches``.
        elsewhere: matches with landmarks of photos that look more like the query, but that the
            priors exclude; usually none.
        refusal: why there is nothing to solve; None otherwise.
        shown: all that was found in the image; None when a pose shall not be compared with it.
        proposed: all pairs that the searched photos proposed; None when they were not kept.
        reduced: how many stored pixels each side of a pixel spans.
        coarse: the pose that retrieval alone tells, if the query asked for one.
    """

    evidence: Evidence
    matches: Matches
    landmarks: NDArray[np.int64]
    elsewhere: Matches
    refusal: Refusal | None = None
    shown: Shown | None = None
    proposed: Proposed | None = None
    reduced: float = 1.0
    coarse: CoarsePose | None = None

    @staticmethod
    def nothing(evidence: Evidence, refusal: Refusal) -> Look:
        """Return the look of an image without enough to solve."""
        return Look(evidence, Matches.none(), np.empty(0, np.int64), Matches.none(), refusal)

    @property
    def camera(self) -> Camera:
        """The intrinsics for the pixels of ``matches``."""
        camera = self.evidence.camera
        return camera if self.reduced == 1.0 else camera.reduced(self.reduced)


@dataclass(frozen=True, slots=True, eq=False)
class SeenImage:
    """One image of an instant, looked at.

    Attributes:
        sensor: the camera's id in the rig.
        cam_from_rig: its pose in the rig; the identity for a camera on its own.
        look: None when the image could not be used.
        error: why it could not.
    """

    sensor: str
    cam_from_rig: Pose
    look: Look | None
    error: VislocError | None = None

    @staticmethod
    def alone(look: Look) -> SeenImage:
        """Return a photo that is no part of a rig."""
        return SeenImage("camera", Pose.identity(), look)


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """An instant's pose, or why there is none.

    Attributes:
        answer: for the caller.
        views: of the usable images, relative to the map's origin; empty for a camera that was left
            out. The focal length of a ``focal_unknown`` view is estimated if there is a pose, else
            a guess.
        pose: the accepted pose, relative to the map's origin; None when there is none.
        inliers: of each view, (n,) whether the best pose explains the match, even if it was
            refused; () when no pose was found.
        cameras: what this instant and those before say of their cameras.
        errors: of the map, which ``pose`` does not have yet.
    """

    answer: InstantAnswer
    views: tuple[MatchedView, ...]
    pose: GeneralizedPose | None
    inliers: tuple[NDArray[np.bool_], ...]
    cameras: CamerasSoFar
    errors: MapErrors

    def refused(self, refusal: Refusal) -> Solved:
        """Return the same without its pose."""
        return replace(self, answer=replace(self.answer, pose=None, refusal=refusal), pose=None)


def solve_instant(
    images: Sequence[SeenImage],
    geometry: MapGeometry,
    options: LocalizeOptions,
    priors: Priors,
    timestamp: int | None = None,
    cameras: CamerasSoFar = NO_CAMERAS,
) -> Solved:
    """Find one pose from all images of an instant; a photo on its own is a rig of one camera.

    A guessed camera gives poses that are metres off with centimetres of covariance. So a single
    photo's focal length is estimated with the pose; if the pose is refused, the answer has the
    guess. In a rig, and with the solver ``registration``, an image with a guessed camera is left
    out. If too few matches remain, the pose is refused: ``uncertain_pose``, "send the camera".

    Args:
        options: those that the images were matched with.
        priors: what is known of the rig.
        cameras: what earlier instants of a sequence said of their cameras.
    """
    check_solver(options, len(images))
    constraints = Constraints(geometry, priors)
    looks = [image.look for image in images if image.look is not None]
    views = _views_of(images, [look.matches for look in looks], options)
    seconds = summed(*(look.evidence.seconds for look in looks))
    scores = np.empty(0, np.float32)
    with timed(seconds, "pose"):
        problem, found, refusal = _find_pose(
            images,
            Problem(
                views,
                _sources_of(images),
                options,
                constraints,
                _shown_in(images, options),
                tuple(look.reduced for look in looks),
            ),
        )
        if refusal is None or refusal.reason is not Reason.CONTRADICTS_PRIOR:
            elsewhere = _views_of(images, [look.elsewhere for look in looks], options)
            elsewhere = tuple(  # with the camera of the search, which may not believe EXIF
                replace(view, camera=searched.camera, focal_unknown=searched.focal_unknown)
                for view, searched in zip(elsewhere, problem.views, strict=True)
            )
            refusal = not_better_elsewhere(problem.of(elsewhere), found) or refusal
        proposed = [look.proposed for look in looks if look.proposed is not None]
        if refusal is None and found is not None and len(proposed) == len(looks):
            place, refusal, scores = stronger_place(problem, geometry, proposed, found)
            found, refusal = (place, refusal) if place is found else accepted(problem, place)
        if refusal is None and found is not None:
            sensors = [image.sensor for image in images if image.look is not None]
            problem, found, cameras = with_corrected_cameras(problem, found, sensors, cameras)
            found, refusal = with_redraws(problem, found, geometry.reach)
        refusal = refusal and _with_turned_photos(refusal, looks)
    pose = None
    if refusal is None and found is not None and found.covariance is not None:
        pose = measured_pose(found, found.covariance, geometry)
        pose = replace(pose, probability=found.probability)
    inliers = () if found is None else tuple(found.inliers)
    estimated = None if refusal is not None or found is None else found.camera
    views = tuple(replace(view, camera=estimated or view.camera) for view in problem.views)
    used = () if refusal is not None else views
    shown = with_inliers(_shown(images, used, estimated is not None), inliers)
    coarse = looks[0].coarse if len(looks) == 1 else None
    answer = InstantAnswer(timestamp, shown, pose, refusal, seconds, scores, coarse)
    found = found if refusal is None else None
    solved = Solved(answer, views, found, inliers, cameras, geometry.errors)
    refusal = not_probable_enough(answer, options)
    return solved if refusal is None else solved.refused(refusal)


def check_solver(options: LocalizeOptions, num_cameras: int) -> None:
    """Refuse a solver that cannot take this many images at once."""
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
    """Return the views of the usable images, with their ``matches`` in order.

    A view with a guessed camera is empty, unless its focal length will be estimated.
    """
    usable = [(image.cam_from_rig, image.look) for image in images if image.look is not None]
    finds_focal = _finds_focal(images, options)
    views = []
    for (cam_from_rig, look), of_image in zip(usable, matches, strict=True):
        guessed = _is_guessed(look)
        counted = of_image if finds_focal or not guessed else Matches.none()
        views.append(
            MatchedView(
                look.camera,
                cam_from_rig,
                counted.pixels,
                counted.points,
                focal_unknown=guessed and finds_focal,
            )
        )
    return tuple(views)


def _sources_of(images: Sequence[SeenImage]) -> tuple[CameraSource, ...]:
    """Return where the cameras of the usable images came from."""
    return tuple(image.look.evidence.camera_source for image in images if image.look is not None)


def _shown_in(images: Sequence[SeenImage], options: LocalizeOptions) -> tuple[Shown | None, ...]:
    """Return what each view of ``_views_of`` shows; None for those with a guessed camera."""
    finds_focal = _finds_focal(images, options)
    looks = [image.look for image in images if image.look is not None]
    return tuple(look.shown if finds_focal or not _is_guessed(look) else None for look in looks)


def _finds_focal(images: Sequence[SeenImage], options: LocalizeOptions) -> bool:
    num_usable = sum(image.look is not None for image in images)
    return num_usable == 1 and options.solver is not Solver.REGISTRATION


def _is_guessed(look: Look) -> bool:
    return look.evidence.camera_source is CameraSource.GUESS


def _shown(
    images: Sequence[SeenImage], views: Sequence[MatchedView], is_estimated: bool
) -> list[ImageAnswer]:
    """Return each image's evidence, with the camera that its pose was found with, unreduced.

    ``views`` are those of the usable images; () when there is no pose.
    """
    found, shown = iter(views), []
    for image in images:
        evidence = None if image.look is None else image.look.evidence
        if image.look is not None and evidence is not None:
            view, source = next(found, None), evidence.camera_source
            if view is not None and view.camera != image.look.camera:
                width, height = evidence.camera.width, evidence.camera.height
                whole = view.camera.reduced(1 / image.look.reduced)
                stored = replace(whole, width=width, height=height)
                source = CameraSource.ESTIMATED if is_estimated else source
                evidence = replace(evidence, camera=stored, camera_source=source)
        shown.append(ImageAnswer(image.sensor, image.cam_from_rig, evidence, image.error))
    return shown


def with_inliers(
    images: Sequence[ImageAnswer], inliers: Sequence[NDArray[np.bool_]]
) -> tuple[ImageAnswer, ...]:
    """Count the inliers of each image; ``inliers`` has one mask per usable image.

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


def measured_pose(
    found: GeneralizedPose, photo_covariance: NDArray[np.float64], geometry: MapGeometry
) -> RigPose:
    """State a pose that images measured, in the world.

    Args:
        found: in the map's own coordinates.
        photo_covariance: (6, 6), from the scatter of the images' matches. The errors of the map
            are added here.
    """
    rig_from_local = found.rig_from_world
    whole = geometry.errors.whole(rig_from_local, photo_covariance, found.of_camera)
    return rig_pose(
        rig_from_local,
        whole,
        geometry.origin,
        PoseSource.ESTIMATED,
        geometry.errors.uncertainty,
        photo_covariance,
    )


def rig_pose(
    rig_from_local: Pose,
    covariance: NDArray[np.float64],
    origin: NDArray[np.float64],
    source: PoseSource,
    uncertainty: Uncertainty,
    photo_covariance: NDArray[np.float64] | None = None,
) -> RigPose:
    """Move a pose from a frame's own coordinates to its world.

    Args:
        covariance: (6, 6), the errors of the map included.
        origin: (3,) of the frame.
        uncertainty: which errors ``covariance`` covers.
        photo_covariance: (6, 6), the part of the instant's own images, if they measured the pose.
    """
    if photo_covariance is not None:
        _, photo_covariance = with_origin(rig_from_local, photo_covariance, origin)
    position_variance = np.diag(position_covariance(rig_from_local, covariance))
    rig_from_world, covariance = with_origin(rig_from_local, covariance, origin)
    return RigPose(
        rig_from_world,
        covariance,
        position_std=np.sqrt(position_variance),
        orientation_std=np.sqrt(np.diag(covariance)[:3]),
        source=source,
        photo_covariance=photo_covariance,
        uncertainty=uncertainty,
    )


def _find_pose(
    images: Sequence[SeenImage], problem: Problem
) -> tuple[Problem, GeneralizedPose | None, Refusal | None]:
    """Return the search, its best pose or None, and the reason to refuse it or None.

    If a single photo contradicts the focal length of its EXIF, the search is repeated without it,
    and finds the focal length with the pose; likewise if it has no pose with a camera of the map.
    A given camera is a statement and is not doubted so. EXIF is a hint, which editing and zooming
    make wrong.
    """
    refusal = _nothing_to_solve(images, problem)
    if refusal is not None:
        return problem, None, refusal
    best, refusal = _judged(problem)
    as_guess = None if refusal is None else _without_camera(problem, best, refusal.reason)
    if as_guess is None:
        return problem, best, refusal
    again, still = _judged(as_guess)
    if still is not None and problem.sources == (CameraSource.MAP,):
        return problem, best, refusal  # which a known camera makes the more telling one
    return as_guess, again, still


def _without_camera(
    problem: Problem, pose: GeneralizedPose | None, reason: Reason
) -> Problem | None:
    """Treat the focal length of EXIF, or a camera of the map, as a guess, if it may be wrong."""
    if problem.options.solver is Solver.REGISTRATION or len(problem.views) != 1:
        return None
    (view,), (source,) = problem.views, problem.sources
    camera = view.camera
    if source is CameraSource.MAP:
        camera = guessed_camera(camera.width, camera.height)
    # A wrong focal length moves the pose, so that it may contradict a prior first. The gate may
    # have found these intrinsics already. Finding them again takes little, compared with the
    # second search, which only such photos get.
    elif (
        source is not CameraSource.EXIF
        or pose is None
        or reason not in (Reason.CAMERA_CONTRADICTED, Reason.CONTRADICTS_PRIOR)
        or not only_focal_length_contradicts(
            view, source, pose.rig_from_world, problem.registration.max_error_px
        )
    ):
        return None
    views = (replace(view, camera=camera, focal_unknown=True),)
    return replace(problem, views=views, sources=(CameraSource.GUESS,))


def _judged(problem: Problem) -> tuple[GeneralizedPose | None, Refusal | None]:
    best = problem.solve()
    if best is None:
        return None, Refusal("pose", Reason.NO_POSE, "no camera pose explains the matches")
    return accepted(problem, best)


def _nothing_to_solve(images: Sequence[SeenImage], problem: Problem) -> Refusal | None:
    """Say why there are too few matches to search for a pose."""
    looks = [image.look for image in images if image.look is not None]
    if not looks:
        why = "none of the images could be used" if images else "there is no image"
        return Refusal("features", Reason.NO_USABLE_IMAGE, why)
    refusals = [look.refusal for look in looks if look.refusal is not None]
    if len(refusals) == len(looks):
        return refusals[0]
    needed, num_counted = problem.registration.min_inliers, problem.num_matches
    num_matches = sum(len(look.matches.pixels) for look in looks)
    if num_matches < needed:
        return Refusal(
            "matching",
            Reason.TOO_FEW_MATCHES,
            f"only {num_matches} keypoints match the map, but {needed} are needed",
        )
    if num_counted < needed:
        return Refusal(
            "gate",
            Reason.UNCERTAIN_POSE,
            f"{num_matches - num_counted} of {num_matches} matches do not count, "
            "because the focal length of their photo is a guess: send the camera. Only "
            "a photo on its own can do without, and only with a solver other than "
            f"{Solver.REGISTRATION}",
        )
    return None


def _with_turned_photos(refusal: Refusal, looks: Sequence[Look]) -> Refusal:
    """Add to the message that photos were read on their side, if that may be the cause."""
    orientations = sorted(
        {
            look.evidence.exif_orientation
            for look in looks
            if look.evidence.read_as is ReadAs.STORED and look.evidence.exif_orientation != 1
        }
    )
    if not orientations or refusal.reason not in REASONS_OF_TURNED_PHOTOS:
        return refusal
    exif = ", ".join(map(str, orientations))
    hint = f"stored rotated (EXIF orientation {exif}) and read as stored: try read_as=upright"
    return replace(refusal, message=f"{refusal.message}; the photo is {hint}")
