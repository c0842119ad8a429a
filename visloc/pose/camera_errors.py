"""What is known of a camera has an error: the photo has its say, and the pose carries the rest.

Beside the pose, the matches of a photo tell by how much its camera is off:

- the focal length, the principal point, and the first radial coefficient, if its model may have
  one;
- the shutter: rows are read one after another, while the camera moves. The pose is that of the
  middle row.

Each part has a normal prior. Most cameras are right, and some are off in one part. So the standard
deviation of each prior is found as well, between that of a right camera and that of a wrong one
(automatic relevance determination: MacKay, "Bayesian interpolation", 1992). A part of which the
photo says nothing stays as it is known.

Landmarks share errors, which no number of matches averages out. So matches count less, as the map's
own test found poses to be further off than the scatter of matches tells
(``visloc.pose.covariance``), and as matches near each other err alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.pose.motion import UncertainPose, moved
from visloc.pose.refinement import LOSS_SCALE_PX
from visloc.pose.reprojection import (
    MatchedView,
    has_derivative,
    linearized,
    project,
    reprojection_errors,
)
from visloc.types import CameraSource

FOCAL, SHIFT_X, SHIFT_Y, RADIAL = range(4)
_SHUTTER = slice(4, 10)
_PARTS = 10
# Each has a prior of its own, but both coordinates of the principal point share one.
_LENS = np.arange(4)  # the parts that a camera has in all its photos
_FIRSTS = np.array([FOCAL, SHIFT_X, RADIAL, *range(4, 10)])
_SIZES = np.array([1, 2, *[1] * 7])
# Photos of one place repeat the errors of its landmarks, so the earlier of them fade.
_KEPT = 0.9
# Standard deviations by which the photo must say that a part is off. From the second on the part is
# corrected; between both, its change only adds to the uncertainty of the pose.
_MAYBE, _SURE = 1.0, 2.5
# A camera with a change of more than 2.5 standard deviations of the widest prior is another camera:
# it is not corrected.
_MOST = 2.5
_LEAST_INLIERS = 12
# Cells along the longer side. Matches of one cell err alike.
_CELLS = 8
# No photo tells of less.
_RIGHT = 0.001
# Thresholds and loss scales of the rounds, in units of the last. With a wrong camera, matches lie
# farther away than an inlier may.
_WIDTHS = (2.0, 1.0, 1.0, 1.0, 1.0)
_MOST_UPDATES, _CONVERGED = 30, 0.02
_MIN_VARIANCE_PX2, _LEAST_DEPTH = 1e-8, 1e-9
_MIN_INFORMATION = 1e-12  # least eigenvalue, with a diagonal of 1
_STEP = 1e-4  # of a numerical derivative by a radial coefficient
# The name of the first radial coefficient in the models that have one, and the model that adds one.
_RADIAL_OF = {"SIMPLE_RADIAL": "k", "RADIAL": "k1", "OPENCV": "k1", "FULL_OPENCV": "k1"}
_WITH_RADIAL = {"SIMPLE_PINHOLE": "SIMPLE_RADIAL", "PINHOLE": "OPENCV"}


@dataclass(frozen=True, slots=True)
class CameraPrior:
    """Standard deviations of a camera's errors.

    Attributes:
        right: of a camera that is as it should be: of the focal length (relative), the principal
            point (longer sides), the radial distortion (coefficient of r^2), and of the shutter
            (motion over all rows: radians, and median depths).
    """

    right: tuple[float, float, float, float]
    wrong: tuple[float, float, float, float]


_GIVEN = CameraPrior((0.001, 0.0003, 0.001, 0.0003), (0.05, 0.03, 0.2, 0.03))
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
class LensEvidence:
    """Evidence of photos on the change of a camera's lens, with poses and shutters eliminated.

    Attributes:
        information: (4, 4)
        vector: (4,), the information times the best change.
    """

    information: NDArray[np.float64]
    vector: NDArray[np.float64]

    def with_earlier(self, earlier: LensEvidence | None) -> LensEvidence:
        """Return what this photo and the earlier ones say to a later one."""
        before = (0.0, 0.0) if earlier is None else (earlier.information, earlier.vector)
        return LensEvidence(
            _KEPT * (self.information + before[0]), _KEPT * (self.vector + before[1])
        )


@dataclass(frozen=True, slots=True, eq=False)
class CameraErrors:
    """A rig's pose with cameras that may be off.

    Attributes:
        views: with corrected cameras, and the pixels that a global shutter would have seen.
        of_camera: (6, 6), what is left of the cameras' errors in ``rig_from_world``, rotation (rad)
            then translation, for R <- Exp(w) R and t <- t + dt.
        evidence: of each view alone; None of one without inliers.
    """

    rig_from_world: Pose
    views: tuple[MatchedView, ...]
    corrected: bool
    of_camera: NDArray[np.float64]
    evidence: tuple[LensEvidence | None, ...]


def find_camera_errors(
    views: Sequence[MatchedView],
    priors: Sequence[CameraPrior],
    rig_from_world: Pose,
    *,
    earlier: Sequence[LensEvidence | None] | None = None,
    max_error_px: float,
    factor: float,
) -> CameraErrors | None:
    """Find by how much the cameras of a rig are off, together with its pose.

    Args:
        views: what each camera sees, with all its matches; some may have none.
        rig_from_world: the best pose with the cameras as they are.
        earlier: what earlier photos said of the camera of each view.
        factor: by how much poses in the map are further off than the scatter of matches tells.

    Returns:
        None when the inliers are too few to tell anything, or leave the pose undetermined.
    """
    near = [_near(view, rig_from_world, max_error_px) for view in views]
    used = [row for row, seen in enumerate(near) if seen is not None]
    seen = [each for each in near if each is not None]
    if not seen:
        return None
    said = [earlier[row] if earlier else None for row in used]
    right, wrong = (
        np.concatenate([_by_part(prior) for prior in each])
        for each in zip(*((priors[row].right, priors[row].wrong) for row in used), strict=True)
    )
    pose, change = rig_from_world, np.zeros(len(right))
    for width in _WIDTHS:
        normal = _normal_equations(seen, pose, change, wrong, width, max_error_px, factor)
        if normal is None:
            return None
        found = _relevant(normal.after(said), right, wrong)
        if width == 1.0 and not found.off.any() and (right <= _RIGHT).all():
            pose, change = rig_from_world, np.zeros(len(right))
            break  # as most given cameras are
        most = _MOST * wrong
        pose, change = moved(pose, found.step), np.clip(found.change, -most, most)
    assert normal is not None
    by_camera = -np.linalg.solve(normal.information[:6, :6], normal.information[:6, 6:])
    of_camera = UncertainPose(pose, by_camera @ found.covariance @ by_camera.T).additive()
    corrected = list(views)
    if change.any():
        for row, each, parts in zip(used, seen, change.reshape(-1, _PARTS), strict=True):
            corrected[row] = _corrected(views[row], each.depth, pose, parts)
    of_camera = (of_camera + of_camera.T) / 2
    evidence: list[LensEvidence | None] = [None] * len(views)
    for number, row in enumerate(used):
        evidence[row] = normal.lens(number, right)
    return CameraErrors(pose, tuple(corrected), bool(change.any()), of_camera, tuple(evidence))


def _by_part(stds: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """Return the standard deviations (10,) of a prior."""
    focal, centre, radial, shutter = stds
    return np.array([focal, centre, centre, radial, *[shutter] * 6])


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """The matches of a view that a corrected camera may explain, and their median depth."""

    view: MatchedView
    depth: float


def _near(view: MatchedView, rig_from_world: Pose, max_error_px: float) -> _Near | None:
    view = replace(view, focal_unknown=False)
    with np.errstate(invalid="ignore"):  # landmarks that are no numbers
        errors = reprojection_errors(view, rig_from_world)
    if not (errors <= max_error_px).any():
        return None
    view = view.selected(errors <= 4.0 * max_error_px)
    depths = (view.cam_from_rig @ rig_from_world).apply(view.points)[:, 2]
    return _Near(view, max(float(np.median(depths)), _LEAST_DEPTH))


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations of the inliers, by the pose and the change of the cameras.

    Attributes:
        information: (k, k), with the errors that landmarks share.
        target: (k,), the information times the step of the pose and the change of the cameras.
    """

    information: NDArray[np.float64]
    target: NDArray[np.float64]

    def lens(self, number: int, right: NDArray[np.float64]) -> LensEvidence:
        """Return what the equations say of one of the cameras, with the others as they are."""
        first = 6 + _PARTS * number
        lens, rest = _LENS + first, np.r_[:6, np.arange(_PARTS)[_SHUTTER] + first]
        of_rest = (self.information + _inverse_variances(right))[np.ix_(rest, rest)]
        by_rest = np.linalg.solve(of_rest, self.information[np.ix_(rest, lens)]).T
        return LensEvidence(
            self.information[np.ix_(lens, lens)] - by_rest @ self.information[np.ix_(rest, lens)],
            self.target[lens] - by_rest @ self.target[rest],
        )

    def after(self, earlier: Sequence[LensEvidence | None]) -> _Normal:
        """Return the equations with what earlier photos said of the cameras."""
        information, target = self.information.copy(), self.target.copy()
        for number, said in enumerate(earlier):
            if said is not None:
                lens = _LENS + 6 + _PARTS * number
                information[np.ix_(lens, lens)] += said.information
                target[lens] += said.vector
        return _Normal(information, target)


