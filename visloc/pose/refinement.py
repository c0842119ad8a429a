"""From a pose that is nearly right to the best one near it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.motion import moved
from visloc.pose.reprojection import MatchedView, has_derivative, linearized, reprojection_errors

# Scale of the Cauchy loss. Landmarks from depth maps scatter by a few pixels.
LOSS_SCALE_PX = 3.0
MIN_INLIERS = 4
_MAX_STEPS = 30
# In units of chi-square: less moves nothing by a hundredth of its standard deviation.
_CONVERGED = 1e-4
_MIN_LOSS_PX2 = 1e-12
_MIN_DAMPING = 1e-6
_REJECTED_DAMPING = 1e-2  # at least, after a step that went too far
_MAX_DAMPING = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class RefinedPose:
    """A pose and what it explains.

    Attributes:
        rig_from_world: in the frame of the views' points.
        zoom: the focal length in units of the view's; 1 where that is known.
        inliers: (n,) bool for each view, reprojection error within the threshold.
        loss: sum over all correspondences, in px^2.
        mean_loss: of an inlier, in px^2.
    """

    rig_from_world: Pose
    zoom: float
    inliers: tuple[NDArray[np.bool_], ...]
    loss: float
    mean_loss: float

    @property
    def num_inliers(self) -> int:
        """Inliers of all views."""
        return sum(int(np.count_nonzero(mask)) for mask in self.inliers)


def refine(
    views: Sequence[MatchedView],
    start: Pose,
    *,
    max_error_px: float,
    max_steps: int = _MAX_STEPS,
) -> RefinedPose | None:
    """Minimize a robust reprojection error over the pose of a rig, and an unknown focal length.

    The loss of an error r is the Cauchy loss c^2 / 2 log(1 + r^2 / c^2), and constant beyond the
    largest error of an inlier: inliers are chosen anew in every step, and those of the result are
    the ones that it was found with. Levenberg-Marquardt; the second derivative of the loss is
    taken as its mean over both axes of the image, which converges nearly as Newton's method and,
    unlike it, has no direction of negative curvature.

    The same bits come out however many threads the linear algebra has.

    Args:
        views: what each camera sees; some may have no correspondences. Where the focal length is
            unknown, it is refined with the pose.
        max_error_px: largest reprojection error of an inlier, in each camera's pixels.
        max_steps: evaluations of the loss, when the caller can do with less than convergence.

    Returns:
        The pose, or None when fewer than four correspondences are inliers, or all but three of
        the inliers lie at the very edge of what their cameras see, where errors have no derivative.
    """
    best = _explained(views, start, 1.0, max_error_px)
    normal = None
    damping = _MIN_DAMPING
    for _ in range(max_steps):
        if best.num_inliers < MIN_INLIERS:
            return None
        if normal is None:
            normal = _normal_equations(views, best)
        if normal is None:
            return None
        information, gradient = normal
        # In units that make the diagonal 1; directions without any information stay put.
        units = np.sqrt(np.diag(information))
        units[units == 0] = 1.0
        damped = information / np.outer(units, units) + damping * np.eye(len(gradient))
        step = -np.linalg.solve(damped, gradient / units) / units
        expected_gain = -0.5 * float(gradient @ step)
        enough = _CONVERGED * max(best.mean_loss, _MIN_LOSS_PX2)
        zoom = best.zoom * math.exp(np.clip(step[6:], -1.0, 1.0).sum())  # one, or none: exactly 1
        tried = _explained(views, moved(best.rig_from_world, step[:6]), zoom, max_error_px)
        if tried.loss <= best.loss:
            best, normal = tried, None
            damping = max(damping / 10.0, _MIN_DAMPING)
        else:
            damping = max(10.0 * damping, _REJECTED_DAMPING)
        if expected_gain <= enough or damping > _MAX_DAMPING:
            break
    return best if best.num_inliers >= MIN_INLIERS else None


def _explained(
    views: Sequence[MatchedView], rig_from_world: Pose, zoom: float, max_error_px: float
) -> RefinedPose:
    """A pose with its inliers and its loss."""
    views = _zoomed(views, zoom)
    errors = [reprojection_errors(view, rig_from_world) for view in views]
    # False for NaN: behind the camera.
    inliers = tuple(np.asarray(of_view <= max_error_px) for of_view in errors)
    explained = [of_view[mask] for of_view, mask in zip(errors, inliers, strict=True)]
    losses = _loss(np.concatenate([np.empty(0), *explained]))
    num_outliers = sum(len(view) for view in views) - len(losses)
    total = float(losses.sum())
    return RefinedPose(
        rig_from_world,
        zoom,
        inliers,
        loss=total + num_outliers * float(_loss(np.array(max_error_px))),
        mean_loss=total / max(len(losses), 1),
    )


def _zoomed(views: Sequence[MatchedView], zoom: float) -> Sequence[MatchedView]:
    return [view.zoomed(zoom) for view in views] if zoom != 1.0 else views


def _loss(error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Cauchy loss of errors (...) in pixels."""
    return np.asarray(0.5 * LOSS_SCALE_PX**2 * np.log1p((error / LOSS_SCALE_PX) ** 2))


def _normal_equations(
    views: Sequence[MatchedView], pose: RefinedPose
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The loss's second derivative (k, k) and its first (k,) by (w, dt) of ``moved``.

    k is six, or seven with the logarithm of an unknown focal length.

    None when fewer than four inliers have a derivative.
    """
    zoomed = _zoomed(views, pose.zoom)
    kept = [view.selected(mask) for view, mask in zip(zoomed, pose.inliers, strict=True)]
    errors, jacobian = linearized(kept, pose.rig_from_world, about=np.zeros(3))
    known = has_derivative(errors, jacobian)
    if not known.all():
        errors, jacobian = errors[known], jacobian[known]
    if len(errors) < MIN_INLIERS:
        return None
    columns = np.ascontiguousarray(errors.T)
    x, y = columns
    weight = 1.0 / (1.0 + (x * x + y * y) / LOSS_SCALE_PX**2)
    # One row per parameter, all errors in a row. einsum, not a product of matrices: the sums of
    # the latter depend on the number of threads.
    weighted = (weight * jacobian.T).reshape(-1, columns.size)
    information = np.einsum("in,jn->ij", weighted, weighted)
    return information, np.einsum("in,n->i", weighted, columns.ravel())
