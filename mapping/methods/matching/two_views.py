"""Find the matches that fit one geometry of two photos, and judge whether so many fit by chance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose
from visloc.matching.verification import epipolar_errors
from visloc.pose.reprojection import normalized_rays

# Inliers are believed when chance gives so many at most once in 10^10 pairs with as many matches.
MAX_LOG10_CHANCE = -10.0
# Matches that fix an essential matrix, and a fundamental one.
_SAMPLE = {True: 5, False: 7}
_MIN_TRIALS, _MAX_TRIALS, _CONFIDENCE = 100, 2000, 0.999
# PoseLib returns identity for fewer, or is not sure to end.
_FEWEST = 8
# Of more than twice so many matches, so many find the geometry if half of them fit it.
_SOME, _CLEAR = 500, 0.5


def fits_two_views(
    cameras: tuple[Camera, Camera],
    pixels_a: NDArray[np.floating],
    pixels_b: NDArray[np.floating],
    max_error_px: float,
    *,
    calibrated: bool,
    among: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """Tell which matched pixels (n, 2) fit the relative pose of two photos.

    LO-RANSAC by PoseLib, seeded. Nothing fits when as many matches would by chance
    (``log10_chance``): with thousands of matches, the best of all geometries has dozens of inliers
    between photos of different places.

    Args:
        calibrated: whether the intrinsics are known; else a fundamental matrix is estimated of the
            pixels, whatever their distortion.
        among: (n,) matches that the relative pose is estimated from; all by default. The others may
            fit it all the same.
    """
    return _searched(cameras, pixels_a, pixels_b, max_error_px, calibrated, among)[0]


def relative_pose(
    cameras: tuple[Camera, Camera],
    pixels_a: NDArray[np.floating],
    pixels_b: NDArray[np.floating],
    max_error_px: float,
) -> tuple[Pose, NDArray[np.bool_]] | None:
    """Return ``b_from_a`` of two calibrated photos, one unit apart, and which matches (n,) fit it.

    None when no more matches fit it than chance explains; arguments as of ``fits_two_views``.
    """
    fits, found = _searched(cameras, pixels_a, pixels_b, max_error_px, True, None)
    if found is None or found.pose is None:
        return None
    way = np.asarray(found.pose.t)
    return Pose(np.asarray(found.pose.R), way / np.linalg.norm(way)), fits


def _searched(
    cameras: tuple[Camera, Camera],
    pixels_a: NDArray[np.floating],
    pixels_b: NDArray[np.floating],
    max_error_px: float,
    calibrated: bool,
    among: NDArray[np.bool_] | None,
) -> tuple[NDArray[np.bool_], _TwoViews | None]:
    fits = np.zeros(len(pixels_a), dtype=bool)
    if calibrated:
        # PoseLib does not know all camera models.
        focal = math.sqrt(cameras[0].focal_length * cameras[1].focal_length)
        seen = [
            focal * normalized_rays(camera, pixels)[:, :2]
            for camera, pixels in zip(cameras, (pixels_a, pixels_b), strict=True)
        ]
    else:
        seen = [pixels_a.astype(np.float64), pixels_b.astype(np.float64)]
    finite = np.isfinite(np.concatenate(seen, axis=1)).all(axis=1)
    usable = np.flatnonzero(finite if among is None else finite & among)
    if len(usable) < _FEWEST:
        return fits, None
    a, b = (points[usable] for points in seen)
    focal_px = focal if calibrated else None
    two_views, found = _estimated_by_some(a, b, focal_px, max_error_px)
    if found.sum() < _FEWEST:
        return fits, None
    share = max(_share_near_a_line(camera, max_error_px) for camera in cameras)
    chance = log10_chance(len(usable), int(found.sum()), share, calibrated=calibrated)
    if chance > MAX_LOG10_CHANCE:
        return fits, None
    fits[usable[found]] = True
    if among is not None:
        others = np.flatnonzero(finite & ~among)
        errors = _sampson_errors(two_views.fundamental, *(points[others] for points in seen))
        fits[others[errors <= max_error_px]] = True
    return fits, two_views


def _estimated_by_some(
    a: NDArray[np.float64], b: NDArray[np.float64], focal_px: float | None, max_error_px: float
) -> tuple[_TwoViews, NDArray[np.bool_]]:
    """Return the geometry of matched pixels (n, 2), and which of them (n,) fit it.

    A part of many matches finds it in a third of the time, and all refine it. Where few of the part
    fit, all of them are searched: a weak pair needs each.
    """
    if len(a) > 2 * _SOME:
        some = np.random.default_rng(0).permutation(len(a))[:_SOME]
        found, inliers = _estimated(a[some], b[some], focal_px, max_error_px)
        if inliers.mean() >= _CLEAR:
            refined = _refined(found, a, b, focal_px, max_error_px)
            return refined, refined.fits(a, b, max_error_px)
    return _estimated(a, b, focal_px, max_error_px)


@dataclass(frozen=True, slots=True, eq=False)
class _TwoViews:
    """The geometry of two photos.

    Attributes:
        fundamental: (3, 3), of pixels.
        pose: second camera from first, with centred pixels of this focal length; None when the
            intrinsics are unknown.
    """

    fundamental: NDArray[np.float64]
    pose: poselib.CameraPose | None = None
    focal_px: float = 1.0

    @staticmethod
    def of(pose: poselib.CameraPose, focal_px: float) -> _TwoViews:
        cross = np.cross(np.eye(3), pose.t)
        to_rays = np.diag([1 / focal_px, 1 / focal_px, 1.0])
        return _TwoViews(to_rays @ cross.T @ pose.R @ to_rays, pose, focal_px)

    def fits(
        self, a: NDArray[np.float64], b: NDArray[np.float64], max_error_px: float
    ) -> NDArray[np.bool_]:
        """Tell which matched pixels (n, 2) fit it, in front of both cameras.

        Pixels as near to those of infinitely far points as an inlier is to its line do not tell
        their side: of far points, noise would put half behind. If most are such pixels, PoseLib
        does not know in which of both directions the camera moved.
        """
        near = _sampson_errors(self.fundamental, a, b) <= max_error_px
        if self.pose is None:
            return np.asarray(near)
        ones = np.ones((len(a), 1))
        rays_a, rays_b = (np.hstack([pixels / self.focal_px, ones]) for pixels in (a, b))
        turned = rays_a @ self.pose.R.T
        with np.errstate(divide="ignore", invalid="ignore"):
            parallax = np.linalg.norm(b - self.focal_px * turned[:, :2] / turned[:, 2:], axis=1)
        are_far = (turned[:, 2] > 0) & (parallax <= max_error_px)
        directions = (
            np.isfinite(epipolar_errors(rays_a, rays_b, Pose(self.pose.R, sign * self.pose.t)))
            for sign in (1, -1)
        )
        in_front = max(directions, key=lambda fits: np.count_nonzero(fits & near & ~are_far))
        return np.asarray(near & (in_front | are_far))


def _estimated(
    a: NDArray[np.float64], b: NDArray[np.float64], focal_px: float | None, max_error_px: float
) -> tuple[_TwoViews, NDArray[np.bool_]]:
    options = {
        "max_epipolar_error": max_error_px,
        "min_iterations": _MIN_TRIALS,
        "max_iterations": _MAX_TRIALS,
        "success_prob": _CONFIDENCE,
        "seed": 0,
    }
    if focal_px is None:
        fundamental, told = poselib.estimate_fundamental(a, b, options, {})
        found = _TwoViews(fundamental)
    else:
        camera = _pinhole(focal_px)
        pose, told = poselib.estimate_relative_pose(a, b, camera, camera, options, {})
        found = _TwoViews.of(pose, focal_px)
    inliers = np.array(told["inliers"], dtype=bool)
    # Without a model, the mask is not all false.
    if told["num_inliers"] < _FEWEST or len(inliers) != len(a):
        inliers = np.zeros(len(a), dtype=bool)
    return found, inliers


def _refined(
    found: _TwoViews,
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    focal_px: float | None,
    max_error_px: float,
) -> _TwoViews:
    options = {"loss_type": "TRUNCATED", "loss_scale": max_error_px}
    if found.pose is None or focal_px is None:
        return _TwoViews(poselib.refine_fundamental(a, b, found.fundamental, options)[0])
    camera = _pinhole(focal_px)
    pose, _ = poselib.refine_relative_pose(a, b, found.pose, camera, camera, options)
    return _TwoViews.of(pose, focal_px)


def _pinhole(focal_px: float) -> dict[str, Any]:
    params = [focal_px, 0.0, 0.0]
    return {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": params}


def _sampson_errors(
    fundamental: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how far (n,) matched pixels (n, 2) are off their epipolar lines, to first order."""
    ones = np.ones((len(a), 1))
    first, second = np.hstack([a, ones]), np.hstack([b, ones])
    lines, back = first @ fundamental.T, second @ fundamental
    gradients = (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((second * lines).sum(axis=1)) / np.sqrt(np.maximum(gradients, 1e-300)))


def log10_chance(num_matches: int, num_inliers: int, share: float, *, calibrated: bool) -> float:
    """Return the logarithm of how often chance gives so many inliers among wrong matches.

    The number of false alarms of Moisan and Stival, "A probabilistic criterion to detect rigid
    point matches between two images" (2004): over all samples that fix a geometry,
    and all sets of so many matches.

    Args:
        share: part of the photo that lies as near to an epipolar line as an inlier must.
    """
    sample = _SAMPLE[calibrated]
    if num_inliers <= sample:
        return math.inf
    return (
        math.log10(max(num_matches - sample, 1))
        + _log10_choose(num_matches, num_inliers)
        + _log10_choose(num_inliers, sample)
        + (num_inliers - sample) * math.log10(min(share, 1.0))
    )


def _share_near_a_line(camera: Camera, max_error_px: float) -> float:
    longest = math.hypot(camera.width, camera.height)
    return 2 * max_error_px * longest / (camera.width * camera.height)


def _log10_choose(n: int, k: int) -> float:
    return (math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)) / math.log(10)
