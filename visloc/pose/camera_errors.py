"""What is known of a camera has an error: the photo has its say, and the pose carries the rest.

Beside the pose, the matches of a photo tell by how much its camera is off:

- the focal length, the principal point, and the radial distortion beyond that of its model:
  ``u = c + L d + exp(a) (1 + k r^2) (u_given - c)`` with the principal point c, the longer side L
  and the distance r of a ray from the optical axis at depth 1;
- the shutter: rows are read one after another, while the camera moves. The pose is that of the
  middle row.

Each part has a normal prior. Most cameras are right, and some are off in one part. So the standard
deviation of each prior is found as well, between that of a right camera and that of a wrong one
(automatic relevance determination: MacKay, "Bayesian interpolation", 1992). A part of which the
photo says nothing stays as it is known.

Landmarks share errors, which no number of matches averages out. So matches count less, as the map's
own test found poses to be further off than the scatter of matches tells
(``visloc.pose.map_errors``), and as matches near each other err alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import CAMERA_MODELS, Camera, Pose, cross_matrix
from visloc.pose.motion import moved
from visloc.pose.refinement import LOSS_SCALE_PX
from visloc.pose.reprojection import has_derivative, linearized, reprojection_errors
from visloc.pose.views import MatchedView
from visloc.types import CameraSource

FOCAL, SHIFT_X, SHIFT_Y, RADIAL = range(4)
_SHUTTER = slice(4, 10)
_PARTS = 10
# Each has a prior of its own, but both coordinates of the principal point share one.
_FIRSTS = np.array([FOCAL, SHIFT_X, RADIAL, *range(4, 10)])
_SIZES = np.array([1, 2, *[1] * 7])
# Standard deviations with which a photo says that a part is off: from the second on it is
# corrected, between both the pose only becomes as uncertain.
_MAYBE, _SURE = 1.0, 2.5
# Changes that are so many of the widest prior's deviations are no error of a camera.
_MOST = 2.5
_LEAST_INLIERS = 30
# The longer side is divided into so many cells; matches of one err alike.
_CELLS = 8
# No photo tells of less.
_RIGHT = 0.001
# Thresholds and loss scales of the rounds, in units of the last. With a wrong camera, matches lie
# farther away than an inlier may.
_WIDTHS = (2.0, 1.0, 1.0, 1.0, 1.0)
_MOST_UPDATES, _CONVERGED = 30, 0.02
_MIN_VARIANCE_PX2, _LEAST_DEPTH = 1e-8, 1e-9
# The models that have a first radial coefficient, and the name of that.
_RADIAL_OF = {"SIMPLE_RADIAL": "k", "RADIAL": "k1", "OPENCV": "k1", "FULL_OPENCV": "k1"}
_WITH_RADIAL = {"SIMPLE_PINHOLE": "SIMPLE_RADIAL", "PINHOLE": "OPENCV"}


@dataclass(frozen=True, slots=True)
class CameraPrior:
    """Standard deviations of a camera's errors.

    Attributes:
        right: of a camera that is as it should be: of the focal length (relative), the principal
            point (longer sides), the radial distortion (coefficient of r^2), and of the shutter
            (motion over all rows: radians, and median depths).
        wrong: of one that is off.
    """

    right: tuple[float, float, float, float]
    wrong: tuple[float, float, float, float]


_GIVEN = CameraPrior((0.0003, 0.0003, 0.001, 0.0003), (0.05, 0.03, 0.1, 0.03))
# EXIF rounds to whole millimetres, lenses breathe, and phones stabilize.
_EXIF = CameraPrior((0.03, 0.01, 0.01, 0.0003), (0.05, 0.03, 0.2, 0.03))
_ESTIMATED = CameraPrior((0.3, 0.01, 0.01, 0.0003), (0.5, 0.03, 0.2, 0.03))
PRIORS = {
    CameraSource.GIVEN: _GIVEN,
    CameraSource.GIVEN_SCALED: _GIVEN,
    CameraSource.MAP: _GIVEN,
    CameraSource.EXIF: _EXIF,
    CameraSource.GUESS: _ESTIMATED,
    CameraSource.ESTIMATED: _ESTIMATED,
}


@dataclass(frozen=True, slots=True, eq=False)
class CameraErrors:
    """A rig's pose with cameras that may be off.

    Attributes:
        rig_from_world: with the cameras corrected.
        views: with corrected cameras, and the pixels that a global shutter would have seen.
        corrected: whether any view was.
        of_camera: (6, 6), what is left of the cameras' errors in ``rig_from_world``, rotation (rad)
            then translation, for R <- Exp(w) R and t <- t + dt.
    """

    rig_from_world: Pose
    views: tuple[MatchedView, ...]
    corrected: bool
    of_camera: NDArray[np.float64]


def find_camera_errors(
    views: Sequence[MatchedView],
    priors: Sequence[CameraPrior],
    rig_from_world: Pose,
    *,
    max_error_px: float,
    factor: float,
) -> CameraErrors | None:
    """Find by how much the cameras of a rig are off, together with its pose.

    Args:
        views: what each camera sees, with all its matches; some may have none.
        priors: of the camera of each view.
        rig_from_world: the best pose with the cameras as they are.
        max_error_px: largest reprojection error of an inlier.
        factor: by how much poses in the map are further off than the scatter of matches tells.

    Returns:
        None when there are too few inliers to tell anything.
    """
    used = [row for row, view in enumerate(views) if len(view)]
    if not used:
        return None
    seen = [_near(views[row], rig_from_world, max_error_px) for row in used]
    both = [_deviations(views[row], priors[row]) for row in used]
    right, wrong = map(np.concatenate, zip(*both, strict=True))
    pose, change = rig_from_world, np.zeros(len(right))
    for width in _WIDTHS:
        normal = _normal_equations(seen, pose, change, wrong, width, max_error_px, factor)
        if normal is None:
            return None
        found = _relevant(normal, change, right, wrong)
        if width == 1.0 and not found.off.any() and (right <= _RIGHT).all():
            pose, change = rig_from_world, np.zeros(len(right))
            break  # as most given cameras are
        pose, change = moved(pose, found.step), found.change
    assert normal is not None
    by_camera = -np.linalg.solve(normal.information[:6, :6], normal.information[:6, 6:])
    additive = np.eye(6)
    additive[3:, :3] = -cross_matrix(pose.translation)
    by_camera = additive @ by_camera
    of_camera = by_camera @ found.covariance @ by_camera.T
    corrected = list(views)
    if change.any():
        for row, parts in zip(used, change.reshape(-1, _PARTS), strict=True):
            corrected[row] = _corrected(views[row], pose, parts)
    of_camera = (of_camera + of_camera.T) / 2
    return CameraErrors(pose, tuple(corrected), bool(change.any()), of_camera)


def _deviations(
    view: MatchedView, prior: CameraPrior
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the standard deviations (10,) of a right camera, and of a wrong one."""
    both = []
    for focal, centre, radial, shutter in (prior.right, prior.wrong):
        if view.camera.model not in {*_RADIAL_OF, *_WITH_RADIAL}:
            radial = prior.right[RADIAL - 1] * 1e-3
        both.append(np.array([focal, centre, centre, radial, *[shutter] * 6]))
    return both[0], both[1]


