"""The pose of a rig from the 2D-3D correspondences of all its cameras.

A photo on its own is a rig of one camera at the identity: the same code. pycolmap's estimator for
one camera finds the same inliers, and is not more accurate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.colmap
import pycolmap
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.colmap import colmap_camera, pose_from_colmap
from visloc.pose.covariance import pose_covariance
from visloc.pose.gravity import KnownGravity, find_upright_poses
from visloc.pose.refinement import LOSS_SCALE_PX, MIN_INLIERS, RefinedPose, refine
from visloc.pose.views import MatchedView

# Beyond this many trials a pose with 8 % inliers has been found with 99 % probability; a photo
# of another place should not cost seconds.
MAX_TRIALS = 10_000
# pycolmap's own for one camera; those that it has for rigs take twice as long when half of
# the correspondences are right, and find no more when few are.
_CONFIDENCE = 0.99999
_MIN_TRIALS = 100
# RANSAC looks at no more than this many correspondences: what explains them explains the others,
# and a photo of another place costs a third of the time. Of 4000 in no
# order, poses that explain 5 % are found as often as among all, those of 3 % more rarely.
_MAX_SEARCHED = 1_000
# Steps of refinement that tell which of several poses is the best.
_STEPS_TO_COMPARE = 5


@dataclass(frozen=True, slots=True, eq=False)
class GeneralizedPose:
    """A refined pose of a rig and what supports it.

    Attributes:
        rig_from_world: in the frame of the points that were given.
        inliers: (n,) bool for each view, reprojection error within the threshold under this pose.
        covariance: (6, 6) of ``rig_from_world``, rotation (rad) then translation, for
            R <- Exp(w) R and t <- t + dt; None when the inliers leave the pose undetermined
            (collinear points, for one).
    """

    rig_from_world: Pose
    inliers: tuple[NDArray[np.bool_], ...]
    covariance: NDArray[np.float64] | None

    @property
    def num_inliers(self) -> int:
        """Inliers of all views."""
        return sum(int(mask.sum()) for mask in self.inliers)


def estimate_generalized_pose(
    views: Sequence[MatchedView],
    *,
    max_error_px: float,
    seed: int,
    gravity: KnownGravity | None = None,
) -> GeneralizedPose | None:
    """Solve for the pose of a rig and refine it on the inliers of all its cameras.

    Without gravity by LO-RANSAC with GP3P (pycolmap), over a sample of 1000 where there are more:
    poses that explain less than about 4 % of the correspondences are not searched for. With
    gravity by RANSAC with two correspondences (see ``visloc.pose.gravity``); gravity only guides
    the search, the refinement leaves all six degrees of freedom.

    Args:
        views: what each camera sees; some may have no correspondences.
        max_error_px: largest reprojection error of an inlier, in each camera's pixels.
        seed: equal seeds give equal bits.
        gravity: when it is known which way is down.

    Returns:
        The pose, or None when there are fewer than four correspondences or none was found that
        explains four. The solver finds a pose in almost anything: the caller must judge the
        inliers, and, with gravity, ``gravity_deviation``.

    Raises:
        ValueError: a view has not as many pixels as points.
    """
    checked = _checked(views)
    if gravity is None:
        starts = _search(checked, max_error_px, seed)
    else:
        starts = find_upright_poses(checked, gravity, max_error_px=max_error_px, seed=seed)
    if len(starts) > 1:
        tried = [
            refine(checked, start, max_error_px=max_error_px, max_steps=_STEPS_TO_COMPARE)
            for start in starts
        ]
        found = [pose for pose in tried if pose is not None]
        starts = [max(found, key=lambda pose: pose.num_inliers).rig_from_world] if found else []
    best = refine(checked, starts[0], max_error_px=max_error_px) if starts else None
    return None if best is None else _judged(checked, best)


def refine_generalized_pose(
    views: Sequence[MatchedView], rig_from_world: Pose, *, max_error_px: float
) -> GeneralizedPose | None:
    """Refine the pose of a rig on its inliers, those of the refined pose again.

    Args:
        views: what each camera sees; some may have no correspondences.
        rig_from_world: where to start.
        max_error_px: largest reprojection error of an inlier, in each camera's pixels.

    Returns:
        The pose, or None when fewer than four correspondences are inliers of the start or of the
        refined pose.

    Raises:
        ValueError: a view has not as many pixels as points.
    """
    checked = _checked(views)
    best = refine(checked, rig_from_world, max_error_px=max_error_px)
    return None if best is None else _judged(checked, best)


def _checked(views: Sequence[MatchedView]) -> list[MatchedView]:
    """NaN for infinity: both are no inlier, but arithmetic with the latter warns."""
    for index, view in enumerate(views):
        if view.pixels.shape != (len(view.points), 2) or view.points.shape[1:] != (3,):
            raise ValueError(
                f"views[{index}]: pixels (n, 2) and points (n, 3) expected, "
                f"got {view.pixels.shape} and {view.points.shape}"
            )
    return [
        replace(
            view,
            pixels=np.where(np.isfinite(view.pixels), view.pixels, np.nan),
            points=np.where(np.isfinite(view.points), view.points, np.nan),
        )
        for view in views
    ]


def _search(views: Sequence[MatchedView], max_error_px: float, seed: int) -> list[Pose]:
    """The best pose by RANSAC, or none."""
    share = _MAX_SEARCHED / max(sum(len(view) for view in views), _MAX_SEARCHED)
    searched = [_sample(view, round(share * len(view))) for view in views]
    pixels = np.concatenate([np.empty((0, 2)), *(view.pixels for view in searched)])
    points = np.concatenate([np.empty((0, 3)), *(view.points for view in searched)])
    camera_of = np.repeat(np.arange(len(searched)), [len(view) for view in searched])
    finite = np.isfinite(pixels).all(axis=1) & np.isfinite(points).all(axis=1)
    if np.count_nonzero(finite) < MIN_INLIERS:
        return []
    options = pycolmap.RANSACOptions()  # those that the call has by default are refused by it
    options.max_error = max_error_px
    options.confidence = _CONFIDENCE
    options.min_num_trials = _MIN_TRIALS
    options.max_num_trials = MAX_TRIALS
    options.random_seed = seed
    solved = pycolmap.estimate_generalized_absolute_pose(
        pixels[finite],
        points[finite],
        camera_of[finite].tolist(),
        [_rigid(view.cam_from_rig) for view in searched],
        [colmap_camera(view.camera) for view in searched],
        options,
    )
    return [] if solved is None else [pose_from_colmap(solved["rig_from_world"])]


def _sample(view: MatchedView, count: int) -> MatchedView:
    """The first half of ``count`` correspondences, the best, and as many evenly from the others.

    The best alone would find a pose in fewer trials, but nothing where they are wrong together.
    """
    num_best = count // 2
    num_others = count - num_best
    others = len(view) - num_best
    rows = num_best + np.arange(num_others) * others // max(num_others, 1)
    return view.selected(np.concatenate([np.arange(num_best), rows]))


def _judged(views: Sequence[MatchedView], best: RefinedPose) -> GeneralizedPose:
    """Add the covariance."""
    kept = [view.selected(mask) for view, mask in zip(views, best.inliers, strict=True)]
    covariance = pose_covariance(kept, best.rig_from_world, LOSS_SCALE_PX)
    return GeneralizedPose(best.rig_from_world, best.inliers, covariance)


def _rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
