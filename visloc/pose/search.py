"""Poses that may be right, by RANSAC over all 2D-3D correspondences; they want refinement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import poselib
import pycolmap
from scipy.spatial.transform import Rotation

from visloc.geometry import Camera, Pose
from visloc.pose.refinement import MIN_INLIERS
from visloc.pose.reprojection import MatchedView, colmap_camera, normalized_rays, pose_from_colmap

# Beyond this many trials a pose with 8 % inliers has been found with 99 % probability; a photo
# of another place should not cost seconds.
MAX_TRIALS = 10_000
# pycolmap's own for one camera; those that it has for rigs take twice as long when half of
# the correspondences are right, and find no more when few are.
_CONFIDENCE = 0.99999
_MIN_TRIALS = 100
# With the focal length a sample has four correspondences instead of three: this many find a pose
# with 12 % inliers with 98 % probability.
_FOCAL_TRIALS = 20_000
# Four correspondences in a plane do not tell it. Where all are, three that take one of these for
# it, in units of the longer side, find a pose with 20 % inliers, from which refinement finds the
# right one. From 0.4 to 3.4 it is at most 1.4 times off.
_FOCAL_GUESSES = (0.6, 1.2, 2.4)
_TRIALS_PER_GUESS = 500
# RANSAC looks at no more than this many correspondences: what explains them explains the others,
# and a photo of another place costs a third of the time. Of 4000 in no
# order, poses that explain 5 % are found as often as among all, those of 3 % more rarely.
_MAX_SEARCHED = 1_000


def search_with_pycolmap(
    views: Sequence[MatchedView], *, max_error_px: float, seed: int, max_trials: int = MAX_TRIALS
) -> list[Pose]:
    """Search by pycolmap's LO-RANSAC with GP3P.

    Args:
        views: what each camera sees; those matched best come first.
        max_error_px: largest reprojection error of an inlier, in each camera's pixels.

    Returns:
        ``rig_from_world`` of the best pose; empty when there is none or fewer than four
        correspondences are numbers.
    """
    searched = _searched(views)
    if sum(map(len, searched)) < MIN_INLIERS:
        return []
    solved = pycolmap.estimate_generalized_absolute_pose(
        np.concatenate([view.pixels for view in searched]),
        np.concatenate([view.points for view in searched]),
        np.repeat(np.arange(len(searched)), [len(view) for view in searched]).tolist(),
        [_rigid(view.cam_from_rig) for view in searched],
        [colmap_camera(view.camera) for view in searched],
        _ransac_options(max_error_px, seed, max_trials),
    )
    return [] if solved is None else [pose_from_colmap(solved["rig_from_world"])]


def search_with_poselib(
    views: Sequence[MatchedView], *, max_error_px: float, seed: int
) -> list[Pose]:
    """Search by PoseLib's LO-RANSAC, with P3P for one camera and GP3P for several.

    PoseLib knows not all camera models: it is given the pixels of pinholes that see the same. Far
    from the centre of a wide lens, where these are farther apart, inliers are told more strictly.

    Args and returns as of ``search_with_pycolmap``.
    """
    usable = [_as_pinhole(view) for view in _searched(views)]
    # With an empty one among them PoseLib is not sure to find anything.
    usable = [view for view in usable if len(view)]
    if sum(map(len, usable)) < MIN_INLIERS:
        return []
    options = {
        "max_reproj_error": max_error_px,
        "success_prob": _CONFIDENCE,
        "min_iterations": _MIN_TRIALS,
        "max_iterations": MAX_TRIALS,
        "seed": seed,
    }
    if len(usable) == 1:
        (view,) = usable
        found, told = poselib.estimate_absolute_pose(
            view.pixels, view.points, _poselib_camera(view.camera), options, {}
        )
        rig_from_cam = view.cam_from_rig.inverse()
    else:
        found, told = poselib.estimate_generalized_absolute_pose(
            [view.pixels for view in usable],
            [view.points for view in usable],
            [_poselib_pose(view.cam_from_rig) for view in usable],
            [_poselib_camera(view.camera) for view in usable],
            options,
            {},
        )
        rig_from_cam = Pose.identity()
    matrix = np.array(found.Rt, dtype=np.float64)
    # It returns the identity when it finds nothing.
    if told["num_inliers"] < MIN_INLIERS or not np.isfinite(matrix).all():
        return []
    pose = Pose(matrix[:, :3], matrix[:, 3])
    return [rig_from_cam @ (pose if len(usable) == 1 else _in_32_bits(pose))]


def search_with_focal_length(
    view: MatchedView, *, max_error_px: float, seed: int
) -> list[tuple[Camera, Pose]]:
    """Search for a pose and the focal length, by pycolmap's LO-RANSAC.

    With P4Pf, which finds any focal length but not from points in a plane, and with P3P for some.

    Args:
        view: of a camera whose focal length is a guess.

    Returns:
        Cameras with ``rig_from_world``; some are far off, with no camera's focal length. Empty when
        there are fewer than four correspondences.
    """
    (searched,) = _searched([view])
    if len(searched) < MIN_INLIERS:
        return []
    starts = []
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.estimate_focal_length = True
    options.ransac = _ransac_options(max_error_px, seed, _FOCAL_TRIALS)
    camera = colmap_camera(view.camera)  # a copy, into which the focal length is written
    solved = pycolmap.estimate_absolute_pose(searched.pixels, searched.points, camera, options)
    found = float(camera.mean_focal_length())
    if solved is not None and 0.0 < found < np.inf:
        pose = view.cam_from_rig.inverse() @ pose_from_colmap(solved["cam_from_world"])
        starts.append((view.zoomed(found / view.camera.focal_length).camera, pose))
    for guess in _FOCAL_GUESSES:
        focal = guess * max(view.camera.width, view.camera.height)
        guessed = searched.zoomed(focal / view.camera.focal_length)
        poses = search_with_pycolmap(
            [guessed], max_error_px=max_error_px, seed=seed, max_trials=_TRIALS_PER_GUESS
        )
        starts += [(guessed.camera, pose) for pose in poses]
    return starts


def _in_32_bits(pose: Pose) -> Pose:
    """The pose without its last digits, in which PoseLib's of rigs differ from call to call."""
    quaternion = Rotation.from_matrix(pose.rotation).as_quat(canonical=True).astype(np.float32)
    rotation = Rotation.from_quat(quaternion.astype(np.float64)).as_matrix()
    return Pose(rotation, pose.translation.astype(np.float32).astype(np.float64))


