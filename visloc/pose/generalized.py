"""The pose of a rig from the 2D-3D correspondences of all its cameras.

A photo on its own is a rig of one camera at the identity: the same code. pycolmap's estimator for
one camera finds the same inliers, and is neither more accurate nor, on the whole, faster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.colmap
import pycolmap
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.colmap import colmap_camera, pose_from_colmap, project
from visloc.pose.covariance import pose_covariance
from visloc.pose.gravity import KnownGravity, find_upright_poses
from visloc.pose.views import MatchedView

# Beyond this many trials a pose with 8 % inliers has been found with 99 % probability; a photo
# of another place should not cost seconds.
MAX_TRIALS = 10_000
# Scale of the Cauchy loss in the refinement. Landmarks from depth maps scatter by a few pixels.
LOSS_SCALE_PX = 3.0
# pycolmap's own for one camera; those that it has for rigs take twice as long when half of
# the correspondences are right, and find no more when few are.
_CONFIDENCE = 0.99999
_MIN_TRIALS = 100
_MIN_POINTS = 4
# The solver's inliers are measured on average over a rig's focal lengths, and are few when few are
# right, and those of a pose found by gravity lean as gravity was wrong: inliers are chosen again
# under the refined pose, to compare poses this often,
_ROUNDS = 2
# and of the best pose until they settle: until so small a share of them changes.
_MAX_ROUNDS = 10
_SETTLED = 0.005


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

    Without gravity by LO-RANSAC with GP3P, or P3P where all centres are one (pycolmap). With
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
    stacked = _stack(views)
    if np.count_nonzero(stacked.finite) < _MIN_POINTS:
        return None
    if gravity is None:
        starts = _search(stacked, max_error_px, seed)
    else:
        starts = find_upright_poses(stacked.views, gravity, max_error_px=max_error_px, seed=seed)
    if len(starts) > 1:
        refined = [_refine(stacked, start, max_error_px, _ROUNDS) for start in starts]
        poses = [pose for pose in refined if pose is not None]
        starts = [max(poses, key=lambda pose: pose[1].sum())[0]] if poses else []
    settled = _refine(stacked, starts[0], max_error_px, _MAX_ROUNDS) if starts else None
    return None if settled is None else _judged(views, settled)


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
        refined pose, or they do not settle on one.

    Raises:
        ValueError: a view has not as many pixels as points.
    """
    refined = _refine(_stack(views), rig_from_world, max_error_px, _MAX_ROUNDS)
    return None if refined is None else _judged(views, refined)


def reprojection_errors(view: MatchedView, rig_from_world: Pose) -> NDArray[np.float64]:
    """Return the distances (n,) in pixels; NaN for points behind the camera."""
    seen = (view.cam_from_rig @ rig_from_world).apply(view.points)
    return np.asarray(np.linalg.norm(project(view.camera, seen) - view.pixels, axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Stacked:
    """Views in the form that pycolmap takes them."""

    views: Sequence[MatchedView]
    pixels: NDArray[np.float64]  # (n, 2)
    points: NDArray[np.float64]  # (n, 3)
    camera_of: NDArray[np.intp]  # (n,)
    finite: NDArray[np.bool_]  # (n,)
    cams_from_rig: list[pycolmap.Rigid3d]
    cameras: list[pycolmap.Camera]

    def inliers(self, rig_from_world: Pose, max_error_px: float) -> NDArray[np.bool_]:
        errors = np.concatenate([reprojection_errors(view, rig_from_world) for view in self.views])
        return np.asarray(errors <= max_error_px)  # False for NaN: behind the camera


def _stack(views: Sequence[MatchedView]) -> _Stacked:
    for index, view in enumerate(views):
        if view.pixels.shape != (len(view.points), 2) or view.points.shape[1:] != (3,):
            raise ValueError(
                f"views[{index}]: pixels (n, 2) and points (n, 3) expected, "
                f"got {view.pixels.shape} and {view.points.shape}"
            )
    views = [_without_infinity(view) for view in views]
    pixels = np.concatenate([np.empty((0, 2)), *(view.pixels for view in views)])
    points = np.concatenate([np.empty((0, 3)), *(view.points for view in views)])
    return _Stacked(
        views,
        pixels,
        points,
        np.repeat(np.arange(len(views)), [len(view) for view in views]),
        np.isfinite(pixels).all(axis=1) & np.isfinite(points).all(axis=1),
        [_rigid(view.cam_from_rig) for view in views],
        [colmap_camera(view.camera) for view in views],
    )


def _without_infinity(view: MatchedView) -> MatchedView:
    """NaN for infinity: both are no inlier, but arithmetic with the latter warns."""
    pixels, points = (np.where(np.isfinite(a), a, np.nan) for a in (view.pixels, view.points))
    return MatchedView(view.camera, view.cam_from_rig, pixels, points)


def _search(stacked: _Stacked, max_error_px: float, seed: int) -> list[Pose]:
    """The best pose by RANSAC, or none."""
    options = pycolmap.RANSACOptions()  # those that the call has by default are refused by it
    options.max_error = max_error_px
    options.confidence = _CONFIDENCE
    options.min_num_trials = _MIN_TRIALS
    options.max_num_trials = MAX_TRIALS
    options.random_seed = seed
    finite = stacked.finite
    solved = pycolmap.estimate_generalized_absolute_pose(
        stacked.pixels[finite],
        stacked.points[finite],
        stacked.camera_of[finite].tolist(),
        stacked.cams_from_rig,
        stacked.cameras,
        options,
    )
    return [] if solved is None else [pose_from_colmap(solved["rig_from_world"])]


def _refine(
    stacked: _Stacked, start: Pose, max_error_px: float, max_rounds: int
) -> tuple[Pose, NDArray[np.bool_]] | None:
    """The refined pose and its inliers (n,)."""
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.loss_function_scale = LOSS_SCALE_PX
    pose = start
    inliers = stacked.inliers(pose, max_error_px)
    for _ in range(max_rounds):
        if np.count_nonzero(inliers) < _MIN_POINTS:
            return None
        solved = pycolmap.refine_generalized_absolute_pose(
            _rigid(pose),
            stacked.pixels,
            stacked.points,
            inliers,
            stacked.camera_of.tolist(),
            stacked.cams_from_rig,
            stacked.cameras,
            options,
        )
        if solved is None:
            return None
        pose = pose_from_colmap(solved["rig_from_world"])
        before, inliers = inliers, stacked.inliers(pose, max_error_px)
        if np.count_nonzero(inliers != before) <= _SETTLED * np.count_nonzero(inliers):
            break
    return (pose, inliers) if np.count_nonzero(inliers) >= _MIN_POINTS else None


def _judged(
    views: Sequence[MatchedView], refined: tuple[Pose, NDArray[np.bool_]]
) -> GeneralizedPose:
    """Add the covariance, and give each view its inliers."""
    pose, inliers = refined
    ends = np.cumsum([len(view) for view in views])
    masks = tuple(np.split(inliers, ends[:-1]))
    kept = [
        MatchedView(view.camera, view.cam_from_rig, view.pixels[mask], view.points[mask])
        for view, mask in zip(views, masks, strict=True)
    ]
    return GeneralizedPose(pose, masks, pose_covariance(kept, pose, LOSS_SCALE_PX))


def _rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