def _near(view: MatchedView, rig_from_world: Pose, max_error_px: float) -> MatchedView:
    """The matches that a corrected camera may explain."""
    view = replace(view, focal_unknown=False)
    with np.errstate(invalid="ignore"):  # landmarks that are no numbers
        near = reprojection_errors(view, rig_from_world) <= 4.0 * max_error_px
    return view.selected(near)


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations of inliers, by the pose and the change of the cameras, in (n) errors.

    Attributes:
        information: (k, k), with the errors that landmarks share.
        gradient: (k,)
    """

    information: NDArray[np.float64]
    gradient: NDArray[np.float64]


def _normal_equations(
    views: Sequence[MatchedView],
    pose: Pose,
    change: NDArray[np.float64],
    wrong: NDArray[np.float64],
    width: float,
    max_error_px: float,
    factor: float,
) -> _Normal | None:
    """Return the equations of all views at a pose and a change of their cameras.

    None when there are few inliers.
    """
    size = 6 + len(change)
    errors, rows, cells = [np.empty((0, 2))], [np.empty((size, 2, 0))], [np.empty(0, np.int64)]
    for number, (view, parts) in enumerate(zip(views, change.reshape(-1, _PARTS), strict=True)):
        of_view, by_pose, by_part = _linearized(view, pose, parts)
        inliers = np.hypot(*of_view.T) <= width * max_error_px
        of_all = np.zeros((size, 2, int(inliers.sum())))
        of_all[:6] = by_pose[:, :, inliers]
        of_all[6 + _PARTS * number :][:_PARTS] = by_part[:, :, inliers]
        errors.append(of_view[inliers])
        rows.append(of_all)
        side = max(view.camera.width, view.camera.height) / _CELLS
        column, row = np.clip(view.pixels[inliers] // side, 0, _CELLS).astype(np.int64).T
        cells.append((number * (_CELLS + 1) + row) * (_CELLS + 1) + column)
    error, by_all = np.concatenate(errors), np.concatenate(rows, axis=2)
    if len(error) < max(_LEAST_INLIERS, size):
        return None
    squared = np.sum(error**2, axis=1)
    weight = 1.0 / (1.0 + squared / (width * LOSS_SCALE_PX) ** 2)
    # einsum, as in ``visloc.pose.refinement``: the bits of a product of matrices depend on the
    # number of threads.
    columns = (np.sqrt(weight) * by_all).reshape(size, -1)
    information = np.einsum("in,jn->ij", columns, columns)
    variance = max(float(weight @ squared) / (2.0 * float(weight.sum())), _MIN_VARIANCE_PX2)
    weighted = weight * by_all
    gradient = np.einsum("ian,na->i", weighted, error)
    # As they are where the cameras are free.
    free = np.linalg.inv(information + _inverse_variances(wrong, variance))
    error = error - np.einsum("ian,i->na", by_all, free @ gradient)
    each = np.einsum("ian,na->ni", weighted, error)
    shared = _shared(information, free, each, np.concatenate(cells), variance)
    variance *= factor**2 * shared
    return _Normal(information / variance, gradient / variance)


def _inverse_variances(stds: NDArray[np.float64], scale: float = 1.0) -> NDArray[np.float64]:
    """Return the information (k, k) of priors of the cameras' parts; the pose has none."""
    return np.diag(np.concatenate([np.zeros(6), scale / stds**2]))


