"""Align two frames, by photos of one frame that were localized in the other.

A single photo would do, because its pose is known in both frames. But a few centimetres of error
in its pose would turn and shift the whole frame. So pairs of photos propose similarities, and the
one that most photos agree with is refined over all their 2D-3D matches, with one robust loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mapping.frames.anchor import MAX_SCALE_ERROR, align_poses
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose, Similarity
from visloc.localization.acceptance.gates import registration_for
from visloc.options import LocalizeOptions
from visloc.pose.refinement import LOSS_SCALE_PX
from visloc.pose.reprojection import project

MIN_PHOTOS = 3
# How many pairs of photos propose a similarity.
_NUM_TRIALS = 200
# Matches of each photo that judge a proposal, and matches that refine the chosen one.
_JUDGING, _REFINING = 32, 256
# Limits of a photo's median reprojection error, in units of the largest error of an inlier. For
# proposals, as two photos align the frames a few times less exactly than all of them:
_COARSE = 4.0
# For the refined similarity, as poses of mapping photos are not exact: those of redkitchen shift
# the projections by 20 pixels. A photo of another place is off by hundreds.
_AGREES = 2.0
_ROUNDS = 3
# Largest difference of scale between two frames that are said to have one unit. A map's own scale
# may be wrong by as much.
_MAX_OTHER_UNIT = 0.02
# Largest relative difference between the depths of the two frames. On redkitchen, errors of the
# depth camera and of the poses together make 1 % at most.
MAX_DEPTH_OFF = 0.03
# After so many rounds the weights of points change no more.
_POINT_ROUNDS = 50


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A photo that was localized in another frame ("there") than its own ("here").

    Attributes:
        pixels: (n, 2) float64, keypoints of the inliers of ``pose_there``.
        points: (n, 3) float64, the landmarks of these inliers, in the other frame.
        own_points: (n, 3) float64, the same points in the photo's own frame, from its depth; None
            without depth.
    """

    pose_here: Pose
    camera: Camera
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    pose_there: Pose
    own_points: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """How the frame of n photos lies in another one. The similarity gives each a "moved pose".

    Attributes:
        tied: (n,) whether the photo agrees with it.
        errors_px: (n,) median reprojection error of the photo's matches under its moved pose;
            infinity if they lie behind the camera.
        distances: (n,) from the moved pose to the localized pose, in the other frame's unit.
        angles_deg: (n,) between the moved pose and the localized pose.
        num_back: number of photos of the other frame, localized in this one, that agree too.
    """

    there_from_here: Similarity
    tied: NDArray[np.bool_]
    errors_px: NDArray[np.float64]
    distances: NDArray[np.float64]
    angles_deg: NDArray[np.float64]
    num_back: int


@dataclass(frozen=True, slots=True)
class NoTie:
    """Why there is no tie.

    Attributes:
        why: the reason, as a clause that follows "but".
        unit: whether the photos agree and only the unit of a frame, or of depth, differs.
    """

    why: str
    unit: bool = False


def tie(
    photos: Sequence[Seen], back: Sequence[Seen] = (), *, rigid: bool, seed: int = 0
) -> Tie | NoTie:
    """Find the similarity that photos of one frame, localized in another, agree on.

    Args:
        photos: photos of this frame, localized in the other.
        back: photos of the other frame, localized in this one. The similarity must explain their
            matches too. May be empty.
        rigid: whether both frames have one unit, so that the scale is 1.

    Returns:
        The tie, or why there is none: fewer than three photos; at most half of them agree; without
        ``rigid``, they stand too close together to tell the scale; with it, their scale is not 1;
        or depth has another unit than the poses.
    """
    if len(photos) < MIN_PHOTOS:
        return NoTie(f"only {len(photos)} photos were localized, and {MIN_PHOTOS} are needed")
    views = [_View(seen, forward=True) for seen in photos]
    views += [_View(seen, forward=False) for seen in back]
    similarity = _proposed(views, rigid=rigid, seed=seed)
    agrees = _agreeing(views, similarity, _COARSE)
    for _ in range(_ROUNDS):
        if agrees[: len(photos)].sum() < MIN_PHOTOS:
            break
        chosen = [view for view, use in zip(views, agrees, strict=True) if use]
        similarity = _refined(chosen, similarity, rigid=rigid)
        agrees = _agreeing(views, similarity, _AGREES)
    if (few := too_few(agrees[: len(photos)])) is not None:
        scaled = tie(photos, back, rigid=False, seed=seed) if rigid else None
        if isinstance(scaled, Tie):  # of units as far apart as feet and metres
            other = _other_unit(photos, scaled.tied, scaled.there_from_here)
            return NoTie(few if other is None else other, unit=other is not None)
        return NoTie(few)
    chosen = [view for view, use in zip(views, agrees, strict=True) if use]
    if all(view.seen.own_points is not None for view in chosen):
        if (other_depth := _other_depth(chosen, similarity)) is not None:
            return NoTie(other_depth, unit=True)
        similarity = _refined_by_depth(chosen, similarity, rigid=rigid)
        agrees = _agreeing(views, similarity, _AGREES)
    tied = agrees[: len(photos)]
    if (few := too_few(tied)) is not None:
        return NoTie(few)
    distances, angles = _errors(photos, similarity)
    if rigid:
        chosen = [view for view, use in zip(views, agrees, strict=True) if use]
        free = _refined(chosen, similarity, rigid=False)
        doubt = _other_unit(photos, tied, free)
    else:
        doubt = _scale_doubt(photos, tied, distances)
    if doubt is not None:
        return NoTie(doubt, unit=rigid)
    medians = np.array([view.median_error(similarity) for view in views[: len(photos)]])
    return Tie(similarity, tied, medians, distances, angles, int(agrees[len(photos) :].sum()))


