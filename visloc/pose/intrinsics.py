"""Find the intrinsics that fit a photo's own matches best, to compare with the given ones.

Every camera model multiplies by the focal length at last, then adds the principal point. A change
of both is therefore an affine map of the given camera's pixels, whatever the model:
``u = c + L d + Z (u_given - c)`` with the principal point c, the longer side L and
``Z = diag(exp(a + b / 2), exp(a - b / 2))``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.motion import moved
from visloc.pose.refinement import LOSS_SCALE_PX
from visloc.pose.reprojection import MatchedView, has_derivative, linearized, reprojection_errors

# Places in a change of the intrinsics.
FOCAL, SHIFT_X, SHIFT_Y, ASPECT = range(4)
_ALL = (FOCAL, SHIFT_X, SHIFT_Y, ASPECT)
# Landmarks share errors: of depth, of poses of mapping photos, of the shutter. However many matches
# there are, they tell no more than this many independent ones
# (docs/decisions/0027-a-camera-that-is-checked.md).
_INDEPENDENT_MATCHES = 16.0
# For that reason, more inliers change little. If there are few, none may be left out, because wrong
# matches within the widest threshold outnumber them.
_MAX_INLIERS, _MAX_MATCHES = 200, 1000
_MIN_MATCHES = 10  # as many as there are parameters
# Thresholds and loss scales of the rounds, in units of the last. If the camera is wrong by a factor
# of two, most matches lie farther away than an inlier may, so the first round is wide.
_WIDTHS = (4.0, 2.0, 1.0)
_MAX_STEPS = (6, 6, 20)
_MAX_CHANGE = 0.5  # in one step
_MIN_DAMPING, _REJECTED_DAMPING, _MAX_DAMPING = 1e-6, 1e-2, 1e4
_CONVERGED = 0.02  # of chi-square
# Where the first step promises less, it is not worth taking: most photos with a right camera.
_MIN_PROMISED_GAIN = 2.0
_MIN_VARIANCE_PX2 = 1e-12
_MIN_INFORMATION = 1e-12  # least eigenvalue, with a diagonal of 1


@dataclass(frozen=True, slots=True, eq=False)
class FoundIntrinsics:
    """A change of a camera under which it explains its matches better.

    Attributes:
        change: (4,) float64: log of the factor of the focal length; shift of the principal point to
            the right and down, in longer sides of the photo; log of the factor of fx / fy. Zero
            where it was held.
        covariance: (4, 4) float64 of ``change``, with the errors that landmarks share; zero where
            it was held.
        gain: how much less the given camera explains: difference of the losses of both best poses,
            in units of chi-square, with the same errors.
        num_inliers: of the matches that were looked at.
        num_by_chance: as many of these as wrong matches have near any pose: they lie evenly around
            where they would be inliers.
    """

    change: NDArray[np.float64]
    covariance: NDArray[np.float64]
    gain: float
    num_inliers: int
    num_by_chance: float


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """A pose and a change of the camera.

    Attributes:
        errors: (n, 2) pixels, NaN behind the camera.
        jacobian: (n, 2, 6 + k) by the pose and what is free of the change.
    """

    rig_from_world: Pose
    change: NDArray[np.float64]
    errors: NDArray[np.float64]
    jacobian: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations of a state's inliers.

    Attributes:
        information: (6 + k, 6 + k) for errors of one pixel.
        gradient: (6 + k,)
        variance: px^2 of one coordinate of an error, with what landmarks share of it.
    """

    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    variance: float
    num_inliers: int