def _normal_equations(
    seen: Sequence[_Near],
    pose: Pose,
    change: NDArray[np.float64],
    wrong: NDArray[np.float64],
    width: float,
    max_error_px: float,
    factor: float,
) -> _Normal | None:
    """Return the equations of all views at a pose and a change of their cameras.

    None when there are few inliers, or they leave the pose undetermined.
    """
    size = 6 + len(change)
    errors, rows, cells = [np.empty((0, 2))], [np.empty((size, 2, 0))], [np.empty(0, np.int64)]
    for number, (near, parts) in enumerate(zip(seen, change.reshape(-1, _PARTS), strict=True)):
        view = near.view
        of_view, by_pose, by_part = _linearized(view, near.depth, pose, parts)
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
    if len(error) < _LEAST_INLIERS:
        return None
    squared = np.sum(error**2, axis=1)
    weight = 1.0 / (1.0 + squared / (width * LOSS_SCALE_PX) ** 2)
    # einsum, as in ``visloc.pose.refinement``: the bits of a product of matrices depend on the
    # number of threads.
    columns = (np.sqrt(weight) * by_all).reshape(size, -1)
    information = np.einsum("in,jn->ij", columns, columns)
    units = np.sqrt(np.diag(information)[:6])
    of_pose = information[:6, :6] / np.outer(units, units) if units.all() else np.zeros((6, 6))
    if not np.isfinite(information).all() or np.linalg.eigvalsh(of_pose)[0] < _MIN_INFORMATION:
        return None
    variance = max(float(weight @ squared) / (2.0 * float(weight.sum())), _MIN_VARIANCE_PX2)
    weighted = weight * by_all
    gradient = np.einsum("ian,na->i", weighted, error)
    # What is left of the errors after a step with free cameras.
    free = np.linalg.inv(information + _inverse_variances(wrong, variance))
    error = error - np.einsum("ian,i->na", by_all, free @ gradient)
    each = np.einsum("ian,na->ni", weighted, error)
    shared = _shared(information, free, each, np.concatenate(cells), variance)
    variance *= factor**2 * shared
    return _Normal(information / variance, (information[:, 6:] @ change - gradient) / variance)


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
    """Return the factor by which errors that neighbours share widen the variance of the parts.

    The variance with errors that are independent between cells only (Liang and Zeger, "Longitudinal
    data analysis using generalized linear models", 1986) over the one with independent errors; at
    least 1.

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
    shared, independent = (np.diag(free @ m @ free)[6:] for m in (clustered, information))
    told = independent > 0
    return max(1.0, float(np.mean(shared[told] / independent[told])) / variance)


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
    right: NDArray[np.float64],
    wrong: NDArray[np.float64],
) -> _Relevant:
    """Find which parts are off, by how much, and the pose's step with it."""

    def solved(stds: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        inverse = np.linalg.inv(normal.information + _inverse_variances(stds))
        covariance = np.asarray(inverse, np.float64)
        return covariance @ normal.target, covariance

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
    sure[stds <= 1.05 * right] = 0.0
    beyond = (np.abs(found[6:]) > _MOST * wrong).reshape(-1, _PARTS).any(axis=1)
    off = (sure > _SURE) & ~np.repeat(beyond, _PARTS)
    doubtful = (sure > _MAYBE) & ~off
    best, covariance = solved(np.where(off, stds, right))
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
    view: MatchedView, depth: float, pose: Pose, change: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return errors (n, 2) of a changed camera, NaN where they have no derivative.

    And their derivatives by the pose (6, 2, n) and by the change (10, 2, n).
    """
    view = replace(view, camera=_changed(view.camera, change))
    errors, jacobian = linearized([view], pose, about=np.zeros(3))
    errors = np.where(has_derivative(errors, jacobian)[:, None], errors, np.nan)
    by_pose = jacobian.T[:6]
    by_part = np.zeros((_PARTS, 2, len(view)))
    # Every model multiplies by the focal length at last, then adds the principal point.
    by_part[FOCAL] = (errors + view.pixels - view.principal_point).T
    longer_side = max(view.camera.width, view.camera.height)
    by_part[SHIFT_X, 0] = by_part[SHIFT_Y, 1] = longer_side
    by_part[RADIAL] = _by_radial(view, pose)
    by_part[_SHUTTER] = by_pose * (view.pixels[:, 1] / view.camera.height - 0.5)
    by_part[_SHUTTER][3:] *= depth
    moving = np.einsum("ian,i->na", by_part[_SHUTTER], change[_SHUTTER])
    return errors + moving, by_pose, by_part


def _by_radial(view: MatchedView, pose: Pose) -> NDArray[np.float64]:
    """Return the derivatives (2, n) by the first radial coefficient; 0 if the model has none."""
    in_cam = (view.cam_from_rig @ pose).apply(view.points)
    if view.camera.model in _WITH_RADIAL:  # pinholes
        rays = in_cam[:, :2] / in_cam[:, 2:]
        params = dict(zip(CAMERA_MODELS[view.camera.model], view.camera.params, strict=True))
        focal = np.array([params.get("fx", params.get("f")), params.get("fy", params.get("f"))])
        return np.asarray((focal * rays * np.sum(rays**2, axis=1, keepdims=True)).T)
    if view.camera.model not in _RADIAL_OF:
        return np.zeros((2, len(view)))
    change = np.zeros(_PARTS)
    change[RADIAL] = _STEP
    more, less = (project(_changed(view.camera, by), in_cam) for by in (change, -change))
    return np.asarray((more - less).T / (2 * _STEP))


def _changed(camera: Camera, change: NDArray[np.float64]) -> Camera:
    """Return a camera with another focal length, principal point and first radial coefficient."""
    longer_side, zoom = max(camera.width, camera.height), math.exp(change[FOCAL])
    params = dict(zip(CAMERA_MODELS[camera.model], camera.params, strict=True))
    params |= {name: zoom * params[name] for name in ("f", "fx", "fy") if name in params}
    params["cx"] += longer_side * float(change[SHIFT_X])
    params["cy"] += longer_side * float(change[SHIFT_Y])
    model = camera.model
    if change[RADIAL]:
        model = _WITH_RADIAL.get(model, model)
        name = _RADIAL_OF[model]
        params[name] = params.get(name, 0.0) + float(change[RADIAL])
    values = tuple(params.get(name, 0.0) for name in CAMERA_MODELS[model])
    return Camera(model, camera.width, camera.height, values)


def _corrected(
    view: MatchedView, depth: float, pose: Pose, change: NDArray[np.float64]
) -> MatchedView:
    """Return a view with its camera changed, and its pixels as without the shutter's motion."""
    changed = replace(view, camera=_changed(view.camera, change))
    if not change[_SHUTTER].any():
        return changed
    _, _, by_part = _linearized(replace(view, focal_unknown=False), depth, pose, change)
    moving = np.einsum("ian,i->na", by_part[_SHUTTER], change[_SHUTTER])
    return replace(changed, pixels=view.pixels - np.where(np.isfinite(moving), moving, 0.0))