def other_depth(photos: Sequence[Seen], there_from_here: Similarity) -> str | None:
    """Say that depth has another unit, as a clause that follows "but"; None if it has not.

    Args:
        photos: photos that agree with the similarity, at least one, all with ``own_points``.
    """
    return _other_depth([_View(seen, forward=True) for seen in photos], there_from_here)


def refined_by_depth(photos: Sequence[Seen], start: Similarity, *, rigid: bool) -> Similarity:
    """Refine a similarity on the points that its photos see, placed by depth.

    Args:
        photos: photos that agree with the similarity, all with ``own_points``.
        rigid: whether both frames have one unit.

    Returns:
        The refined similarity. The photos may no longer agree with it: call ``agreeing`` again.
    """
    return _refined_by_depth([_View(seen, forward=True) for seen in photos], start, rigid=rigid)


def agreeing(photos: Sequence[Seen], there_from_here: Similarity) -> NDArray[np.bool_]:
    """Tell which photos (n,) agree with a similarity well enough to be tied."""
    return _agreeing([_View(seen, forward=True) for seen in photos], there_from_here, _AGREES)


def contradicting(photos: Sequence[Seen], there_from_here: Similarity) -> NDArray[np.bool_]:
    """Tell which photos (n,) cannot have been taken where a similarity puts them.

    The limit is wider than that of ``agreeing``, because poses of photos are not exact. Those of
    redkitchen reach 2.4 times the largest error of an inlier.
    """
    return ~_agreeing([_View(seen, forward=True) for seen in photos], there_from_here, _COARSE)