def find_intrinsics(
    view: MatchedView, rig_from_world: Pose, *, max_error_px: float
) -> tuple[FoundIntrinsics, FoundIntrinsics] | None:
    """Estimate the intrinsics of a camera together with its pose.

    The loss is the one of ``visloc.pose.refinement``. Inliers are chosen anew in every step, at
    first with a wider threshold.

    Returns:
        With the focal length free, then with the principal point and the aspect free as well. None
        where the given camera explains the matches about as well, or these are too few.
    """
    view = _near(replace(view, focal_unknown=False), rig_from_world, max_error_px)
    if len(view) < _MIN_MATCHES:
        return None
    start = _state(view, _ALL, rig_from_world, np.zeros(len(_ALL)))
    if all(_promised_gain(start, max_error_px, width) < _MIN_PROMISED_GAIN for width in _WIDTHS):
        return None
    start = replace(start, jacobian=start.jacobian[:, :, :6])
    # Other cameras of a rig may have found the pose, where this one has hardly an inlier.
    given = _minimized(view, (), start, max_error_px, _WIDTHS[-1:]) or start
    focal = _improved(view, (FOCAL,), given, max_error_px, _WIDTHS)
    whole = focal and _improved(view, _ALL, focal, max_error_px, _WIDTHS[1:])
    if focal is None or whole is None:
        return None
    given_loss = _loss(given, max_error_px)
    of_focal = _found((FOCAL,), focal, given_loss, max_error_px)
    of_all = _found(_ALL, whole, given_loss, max_error_px)
    return None if of_focal is None or of_all is None else (of_focal, of_all)


