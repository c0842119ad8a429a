"""A pose of which gravity is known: two correspondences make one, instead of three.

Two of the three angles are known, so that a rotation about the vertical and a translation are left
to find. At 10 % inliers one sample of two in 100 is right, where it is one of three in 1000.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.colmap import normalized_rays
from visloc.pose.views import MatchedView

# At 5 % inliers, one sample is right with the stated confidence.
_MAX_SAMPLES = 4_000
_CONFIDENCE = 0.9999
# A sample of right correspondences need not make a good pose: noise, and gravity's own error.
_SAMPLES_PER_NEED = 3.0
_BATCH = 64
# More say nothing more about which pose is right, and cost time.
_MAX_SCORED = 1_000
_MAX_CANDIDATES = 5
# Wider than this, chance explains as much as the truth.
_MAX_SLACK = math.radians(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class KnownGravity:
    """Which way is down, in two frames.

    Attributes:
        rig: (3,) unit vector that points down, in the rig's frame.
        world: (3,) unit vector that points down, in the world's.
        std: standard deviation of the angle between what both say, rad.
    """

    rig: NDArray[np.float64]
    world: NDArray[np.float64]
    std: float


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Correspondences in the rig's frame: centres (n, 3), unit directions (n, 3), points (n, 3) in
    the world, and the angles (n,), rad, that a point may be away from its ray.
    """

    centers: NDArray[np.float64]
    directions: NDArray[np.float64]
    points: NDArray[np.float64]
    tolerance: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> _Rays:
        return _Rays(
            self.centers[rows], self.directions[rows], self.points[rows], self.tolerance[rows]
        )


def gravity_deviation(rig_from_world: Pose, gravity: KnownGravity) -> float:
    """Return the angle (rad) between the world's down as the pose turns it and the rig's."""
    down = rig_from_world.rotation @ gravity.world
    cross = np.linalg.norm(np.cross(down, gravity.rig))
    return math.atan2(float(cross), float(down @ gravity.rig))


def find_upright_poses(
    views: Sequence[MatchedView], gravity: KnownGravity, *, max_error_px: float, seed: int
) -> list[Pose]:
    """Search for poses that obey gravity, by RANSAC over samples of two correspondences.

    The minimal solver is PoseLib's for generalized cameras (Sweeney et al. 2014: the vertical is
    known, a quadratic equation is left). A pose is judged by the angles between rays and points,
    truncated at the threshold plus gravity's own spread (MSAC, Torr and Zisserman 2000).

    Args:
        views: correspondences.
        gravity: of the rig.
        max_error_px: largest reprojection error of an inlier.
        seed: equal seeds give equal bits.

    Returns:
        ``rig_from_world`` of the best candidates, best first, each the best of its samples so
        far. They are as rough as gravity is: refine them. Empty when no sample gave a pose.
    """
    rays = _rays(views, max_error_px, min(gravity.std, _MAX_SLACK))
    if len(rays) < 2:
        return []
    random = np.random.default_rng(seed)
    if len(rays) > _MAX_SCORED:
        rays = rays.take(random.permutation(len(rays))[:_MAX_SCORED])
    # The solver turns about y: turn both frames so that gravity is y.
    upright_from_rig, upright_from_world = _upright(gravity.rig), _upright(gravity.world)
    turned = _Rays(
        rays.centers @ upright_from_rig.T,
        rays.directions @ upright_from_rig.T,
        rays.points @ upright_from_world.T,
        rays.tolerance,
    )
    return [
        Pose(upright_from_rig.T @ rt[:, :3] @ upright_from_world, upright_from_rig.T @ rt[:, 3])
        for rt in _search(turned, random)
    ]


def _search(rays: _Rays, random: np.random.Generator) -> list[NDArray[np.float64]]:
    """Candidates (3, 4) for rays in upright frames, best first."""
    best: list[NDArray[np.float64]] = []
    best_score = 0.0
    num_samples, num_needed = 0, _MAX_SAMPLES
    while num_samples < num_needed:
        poses = _solve(rays, random)
        num_samples += _BATCH
        if len(poses) == 0:
            continue
        scores, shares = _scores(rays, poses)
        top = int(np.argmax(scores))
        if scores[top] > best_score:
            best_score = scores[top]
            best.append(poses[top])
            num_needed = min(_MAX_SAMPLES, _num_needed(float(shares[top])))
    return best[: -_MAX_CANDIDATES - 1 : -1]


def _solve(rays: _Rays, random: np.random.Generator) -> NDArray[np.float64]:
    """Poses (k, 3, 4) of a batch of samples."""
    first = random.integers(0, len(rays), _BATCH)
    second = (first + random.integers(1, len(rays), _BATCH)) % len(rays)
    poses = [
        pose.Rt
        for pair in np.column_stack([first, second])
        for pose in poselib.ugp2p(rays.centers[pair], rays.directions[pair], rays.points[pair])
    ]
    found = np.array(poses).reshape(-1, 3, 4)
    return found[np.isfinite(found).all(axis=(1, 2))]


def _scores(
    rays: _Rays, poses: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """MSAC scores (k,), and the shares (k,) of correspondences within their tolerance."""
    seen = poses[:, :, :3] @ rays.points.T + poses[:, :, 3:] - rays.centers.T  # (k, 3, n)
    distance = np.sqrt(np.einsum("kin,kin->kn", seen, seen))
    cosine = np.einsum("kin,ni->kn", seen, rays.directions) / np.maximum(distance, 1e-12)
    # 2 - 2 cos a is a^2 for the angles that count.
    gain = np.maximum(1.0 - (2.0 - 2.0 * cosine) / rays.tolerance**2, 0.0)
    return gain.sum(axis=1), np.mean(gain > 0, axis=1)


def _num_needed(share: float) -> int:
    """Samples until one of two right correspondences was among them, with the confidence."""
    right = min(share**2, 1.0 - 1e-9)
    if right <= 0:
        return _MAX_SAMPLES
    return math.ceil(_SAMPLES_PER_NEED * math.log(1.0 - _CONFIDENCE) / math.log1p(-right))


def _rays(views: Sequence[MatchedView], max_error_px: float, slack: float) -> _Rays:
    """The correspondences that have a ray and a point."""
    return _Rays(*(np.concatenate(part) for part in zip(*_parts(views, max_error_px, slack))))


def _parts(
    views: Sequence[MatchedView], max_error_px: float, slack: float
) -> Iterator[tuple[NDArray[np.float64], ...]]:
    for view in views:
        rays = normalized_rays(view.camera, view.pixels)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        usable = np.isfinite(rays).all(axis=1) & np.isfinite(view.points).all(axis=1)
        rig_from_cam = view.cam_from_rig.inverse()
        directions = rays[usable] @ rig_from_cam.rotation.T
        yield (
            np.broadcast_to(rig_from_cam.translation, directions.shape),
            directions,
            view.points[usable],
            max_error_px * _angle_per_pixel(view, rays)[usable] + slack,
        )


def _angle_per_pixel(view, rays):
    shifted = normalized_rays(view.camera, view.pixels + 0.5)
    shifted /= np.linalg.norm(shifted, axis=1, keepdims=True)
    angle = np.linalg.norm(np.cross(rays, shifted), axis=1) / math.sqrt(0.5)
    return np.where(np.isfinite(angle), angle, 1.0 / view.camera.params[0])


def _upright(down: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation (3, 3) that turns a unit vector to y."""
    across = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    across /= np.linalg.norm(across)
    return np.array([across, down, np.cross(across, down)])
