"""How one frame lies in another, from photos of the one that were localized in the other.

Each photo says it alone, since its pose is known in both; a few centimetres of error in each would
turn and shift the whole. So the similarity that most photos agree with is only the beginning: it
is then refined over the 2D-3D matches of all those photos together, with one robust loss.
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
from visloc.localization.gates import registration_for
from visloc.options import LocalizeOptions
from visloc.pose.colmap import project
from visloc.pose.refinement import LOSS_SCALE_PX

MIN_PHOTOS = 3
# Pairs of photos that propose a similarity.
_NUM_TRIALS = 200
# Matches of each photo that judge a proposal, and that refine what was chosen.
_JUDGING, _REFINING = 32, 256
# An alignment from one or two photos is a few times less exact than one from all of them.
_COARSE = 4.0
# Poses of mapping photos are not exact either: those of redkitchen shift what a photo sees by 20
# pixels. What was localized elsewhere is off by hundreds.
_AGREES = 2.0
_ROUNDS = 3
# Largest error of the scale between two frames of one unit, which that of a map may have.
_MAX_OTHER_UNIT = 0.02
# Depths in the two frames may differ by this share. On redkitchen, errors of the depth camera and
# of the poses together make 1 % at most.
MAX_DEPTH_OFF = 0.03
# After so many the weights of points change no more.
_POINT_ROUNDS = 50


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A photo that was localized in another frame than its own.

    Attributes:
        pose_here: cam_from_here, in the frame that it comes from.
        camera: intrinsics.
        pixels: (n, 2) float64, inliers of ``pose_there``.
        points: (n, 3) float64, what they see, in the other frame.
        pose_there: cam_from_there, as it was localized.
        own_points: (n, 3) float64, the same points where depth puts them in the photo's own frame;
            None where it does not.
    """

    pose_here: Pose
    camera: Camera
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    pose_there: Pose
    own_points: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """How the frame of some photos lies in another one.

    Attributes:
        there_from_here: the similarity.
        tied: (n,) the photos that agree with it.
        errors_px: (n,) of each photo, the median reprojection error of its matches from where the
            similarity puts it; infinity for one that looks away.
        distances: (n,) from where the similarity puts it to where it was localized, in the other
            frame's unit.
        angles_deg: (n,) likewise.
        num_back: photos of the other frame, localized in this one, that agree too.
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
        why: in words to follow "but".
        unit: whether the photos agree, and the units of the frames, or of depth, do not.
    """

    why: str
    unit: bool = False


def tie(
    photos: Sequence[Seen], back: Sequence[Seen] = (), *, rigid: bool, seed: int = 0
) -> Tie | NoTie:
    """Find the similarity that photos of one frame, localized in another, agree on.

    Args:
        photos: of this frame, seen in the other.
        back: of the other frame, seen in this one; with them the similarity is also that which
            explains what they see here. May be empty.
        rigid: whether both frames have one unit.
        seed: equal seeds give equal ties.

    Returns:
        The tie; or why there is none: fewer than three photos, not more
        than half of them agree, they stand too close together to tell the scale, rigidly tied
        they tell another one than 1, or depth has another unit than the poses.
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
    """Say that depth has another unit than a similarity, in words to follow "but"; or None.

    Args:
        photos: those that agree with it, with ``own_points``, one at least.
        there_from_here: the similarity.
    """
    return _other_depth([_View(seen, forward=True) for seen in photos], there_from_here)


def refined_by_depth(photos: Sequence[Seen], start: Similarity, *, rigid: bool) -> Similarity:
    """Refine the similarity of tied photos on what they see, where depth puts it.

    Args:
        photos: those that agree with it, with ``own_points``.
        start: the similarity.
        rigid: whether both frames have one unit.

    Returns:
        What must be judged again (``agreeing``).
    """
    return _refined_by_depth([_View(seen, forward=True) for seen in photos], start, rigid=rigid)


def agreeing(photos: Sequence[Seen], there_from_here: Similarity) -> NDArray[np.bool_]:
    """Tell which photos (n,) agree with a similarity, as they must to be tied."""
    return _agreeing([_View(seen, forward=True) for seen in photos], there_from_here, _AGREES)


def contradicting(photos: Sequence[Seen], there_from_here: Similarity) -> NDArray[np.bool_]:
    """Tell which photos (n,) cannot have been where a similarity puts them.

    Some that agree with it badly do not contradict it: poses of photos are not exact. Those of
    redkitchen come to 2.4 times the error of an inlier.
    """
    return ~_agreeing([_View(seen, forward=True) for seen in photos], there_from_here, _COARSE)


def too_few(tied: NDArray[np.bool_]) -> str | None:
    """Say why photos (n,) of which these agree are no tie, in words to follow "but"; or None."""
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
    """Refine a similarity on points whose place is known in both frames.

    Projections tell little of a shift that a turn can pass for, and inherit what is wrong with a
    camera's intrinsics; points that depth gave in both frames do neither. The loss is Cauchy's, in
    units of the median distance, so that it fits any depth sensor and any unit.

    Args:
        start: near the result.
        here: (n, 3) in this frame, n >= 3.
        there: (n, 3) the same points in the other, some of them wrong.
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
    """The similarity of the least weighted squares (Umeyama 1991)."""
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
    """A photo with what it sees in the other frame: there, or here if it goes back."""

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
        """The photo's pose in this frame and in the other."""
        seen = self.seen
        own, other = seen.pose_here, seen.pose_there
        return (own, other) if self.forward else (other, own)

    def errors(self, there_from_here: Similarity) -> NDArray[np.float64]:
        """(n, 2) pixels, projected less seen; NaN behind the camera."""
        other_from_own = there_from_here if self.forward else there_from_here.inverse()
        cam_from_other = other_from_own.move(self.seen.pose_here)
        in_cam = cam_from_other.apply(self.seen.points)
        return np.asarray(project(self.seen.camera, in_cam) - self.seen.pixels)

    def median_error(self, there_from_here: Similarity) -> float:
        """Pixels; those behind the camera are infinitely far off."""
        x, y = self.errors(there_from_here).T
        return float(np.median(np.nan_to_num(np.hypot(x, y), nan=np.inf)))

    def depth_factors(self, there_from_here: Similarity) -> NDArray[np.float64]:
        """(n,) how many times further away points are here than there, in one unit."""
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
    # Places alone would not show another unit: moving all photos back makes up for much of it.
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
    """Return the points (n, 3) that a photo sees, in this frame and in the other, by depth."""
    own, other = view.seen.own_points, view.seen.points
    assert own is not None
    return (own, other) if view.forward else (other, own)