def too_few(tied: NDArray[np.bool_]) -> str | None:
    """Say why too few photos agree, as a clause that follows "but"; None if enough do."""
    if tied.sum() >= max(MIN_PHOTOS, len(tied) // 2 + 1):
        return None
    return (
        f"only {tied.sum()} of {len(tied)} localized photos agree on how the frames lie to "
        f"each other, and more than half must, {MIN_PHOTOS} at least"
    )


def refined_on_points(
    start: Similarity,
    here: NDArray[np.float64],
    there: NDArray[np.float64],
    *,
    rigid: bool,
) -> Similarity:
    """Refine a similarity on points that are known in both frames.

    Projections hardly tell a small shift from a small turn, and they inherit the errors of the
    camera's intrinsics. Points from depth in both frames have neither weakness. The loss is
    Cauchy's, in units of the median distance, so that it fits any depth sensor and any unit.

    Args:
        here: (n, 3) in this frame, n >= 3.
        there: (n, 3) the same points in the other frame; some may be wrong.
        rigid: whether both frames have one unit.
    """
    similarity = start
    if (here == here[0]).all():  # one point tells no turn
        return start
    for _ in range(_POINT_ROUNDS):
        distances = np.linalg.norm(similarity.apply(here) - there, axis=1)
        unit = float(np.median(distances))
        if unit == 0:
            break
        weights = 1 / (1 + (distances / unit) ** 2)
        similarity = _fitted(here, there, weights, rigid=rigid)
    return similarity


def _fitted(
    here: NDArray[np.float64],
    there: NDArray[np.float64],
    weights: NDArray[np.float64],
    *,
    rigid: bool,
) -> Similarity:
    """Return the similarity with the least weighted squares (Umeyama 1991)."""
    weights = weights / weights.sum()
    middle, middle_there = weights @ here, weights @ there
    source, target = here - middle, there - middle_there
    u, singular, vt = np.linalg.svd((target * weights[:, None]).T @ source)
    signs = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ np.diag(signs) @ vt
    scale = 1.0 if rigid else float(singular @ signs / (weights @ (source**2).sum(axis=1)))
    return Similarity(scale, rotation, middle_there - scale * rotation @ middle)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A photo, and whether it was localized there (``forward``) or, the other way, here."""

    seen: Seen
    forward: bool

    def thinned(self, count: int) -> _View:
        """Keep at most so many matches, evenly."""
        step = -(-len(self.seen.pixels) // count)
        seen = self.seen
        thin = replace(
            seen, pixels=seen.pixels[::step], points=seen.points[::step], own_points=None
        )
        return _View(thin, self.forward)

    def estimate(self) -> tuple[Pose, Pose]:
        """Return the photo's pose in this frame and in the other."""
        seen = self.seen
        own, other = seen.pose_here, seen.pose_there
        return (own, other) if self.forward else (other, own)

    def errors(self, there_from_here: Similarity) -> NDArray[np.float64]:
        """Return (n, 2) pixels, projected minus observed; NaN behind the camera."""
        other_from_own = there_from_here if self.forward else there_from_here.inverse()
        cam_from_other = other_from_own.move(self.seen.pose_here)
        in_cam = cam_from_other.apply(self.seen.points)
        return np.asarray(project(self.seen.camera, in_cam) - self.seen.pixels)

    def median_error(self, there_from_here: Similarity) -> float:
        """Return the median error in pixels; a point behind the camera counts as infinity."""
        x, y = self.errors(there_from_here).T
        return float(np.median(np.nan_to_num(np.hypot(x, y), nan=np.inf)))

    def depth_factors(self, there_from_here: Similarity) -> NDArray[np.float64]:
        """Return (n,) each point's distance here divided by that there, in one unit."""
        own, other = self.seen.own_points, self.seen.points
        assert own is not None
        away = np.linalg.norm(self.seen.pose_here.apply(own), axis=1)
        away_other = np.linalg.norm(self.seen.pose_there.apply(other), axis=1)
        here, there = (away, away_other) if self.forward else (away_other, away)
        return np.asarray(there_from_here.scale * here / there)

    @property
    def max_error_px(self) -> float:
        """The largest reprojection error of an inlier when the photo was localized."""
        return registration_for(LocalizeOptions(), [self.seen.camera]).max_error_px


def _other_depth(views: Sequence[_View], similarity: Similarity) -> str | None:
    # Camera positions alone would not show another unit: moving all photos back hides much of it.
    factor = float(np.median(np.concatenate([view.depth_factors(similarity) for view in views])))
    if abs(factor - 1) <= MAX_DEPTH_OFF:
        return None
    return (
        f"by depth, what they see is {factor:.3g} times as far from them here as there, and "
        f"at most {MAX_DEPTH_OFF:.0%} may come of errors"
    )


def _refined_by_depth(views: Sequence[_View], start: Similarity, *, rigid: bool) -> Similarity:
    here, there = (np.concatenate(side) for side in zip(*map(_points, views), strict=True))
    return refined_on_points(start, here, there, rigid=rigid)


def _points(view: _View) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points (n, 3) that a photo sees, in this frame and in the other."""
    own, other = view.seen.own_points, view.seen.points
    assert own is not None
    return (own, other) if view.forward else (other, own)


def _proposed(views: Sequence[_View], *, rigid: bool, seed: int) -> Similarity:
    """Return the best pair's similarity: most photos agree; of equals, the smallest errors."""
    random = np.random.default_rng(seed)
    judging = [view.thinned(_JUDGING) for view in views]
    limits = np.array([_COARSE * view.max_error_px for view in judging])
    best, best_score = Similarity.identity(), (-1, 0.0)
    for _ in range(_NUM_TRIALS):
        pair = random.choice(len(views), 2, replace=False)
        similarity = _aligned([views[row] for row in pair], rigid=rigid)
        errors = np.array([view.median_error(similarity) for view in judging])
        within = errors <= limits
        score = int(within.sum()), -float((errors[within] / limits[within]).sum())
        if score > best_score:
            best, best_score = similarity, score
    return best


def _aligned(views: Sequence[_View], *, rigid: bool) -> Similarity:
    here, there = zip(*(view.estimate() for view in views), strict=True)
    found = align_poses(here, there)
    if not rigid:
        return found
    own = np.mean([pose.center for pose in here], axis=0)
    other = np.mean([pose.center for pose in there], axis=0)
    return Similarity(1.0, found.rotation, other - found.rotation @ own)


def _agreeing(views: Sequence[_View], similarity: Similarity, times: float) -> NDArray[np.bool_]:
    """Tell which photos have a median error of at most ``times`` the largest error of an inlier."""
    return np.array(
        [view.median_error(similarity) <= times * view.max_error_px for view in views], np.bool_
    )


def _refined(views: Sequence[_View], start: Similarity, *, rigid: bool) -> Similarity:
    """Minimize a robust reprojection error over all matches of photos.

    Rotation and scale are about the middle of the photos, so that a far origin does no harm.
    """
    thin = [view.thinned(_REFINING) for view in views]
    middle = np.mean([view.estimate()[0].center for view in views], axis=0)
    middle_there = start.apply(middle)

    def changed(step: NDArray[np.float64]) -> Similarity:
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ start.rotation
        scale = start.scale if rigid else start.scale * float(np.exp(step[6]))
        shift = middle_there + start.scale * size * step[3:6] - scale * rotation @ middle
        return Similarity(scale, rotation, shift)

    # In units of the distance to the points, all steps move projections about equally.
    size = _distance(views) / start.scale

    def errors(step: NDArray[np.float64]) -> NDArray[np.float64]:
        similarity = changed(step)
        found = [view.errors(similarity) / view.max_error_px for view in thin]
        # Points behind the camera or far off have a constant error, so that they pull nowhere.
        return np.nan_to_num(np.concatenate(found), nan=_COARSE).clip(-_COARSE, _COARSE).ravel()

    # The scale of the loss that poses are refined with, in units of the largest error of an inlier.
    full = registration_for(LocalizeOptions(), [replace(views[0].seen.camera, width=10**6)])
    solved = least_squares(
        errors,
        np.zeros(6 if rigid else 7),
        jac="3-point",
        loss="cauchy",
        f_scale=LOSS_SCALE_PX / full.max_error_px,
        x_scale="jac",
        ftol=1e-6,
        xtol=1e-6,
    )
    return changed(solved.x)


def _distance(views: Sequence[_View]) -> float:
    """Return the median distance from the photos to their points, in the other frame's unit."""
    far = [
        np.median(np.linalg.norm(view.seen.points - view.seen.pose_there.center, axis=1))
        for view in views
        if view.forward
    ]
    return float(np.median(far))


def _errors(photos: Sequence[Seen], similarity: Similarity) -> NDArray[np.float64]:
    """Return (2, n) distances and angles between the moved and the localized poses."""
    errors = [pose_error(similarity.move(seen.pose_here), seen.pose_there) for seen in photos]
    return np.array(errors).T


def _scale_error(
    photos: Sequence[Seen], tied: NDArray[np.bool_], distances: NDArray[np.float64]
) -> float:
    """Return half the 95 % interval of the scale that tied photos tell, relative to the scale."""
    centers = np.array(
        [seen.pose_there.center for seen, use in zip(photos, tied, strict=True) if use]
    )
    squares = float(((centers - centers.mean(axis=0)) ** 2).sum())
    rms = float(np.sqrt((distances[tied] ** 2).mean()))
    return float(2 * rms / np.sqrt(squares)) if squares > 0 else np.inf


def _other_unit(photos: Sequence[Seen], tied: NDArray[np.bool_], free: Similarity) -> str | None:
    """Say why the frames do not have one unit, by the best similarity; None if they may."""
    allowed = max(_MAX_OTHER_UNIT, _scale_error(photos, tied, _errors(photos, free)[0]))
    if abs(np.log(free.scale)) <= allowed:
        return None
    return (
        f"a metre of theirs is {free.scale:.3g} metres there: both are said to be metric, and at "
        f"least one is not to within {allowed:.0%}"
    )


def _scale_doubt(
    photos: Sequence[Seen], tied: NDArray[np.bool_], distances: NDArray[np.float64]
) -> str | None:
    """Say why the photos do not tell the scale; None if they do."""
    error = _scale_error(photos, tied, distances)
    if error <= MAX_SCALE_ERROR:
        return None
    return (
        f"the {tied.sum()} photos that agree stand too close together to tell the scale: to "
        f"{error:.0%}, and {MAX_SCALE_ERROR:.0%} are needed"
    )