def _searched(views: Sequence[MatchedView]) -> list[MatchedView]:
    """Sample the correspondences for RANSAC: of each view in proportion."""
    share = _MAX_SEARCHED / max(sum(len(view) for view in views), _MAX_SEARCHED)
    sampled = [_sample(view, round(share * len(view))) for view in views]
    return [_finite(view) for view in sampled]


def _finite(view: MatchedView) -> MatchedView:
    numbers = np.isfinite(np.hstack([view.pixels, view.points]))
    return view.selected(np.asarray(numbers.all(axis=1)))


def _sample(view: MatchedView, count: int) -> MatchedView:
    """The first half of ``count`` correspondences, the best, and as many evenly from the others.

    The best alone would find a pose in fewer trials, but nothing where they are wrong together.
    """
    num_best = count // 2
    num_others = count - num_best
    others = len(view) - num_best
    rows = num_best + np.arange(num_others) * others // max(num_others, 1)
    return view.selected(np.concatenate([np.arange(num_best), rows]))


def _ransac_options(max_error_px: float, seed: int, max_trials: int) -> pycolmap.RANSACOptions:
    options = pycolmap.RANSACOptions()  # those that the calls have by default are refused by them
    options.max_error = max_error_px
    options.confidence = _CONFIDENCE
    options.min_num_trials = _MIN_TRIALS
    options.max_num_trials = max_trials
    options.random_seed = seed
    return options


def _rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)


def _as_pinhole(view: MatchedView) -> MatchedView:
    """Undistort to a pinhole of the same focal length; drop pixels that have no ray."""
    focal = view.camera.focal_length
    camera = Camera("SIMPLE_PINHOLE", view.camera.width, view.camera.height, (focal, 0.0, 0.0))
    rays = normalized_rays(view.camera, view.pixels)[:, :2]
    pinhole = MatchedView(camera, view.cam_from_rig, focal * rays, view.points)
    return _finite(pinhole)


def _poselib_camera(camera: Camera) -> dict[str, object]:
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }


def _poselib_pose(pose: Pose) -> poselib.CameraPose:
    made = poselib.CameraPose()
    made.R, made.t = pose.rotation, pose.translation
    return made