def _shared(
    information: NDArray[np.float64],
    free: NDArray[np.float64],
    gradients: NDArray[np.float64],
    cells: NDArray[np.int64],
    variance: float,
) -> float:
    """Return how many times as uncertain as independent errors those of neighbours leave cameras.

    The variance of the parts with errors that are independent between cells only (Liang and Zeger,
    "Longitudinal data analysis using generalized linear models", 1986) over that with errors that
    are all independent; at least 1.

    Args:
        information: (k, k) for errors of one pixel.
        free: (k, k), its inverse with the widest priors.
        gradients: (n, k) of the inliers.
        cells: (n,) number of the cell of each.
        variance: px^2 of a coordinate of an error.
    """
    _, number = np.unique(cells, return_inverse=True)
    sums = np.zeros((int(number.max()) + 1, len(free)))
    np.add.at(sums, number, gradients)
    spare = max(len(sums) - len(free), 1) / len(sums)
    clustered = np.einsum("ci,cj->ij", sums, sums) / spare
    ratio = np.diag(free @ clustered @ free) / np.diag(free @ information @ free)
    return max(1.0, float(ratio[6:].mean()) / variance)


@dataclass(frozen=True, slots=True, eq=False)
class _Relevant:
    """The parts of cameras that are off.

    Attributes:
        off: (k,) whether a part is.
        step: (6,) of the pose.
        change: (k,) of the cameras, 0 where nothing is off.
        covariance: (k, k) of ``change``.
    """

    off: NDArray[np.bool_]
    step: NDArray[np.float64]
    change: NDArray[np.float64]
    covariance: NDArray[np.float64]


