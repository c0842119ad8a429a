"""The poses of a chain of instants, from everything that is known about them at once.

Three kinds of facts: poses that were measured before, motions between neighbours, and pixels that
see points of the map. Levenberg-Marquardt on all poses together; a chain of 60 has 360 unknowns,
for which dense matrices are fast enough and say what they do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.motion import UncertainPose, adjoint, difference, moved
from visloc.pose.reprojection import MatchedView, has_derivative, linearized

_MAX_STEPS = 30
# In units of chi-square: less moves nothing by a hundredth of its standard deviation.
_CONVERGED = 1e-4
_MIN_DAMPING = 1e-6
_REJECTED_DAMPING = 1e-2  # at least, after a step that went too far
_MAX_DAMPING = 1e6
_MIN_SCALE_PX2 = 1e-6
# Smallest eigenvalue of the unit-free information matrix, of diagonal 1.
_MIN_INFORMATION = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """What is known of N instants in a row.

    Attributes:
        links: N - 1 motions, from instant i to i + 1.
        measured: poses that were measured before, by instant.
        seen: the inliers of views that take part with their pixels, by instant; not of instants
            in ``measured``, which would count twice.
    """

    links: Sequence[UncertainPose]
    measured: Mapping[int, UncertainPose]
    seen: Mapping[int, Sequence[MatchedView]]


def solve_chain(
    chain: Chain, start: Sequence[Pose], loss_scale_px: float, error_scale_px2: float
) -> tuple[list[Pose], list[NDArray[np.float64]]] | None:
    """The most likely poses, and the covariance (6, 6) of each as in ``UncertainPose``.

    Args:
        chain: what is known.
        start: N poses to begin with, close enough for the inliers to be inliers.
        loss_scale_px: scale c of the Cauchy loss c^2 / 2 log(1 + r^2 / c^2) of a pixel's error.
        error_scale_px2: what to divide that loss by, so that pixels count as much as they are
            worth beside motions and measured poses; see ``error_scale``.

    Returns:
        None when what is known leaves the poses undetermined.
    """
    poses = list(start)
    now = _linearized(chain, poses, loss_scale_px, error_scale_px2)
    if not _determined(now.information):
        return None
    damping = _MIN_DAMPING
    for _ in range(_MAX_STEPS):
        damped = now.information + damping * np.diag(np.diag(now.information))
        step = np.asarray(-np.linalg.solve(damped, now.slope), dtype=np.float64).reshape(-1, 6)
        tried = [moved(pose, change) for pose, change in zip(poses, step, strict=True)]
        then = _linearized(chain, tried, loss_scale_px, error_scale_px2)
        gain = now.cost - then.cost
        if gain >= 0:
            poses, now = tried, then
            damping = max(damping / 10.0, _MIN_DAMPING)
        else:
            damping = max(10.0 * damping, _REJECTED_DAMPING)
        if 0 <= gain < _CONVERGED or damping > _MAX_DAMPING:
            break
    if not _determined(now.information):
        return None
    units = np.sqrt(np.diag(now.information))
    covariance = np.linalg.inv(now.information / np.outer(units, units)) / np.outer(units, units)
    return poses, [covariance[i : i + 6, i : i + 6] for i in range(0, len(covariance), 6)]


def _determined(information: NDArray[np.float64]) -> bool:
    units = np.sqrt(np.diag(information))
    if not (np.isfinite(information).all() and (units > 0).all()):
        return False
    return bool(np.linalg.eigvalsh(information / np.outer(units, units))[0] > _MIN_INFORMATION)


def error_scale(
    chain: Chain,
    poses: Sequence[Pose],
    covariances: Sequence[NDArray[np.float64]] | None,
    loss_scale_px: float,
    error_scale_px2: float,
) -> float:
    """The variance of the pixels' errors, pooled over the chain, for an M-estimator.

    Huber's estimate (Huber 1981, section 7.6), as in ``visloc.pose.covariance``: with psi the
    weighted errors and k the mean slope of psi, a pose from pixels alone has the covariance
    s / k^2 (J^T J)^-1, s = sum(psi^2) / (n - p). The loss divided by s / k has just that
    curvature at its optimum. p, the parameters that the pixels determine, is the trace of their
    information times the covariance: where motions are good, far less than six per instant.

    Args:
        covariances: of the poses; None before there are any, when p is taken as 6.
        error_scale_px2: with which ``covariances`` were computed.
    """
    squares, slopes, used, count = 0.0, 0.0, 0.0, 0
    for i, views in chain.seen.items():
        pixels = _pixel_terms(views, poses[i], loss_scale_px)
        squares += pixels.psi_squared
        slopes += pixels.slope * pixels.count
        count += pixels.count
        if covariances is not None:
            information = pixels.outer * pixels.slope / error_scale_px2
            used += float(np.sum(information * covariances[i]))
    if count == 0:
        return 1.0
    # Two less than there are: few errors may look small by chance, and an expected squared error,
    # normalized by such an estimate, is spare / (spare - 2) times too large (as for Student's t).
    spare = max(2 * count - (used if covariances is not None else 6.0) - 2.0, 1.0)
    return max(squares / spare / (slopes / count), _MIN_SCALE_PX2)


@dataclass(frozen=True, slots=True, eq=False)
class _PixelTerms:
    """The pixels of one instant, summed up: r errors (px), J their derivatives by the pose.

    Attributes:
        count: of pixels whose errors have a derivative; all but ``loss`` is of these.
        loss: sum of c^2 / 2 log(1 + r^2 / c^2).
        gradient: (6,) its derivative.
        outer: (6, 6) J^T J.
        slope: mean derivative of psi(r), the weighted error, by r.
        psi_squared: sum of psi(r)^2.
    """

    count: int
    loss: float
    gradient: NDArray[np.float64]
    outer: NDArray[np.float64]
    slope: float
    psi_squared: float


def _pixel_terms(
    views: Sequence[MatchedView], rig_from_world: Pose, loss_scale_px: float
) -> _PixelTerms:
    error, jacobian = linearized(views, rig_from_world, about=np.zeros(3))
    # A step too far puts points behind the camera, where there is no error to speak of: infinite.
    squared = np.sum(error**2, axis=1) / loss_scale_px**2
    loss = float(np.nan_to_num(0.5 * loss_scale_px**2 * np.log1p(squared), nan=np.inf).sum())
    known = has_derivative(error, jacobian)
    error, jacobian = error[known], jacobian[known]
    weight = 1.0 / (1.0 + squared[known])
    psi = weight[:, None] * error
    return _PixelTerms(
        count=len(error),
        loss=loss,
        gradient=np.einsum("nai,na->i", jacobian, psi),
        outer=np.einsum("nai,naj->ij", jacobian, jacobian),
        # Half the trace of the derivative of psi in two axes.
        slope=float(np.sum(weight**2)) / max(len(error), 1),
        psi_squared=float(np.sum(psi**2)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Linearized:
    """Half of chi-square, its second derivative (6 N, 6 N) and its first (6 N,) by all (w, dt)."""

    cost: float
    information: NDArray[np.float64]
    slope: NDArray[np.float64]


def _linearized(
    chain: Chain, poses: Sequence[Pose], loss_scale_px: float, error_scale_px2: float
) -> _Linearized:
    cost = 0.0
    information = np.zeros((6 * len(poses), 6 * len(poses)))
    slope = np.zeros(6 * len(poses))
    for i, known in chain.measured.items():
        here = slice(6 * i, 6 * i + 6)
        error = difference(poses[i], known.pose)
        weight = np.linalg.inv(known.covariance)
        cost += 0.5 * float(error @ weight @ error)
        information[here, here] += weight
        slope[here] += weight @ error
    for i, link in enumerate(chain.links):
        both = slice(6 * i, 6 * i + 12)
        motion = poses[i + 1] @ poses[i].inverse()
        error = difference(motion, link.pose)
        # Errors are small: their own rotation is left out of the derivatives.
        jacobian = np.hstack([-adjoint(motion), np.eye(6)])
        weight = np.linalg.inv(link.covariance)
        cost += 0.5 * float(error @ weight @ error)
        information[both, both] += jacobian.T @ weight @ jacobian
        slope[both] += jacobian.T @ weight @ error
    for i, views in chain.seen.items():
        here = slice(6 * i, 6 * i + 6)
        pixels = _pixel_terms(views, poses[i], loss_scale_px)
        cost += pixels.loss / error_scale_px2
        information[here, here] += pixels.outer * (pixels.slope / error_scale_px2)
        slope[here] += pixels.gradient / error_scale_px2
    return _Linearized(cost, information, slope)