def _near(view: MatchedView, rig_from_world: Pose, max_error_px: float) -> MatchedView:
    """The matches that a changed camera may explain; of many, every so many."""
    finite = np.isfinite(np.hstack([view.pixels, view.points])).all(axis=1)
    view = view.selected(np.asarray(finite))
    errors = reprojection_errors(view, rig_from_world)
    rows = np.flatnonzero(errors <= _WIDTHS[0] * max_error_px)
    num_inliers = int(np.count_nonzero(errors <= max_error_px))
    step = max(num_inliers // _MAX_INLIERS, -(-len(rows) // _MAX_MATCHES), 1)
    return view.selected(rows[::step])


def _promised_gain(state: _State, max_error_px: float, width: float) -> float:
    """``gain`` as it would be with a quadratic loss; 0 when there are too few matches."""
    normal = _normal_equations(state, max_error_px, width)
    if normal is None:
        return 0.0
    units = np.sqrt(np.diag(normal.information))
    damped = normal.information / np.outer(units, units) + _MIN_DAMPING * np.eye(len(units))
    scaled = normal.gradient / units
    return float(scaled @ np.linalg.solve(damped, scaled)) / normal.variance


def _improved(
    view: MatchedView,
    free: Sequence[int],
    start: _State,
    max_error_px: float,
    widths: Sequence[float],
) -> _State | None:
    """The best state near the start with more parameters free."""
    start = _state(view, free, start.rig_from_world, start.change)
    found = _minimized(view, free, start, max_error_px, widths)
    if found is None or _loss(found, max_error_px) > _loss(start, max_error_px):
        # Under the wider threshold, wrong matches led astray.
        found = _minimized(view, free, start, max_error_px, _WIDTHS[-1:])
    return found


def _minimized(
    view: MatchedView,
    free: Sequence[int],
    state: _State,
    max_error_px: float,
    widths: Sequence[float],
) -> _State | None:
    """Levenberg-Marquardt over the pose and what is free, with one threshold after the other."""
    for width, max_steps in zip(widths, _MAX_STEPS[-len(widths) :], strict=True):
        damping = _MIN_DAMPING
        normal = _normal_equations(state, max_error_px, width)
        loss = _loss(state, max_error_px, width)
        for _ in range(max_steps):
            if normal is None:
                return None
            units = np.sqrt(np.diag(normal.information))
            damped = normal.information / np.outer(units, units) + damping * np.eye(len(units))
            step = -np.linalg.solve(damped, normal.gradient / units) / units
            change = state.change.copy()
            change[list(free)] += np.clip(step[6:], -_MAX_CHANGE, _MAX_CHANGE)
            tried = _state(view, free, moved(state.rig_from_world, step[:6]), change)
            enough = _CONVERGED * normal.variance
            gain = -0.5 * float(normal.gradient @ step)
            tried_loss = _loss(tried, max_error_px, width)
            if tried_loss <= loss:
                state, loss, damping = tried, tried_loss, max(damping / 10.0, _MIN_DAMPING)
                normal = _normal_equations(state, max_error_px, width)
            else:
                damping = max(10.0 * damping, _REJECTED_DAMPING)
            if gain <= enough or damping > _MAX_DAMPING:
                break
    return state


def _state(
    view: MatchedView, free: Sequence[int], rig_from_world: Pose, change: NDArray[np.float64]
) -> _State:
    errors, by_pose = linearized([view], rig_from_world, about=np.zeros(3))
    longer_side, centre = max(view.camera.width, view.camera.height), view.principal_point
    half = np.array([0.5, -0.5])
    zoom = np.exp(change[FOCAL] + change[ASPECT] * half)
    from_centre = (errors + view.pixels - centre) * zoom
    rows = np.empty((6 + len(free), 2, len(view)))
    np.multiply(by_pose.T, zoom[:, None], out=rows[:6])
    for row, name in zip(rows[6:], free, strict=True):
        if name == FOCAL:
            row[:] = from_centre.T
        elif name == ASPECT:
            row[:] = from_centre.T * half[:, None]
        else:
            row[:] = 0.0
            row[0 if name == SHIFT_X else 1] = longer_side
    return _State(
        rig_from_world,
        change,
        from_centre + centre + longer_side * change[[SHIFT_X, SHIFT_Y]] - view.pixels,
        rows.T,
    )


def _loss(state: _State, max_error_px: float, width: float = 1.0) -> float:
    """Return the loss of all matches, px^2; constant beyond the threshold and behind the camera."""
    squared = np.sum(state.errors**2, axis=1)
    largest, scale2 = (width * max_error_px) ** 2, (width * LOSS_SCALE_PX) ** 2
    squared = np.where(squared <= largest, squared, largest)  # NaN too
    return float(0.5 * scale2 * np.log1p(squared / scale2).sum())


def _normal_equations(state: _State, max_error_px: float, width: float = 1.0) -> _Normal | None:
    """None when fewer matches than parameters are inliers, or say nothing of one of these."""
    squared = np.sum(state.errors**2, axis=1)
    inliers = (squared <= (width * max_error_px) ** 2) & has_derivative(
        state.errors, state.jacobian
    )
    num_parameters = state.jacobian.shape[2]
    num_inliers = int(np.count_nonzero(inliers))
    if num_inliers < num_parameters:
        return None
    weight = 1.0 / (1.0 + squared[inliers] / (width * LOSS_SCALE_PX) ** 2)
    root = np.sqrt(weight)
    # One row per parameter. einsum, as in ``visloc.pose.refinement``: the bits of a product of
    # matrices depend on the number of threads.
    columns = (root * state.jacobian.T[:, :, inliers]).reshape(num_parameters, -1)
    weighted = (root * state.errors.T[:, inliers]).ravel()
    information = np.einsum("in,jn->ij", columns, columns)
    if not (np.diag(information) > 0).all():
        return None
    total = float(weight.sum())
    of_one = float(weighted @ weighted) / (2.0 * total)
    return _Normal(
        information,
        np.einsum("in,n->i", columns, weighted),
        max(of_one, _MIN_VARIANCE_PX2) * (1.0 + total / _INDEPENDENT_MATCHES),
        num_inliers,
    )


def _found(
    free: Sequence[int], found: _State, given_loss: float, max_error_px: float
) -> FoundIntrinsics | None:
    normal = _normal_equations(found, max_error_px)
    if normal is None:
        return None
    units = np.sqrt(np.diag(normal.information))
    scaled = normal.information / np.outer(units, units)
    if np.linalg.eigvalsh(scaled)[0] < _MIN_INFORMATION:
        return None
    inverse = np.linalg.inv(scaled) / np.outer(units, units)
    covariance = np.zeros((len(_ALL), len(_ALL)))
    covariance[np.ix_(free, free)] = normal.variance * inverse[6:, 6:]
    gain = 2.0 * (given_loss - _loss(found, max_error_px)) / normal.variance
    ring = np.sum(np.hypot(*found.errors.T) <= _WIDTHS[0] * max_error_px) - normal.num_inliers
    by_chance = max(float(ring), 0.0) / (_WIDTHS[0] ** 2 - 1.0)  # of the areas
    return FoundIntrinsics(found.change, covariance, gain, normal.num_inliers, by_chance)