def _proposed(views: Sequence[_View], *, rigid: bool, seed: int) -> Similarity:
    """Return the similarity of two photos that most photos agree with; ties go by errors."""
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
    """Photos half of whose matches are within so many times the error of an inlier."""
    return np.array(
        [view.median_error(similarity) <= times * view.max_error_px for view in views], np.bool_
    )


def _refined(views: Sequence[_View], start: Similarity, *, rigid: bool) -> Similarity:
    """Minimize a robust reprojection error over all matches of photos.

    Rotations and scale are about the middle of the photos, whatever the frames count from.
    """
    thin = [view.thinned(_REFINING) for view in views]
    middle = np.mean([view.estimate()[0].center for view in views], axis=0)
    middle_there = start.apply(middle)

    def changed(step: NDArray[np.float64]) -> Similarity:
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ start.rotation
        scale = start.scale if rigid else start.scale * float(np.exp(step[6]))
        shift = middle_there + start.scale * size * step[3:6] - scale * rotation @ middle
        return Similarity(scale, rotation, shift)

    # Steps of the translation are in units of how far away the points are, as those of the others.
    size = _distance(views) / start.scale

    def errors(step: NDArray[np.float64]) -> NDArray[np.float64]:
        similarity = changed(step)
        found = [view.errors(similarity) / view.max_error_px for view in thin]
        # Behind the camera, or far off: all the same, so that they pull nowhere.
        return np.nan_to_num(np.concatenate(found), nan=_COARSE).clip(-_COARSE, _COARSE).ravel()

    # The loss of a pose, in units of its largest error.
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
    """Median distance, in the other frame's unit, from photos to what they see there."""
    far = [
        np.median(np.linalg.norm(view.seen.points - view.seen.pose_there.center, axis=1))
        for view in views
        if view.forward
    ]
    return float(np.median(far))


def _errors(photos: Sequence[Seen], similarity: Similarity) -> NDArray[np.float64]:
    """(2, n) distances and angles between where photos were localized and where they are put."""
    errors = [pose_error(similarity.move(seen.pose_here), seen.pose_there) for seen in photos]
    return np.array(errors).T


def _scale_error(
    photos: Sequence[Seen], tied: NDArray[np.bool_], distances: NDArray[np.float64]
) -> float:
    """Half of the 95 % interval of the scale that tied photos tell, as a part of it."""
    centers = np.array(
        [seen.pose_there.center for seen, use in zip(photos, tied, strict=True) if use]
    )
    squares = float(((centers - centers.mean(axis=0)) ** 2).sum())
    rms = float(np.sqrt((distances[tied] ** 2).mean()))
    return float(2 * rms / np.sqrt(squares)) if squares > 0 else np.inf


def _other_unit(photos: Sequence[Seen], tied: NDArray[np.bool_], free: Similarity) -> str | None:
    """Why frames have not one unit, by the similarity that fits best; None when they may."""
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
    """Why the photos do not tell the scale, if they do not."""
    error = _scale_error(photos, tied, distances)
    if error <= MAX_SCALE_ERROR:
        return None
    return (
        f"the {tied.sum()} photos that agree stand too close together to tell the scale: to "
        f"{error:.0%}, and {MAX_SCALE_ERROR:.0%} are needed"
    )