def _relevant(
    normal: _Normal,
    change: NDArray[np.float64],
    right: NDArray[np.float64],
    wrong: NDArray[np.float64],
) -> _Relevant:
    """Find which parts are off, by how much, and the pose's step with it."""
    target = normal.information[:, 6:] @ change - normal.gradient

    def solved(stds: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        inverse = np.linalg.inv(normal.information + _inverse_variances(stds))
        covariance = np.asarray(inverse, np.float64)
        return covariance @ target, covariance

    stds = wrong
    for _ in range(_MOST_UPDATES):
        found, covariance = solved(stds)
        variances = np.diag(covariance)[6:]
        determined = np.clip(1.0 - variances / stds**2, 1e-3, 1.0)
        widths = np.sqrt(_grouped(np.add, found[6:] ** 2) / _grouped(np.add, determined))
        before, stds = stds, np.clip(widths, right, wrong)
        if np.abs(np.log(stds / before)).max() < _CONVERGED:
            break
    sure = _grouped(np.maximum, np.abs(found[6:]) / np.sqrt(variances))
    sure[(stds <= 1.05 * right) | (np.abs(found[6:]) > _MOST * wrong).any()] = 0.0
    off = sure > _SURE
    best, covariance = solved(np.where(off, stds, right))
    doubtful = (sure > _MAYBE) & ~off
    if doubtful.any():
        _, covariance = solved(np.where(off | doubtful, stds, right))
    by_parts = covariance[6:, 6:] + np.outer(*[np.where(doubtful, found[6:], 0.0)] * 2)
    kept = np.where(off | (right > _RIGHT), best[6:], 0.0)
    return _Relevant(off, best[:6], kept, by_parts)


def _grouped(combine: np.ufunc, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Combine values (k,) of the parts that share a prior, and give each of them the result."""
    of_groups = combine.reduceat(values.reshape(-1, _PARTS), _FIRSTS, axis=1)
    return np.repeat(of_groups, _SIZES, axis=1).ravel()


def _linearized(
    view: MatchedView, pose: Pose, change: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return errors (n, 2) of a changed camera, NaN where they have no derivative.

    And their derivatives by the pose (6, 2, n) and by the change (10, 2, n).
    """
    errors, jacobian = linearized([view], pose, about=np.zeros(3))
    errors = np.where(has_derivative(errors, jacobian)[:, None], errors, np.nan)
    seen = (view.cam_from_rig @ pose).apply(view.points)
    beside = np.sum(seen[:, :2] ** 2, axis=1) / seen[:, 2] ** 2
    zoom = math.exp(change[FOCAL])
    radial = 1.0 + change[RADIAL] * beside
    from_centre = np.asarray((errors + view.pixels - view.principal_point) * zoom)
    by_pose = jacobian.T[:6] * (zoom * radial)
    by_part = np.zeros((_PARTS, 2, len(view)))
    by_part[FOCAL] = (from_centre * radial[:, None]).T
    longer_side = max(view.camera.width, view.camera.height)
    by_part[SHIFT_X, 0] = by_part[SHIFT_Y, 1] = longer_side
    by_part[RADIAL] = from_centre.T * beside
    by_part[_SHUTTER] = by_pose * _row(view)
    by_part[_SHUTTER][3:] *= max(float(np.median(seen[:, 2])), _LEAST_DEPTH)
    shifted = by_part[FOCAL].T + view.principal_point + longer_side * change[[SHIFT_X, SHIFT_Y]]
    moving = np.einsum("ian,i->na", by_part[_SHUTTER], change[_SHUTTER])
    return shifted + moving - view.pixels, by_pose, by_part


def _row(view: MatchedView) -> NDArray[np.float64]:
    """Return how far (n,) pixels lie below the middle row, in heights of the photo."""
    return np.asarray(view.pixels[:, 1] / view.camera.height - 0.5)


def _corrected(view: MatchedView, pose: Pose, change: NDArray[np.float64]) -> MatchedView:
    """Return a view with its camera changed, and its pixels as without the shutter's motion."""
    camera, pixels = view.camera, view.pixels
    if change[_SHUTTER].any():
        _, _, by_part = _linearized(replace(view, focal_unknown=False), pose, change)
        moving = np.einsum("ian,i->na", by_part[_SHUTTER], change[_SHUTTER])
        pixels = pixels - np.where(np.isfinite(moving), moving, 0.0)
    longer_side, zoom = max(camera.width, camera.height), math.exp(change[FOCAL])
    params = dict(zip(CAMERA_MODELS[camera.model], camera.params, strict=True))
    for name in ("f", "fx", "fy"):
        if name in params:
            params[name] *= zoom
    params["cx"] += longer_side * float(change[SHIFT_X])
    params["cy"] += longer_side * float(change[SHIFT_Y])
    model = camera.model
    if change[RADIAL] and (model in _WITH_RADIAL or model in _RADIAL_OF):
        model = _WITH_RADIAL.get(model, model)
        params[_RADIAL_OF[model]] = params.get(_RADIAL_OF[model], 0.0) + float(change[RADIAL])
    names = CAMERA_MODELS[model]
    corrected = Camera(
        model, camera.width, camera.height, tuple(params.get(name, 0.0) for name in names)
    )
    return replace(view, camera=corrected, pixels=pixels)
