"""The pose of a rig from the 2D-3D correspondences of all its cameras.

A photo on its own is a rig of one camera at the identity: the same code. pycolmap's estimator for
one camera finds the same inliers, and is not more accurate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose
from visloc.options import Solver
from visloc.pose.covariance import pose_covariance
from visloc.pose.gravity import KnownGravity, find_upright_poses
from visloc.pose.refinement import LOSS_SCALE_PX, RefinedPose, refine
from visloc.pose.registration import REGISTRATION_LOSS_SCALE_PX, register
from visloc.pose.reprojection import MatchedView
from visloc.pose.search import (
    search_with_focal_length,
    search_with_poselib,
    search_with_pycolmap,
)

# Focal lengths in units of the longer side, from 136 degrees across to 6: all usual lenses. Poses
# with others explain wrong matches, such as those in a spot or in a flat picture.
MIN_FOCAL, MAX_FOCAL = 0.2, 10.0
# Steps of refinement that tell which of several poses is the best.
_STEPS_TO_COMPARE = 5
# For a plane nearly parallel to the image, focal length and distance form a narrow valley. Thirty
# steps would end in it, a dozen stated standard deviations from its lowest point.
_STEPS_WITH_FOCAL = 300


@dataclass(frozen=True, slots=True, eq=False)
class GeneralizedPose:
    """A refined pose of a rig and what supports it.

    Attributes:
        rig_from_world: in the frame of the points that were given.
        inliers: (n,) bool for each view, reprojection error within the threshold under this pose.
        covariance: (6, 6) of ``rig_from_world``, rotation (rad) then translation, for
            R <- Exp(w) R and t <- t + dt; None when the inliers leave the pose undetermined
            (collinear points, for one).
        camera: with the focal length that was found together with the pose; None where it was
            known.
        probability: that it is right, 0 to 1; None when it was not judged.
        of_camera: (6, 6), the part of ``covariance`` that errors of the cameras add, or at first
            that of an unknown principal point; None where there is none.
    """

    rig_from_world: Pose
    inliers: tuple[NDArray[np.bool_], ...]
    covariance: NDArray[np.float64] | None
    camera: Camera | None = None
    probability: float | None = None
    of_camera: NDArray[np.float64] | None = None

    @property
    def num_inliers(self) -> int:
        """Inliers of all views."""
        return sum(int(mask.sum()) for mask in self.inliers)


# Of views, with max_error_px and seed.
PoseSolver = Callable[[Sequence[MatchedView], float, int], GeneralizedPose | None]


def estimate_generalized_pose(
    views: Sequence[MatchedView],
    *,
    max_error_px: float,
    seed: int,
    gravity: KnownGravity | None = None,
    solver: Solver = Solver.PYCOLMAP,
) -> GeneralizedPose | None:
    """Solve for the pose of a rig and refine it on the inliers of all its cameras.

    What is known decides how the pose is searched for:

    - Neither of the cases below: by ``solver``. ``pycolmap`` and ``poselib`` are LO-RANSAC with
      P3P or GP3P over at most 1000 correspondences, so poses that explain less than about 4 % are
      not searched for. Their refinement is the same. ``registration`` has a search and a
      refinement of its own (``visloc.pose.registration``).
    - Gravity is known: RANSAC with two correspondences (``visloc.pose.gravity``), whatever the
      solver. Gravity only guides the search; the refinement leaves all six degrees of freedom.
    - The focal length is unknown: pycolmap's LO-RANSAC with P4Pf and P3P, whatever the solver,
      without gravity. The refinement finds the focal length too.

    Args:
        views: what each camera sees; some may have no correspondences.
        max_error_px: largest reprojection error of an inlier, in each camera's pixels.
        gravity: when it is known which way is down.

    Returns:
        The pose. None if there are fewer than four correspondences, if no pose explains four, or
        if no camera has such a focal length. The solver finds a pose in almost anything, so the
        caller must judge the inliers and, with gravity, ``gravity_deviation``.
    """
    checked = _checked(views)
    if any(view.focal_unknown for view in checked):
        return _with_focal_length(checked, max_error_px, seed)
    if gravity is None:
        return SOLVERS[solver](checked, max_error_px, seed)
    starts = find_upright_poses(checked, gravity, max_error_px=max_error_px, seed=seed)
    return _best_refined(checked, starts, max_error_px)


def refine_generalized_pose(
    views: Sequence[MatchedView], rig_from_world: Pose, *, max_error_px: float
) -> GeneralizedPose | None:
    """Refine the pose of a rig on its inliers, those of the refined pose again.

    Args:
        views: what each camera sees; some may have no correspondences.
        rig_from_world: where to start. An unknown focal length starts with the view's.
        max_error_px: largest reprojection error of an inlier, in each camera's pixels.

    Returns:
        The pose. None if fewer than four correspondences are inliers of the start or of the
        refined pose, or if no camera has such a focal length.
    """
    return _best_refined(_checked(views), [rig_from_world], max_error_px)


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


def _search_and_refine(
    search: Callable[..., list[Pose]],
    views: Sequence[MatchedView],
    max_error_px: float,
    seed: int,
) -> GeneralizedPose | None:
    starts = search(views, max_error_px=max_error_px, seed=seed)
    return _best_refined(views, starts, max_error_px)


def _register(
    views: Sequence[MatchedView], max_error_px: float, seed: int
) -> GeneralizedPose | None:
    if len(views) != 1:
        raise ValueError(f"{len(views)} views for a solver of one")
    found = register(views[0], max_error_px=max_error_px, seed=seed)
    if found is None:
        return None
    pose, inliers = found
    kept = [views[0].selected(inliers)]
    covariance = pose_covariance(kept, pose, REGISTRATION_LOSS_SCALE_PX)
    whole = None if covariance is None else covariance.whole
    return GeneralizedPose(pose, (inliers,), whole)


SOLVERS: Mapping[Solver, PoseSolver] = {
    Solver.PYCOLMAP: partial(_search_and_refine, search_with_pycolmap),
    Solver.POSELIB: partial(_search_and_refine, search_with_poselib),
    Solver.REGISTRATION: _register,
}


def _with_focal_length(
    views: Sequence[MatchedView], max_error_px: float, seed: int
) -> GeneralizedPose | None:
    if len(views) != 1:
        raise ValueError(f"{len(views)} views, one of unknown focal length")
    tried = []
    for camera, start in search_with_focal_length(views[0], max_error_px=max_error_px, seed=seed):
        if _is_usable(camera):
            seen = [replace(views[0], camera=camera)]
            pose = refine(seen, start, max_error_px=max_error_px)
            if pose is not None:
                tried.append((seen, pose))
    if not tried:
        return None
    seen, pose = min(tried, key=lambda each: each[1].loss)
    seen = [view.zoomed(pose.zoom) for view in seen]
    best = refine(seen, pose.rig_from_world, max_error_px=max_error_px, max_steps=_STEPS_WITH_FOCAL)
    return None if best is None else _judged(seen, best)


def _is_usable(camera: Camera) -> bool:
    """Tell whether a lens may have the focal length that was found with a pose."""
    longer_side = max(camera.width, camera.height)
    return MIN_FOCAL <= camera.focal_length / longer_side <= MAX_FOCAL


def _best_refined(
    views: Sequence[MatchedView], starts: Sequence[Pose], max_error_px: float
) -> GeneralizedPose | None:
    """Return the pose that explains most, of those that the starts lead to."""
    if len(starts) > 1:
        tried = [
            refine(views, start, max_error_px=max_error_px, max_steps=_STEPS_TO_COMPARE)
            for start in starts
        ]
        found = [pose for pose in tried if pose is not None]
        starts = [max(found, key=lambda pose: pose.num_inliers).rig_from_world] if found else []
    best = refine(views, starts[0], max_error_px=max_error_px) if starts else None
    return None if best is None else _judged(views, best)


def _judged(views: Sequence[MatchedView], best: RefinedPose) -> GeneralizedPose | None:
    """Add the covariance, and the camera whose focal length was found, unless there is no such."""
    camera = None
    if any(view.focal_unknown for view in views):
        views = [view.zoomed(best.zoom) for view in views]
        camera = views[0].camera
        if not _is_usable(camera):
            return None
    kept = [view.selected(mask) for view, mask in zip(views, best.inliers, strict=True)]
    covariance = pose_covariance(kept, best.rig_from_world, LOSS_SCALE_PX)
    if covariance is None:
        return GeneralizedPose(best.rig_from_world, best.inliers, None, camera)
    return GeneralizedPose(
        best.rig_from_world, best.inliers, covariance.whole, camera, of_camera=covariance.of_camera
    )
