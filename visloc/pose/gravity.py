"""Find a pose whose gravity is known: two correspondences determine it, instead of three.

Gravity gives two of the three angles. A rotation about the vertical and a translation remain. At
10 % inliers, one sample of two correspondences in 100 is right, but only one of three in 1000.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.reprojection import MatchedView, normalized_rays

_SAMPLE_SIZE = 2
# At 5 % inliers one sample is right with the stated confidence.
_MAX_SAMPLES = 4_000
_CONFIDENCE = 0.9999
# A sample of right correspondences may give a bad pose, by noise and by gravity's own error.
_SAMPLES_PER_NEED = 3.0
_BATCH = 16  # small enough for the processor's cache: twice as fast as 32
# More do not tell better which pose is right, and take longer.
_MAX_SCORED = 500
_MAX_CANDIDATES = 5
# Wider than this, chance explains as much as the truth.
_MAX_SLACK = math.radians(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class KnownGravity:
    """Which way is down, in two frames.

    Attributes:
        rig: (3,) unit vector that points down, in the rig's frame.
        world: (3,) unit vector that points down, in the world's.
        std: standard deviation of the angle between both, rad.
    """

    rig: NDArray[np.float64]
    world: NDArray[np.float64]
    std: float


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Correspondences that have a ray.

    Attributes:
        centers: (n, 3) where the rays start, in the rig's frame.
        directions: (n, 3) unit vectors, in the rig's frame.
        points: (n, 3) in the world.
        tolerance: (n,) the largest angle between ray and point of an inlier, rad.
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

    The minimal solver is PoseLib's for generalized cameras. A pose is judged by the angles between
    rays and points, truncated at the threshold plus gravity's own spread (MSAC, Torr and
    Zisserman 2000).

    Returns:
        ``rig_from_world`` of the last few poses that were the best so far, best first. They are
        as rough as gravity is: refine them. Empty when no sample gave a pose.
    """
    rays = _rays(views, max_error_px, min(gravity.std, _MAX_SLACK))
    if len(rays) < _SAMPLE_SIZE:
        return []
    random = np.random.default_rng(seed)
    if len(rays) > _MAX_SCORED:
        rays = rays.take(random.permutation(len(rays))[:_MAX_SCORED])
    # The solver turns about y: turn both frames so that gravity is y.
    upright_from_rig, upright_from_world = _upright(gravity.rig), _upright(gravity.world)
    upright = _Rays(
        rays.centers @ upright_from_rig.T,
        rays.directions @ upright_from_rig.T,
        rays.points @ upright_from_world.T,
        rays.tolerance,
    )
    return [
        Pose(upright_from_rig.T @ pose[:, :3] @ upright_from_world, upright_from_rig.T @ pose[:, 3])
        for pose in _search(upright, random)
    ]


def _rays(views: Sequence[MatchedView], max_error_px: float, slack: float) -> _Rays:
    """The correspondences that have a ray and a point, in the rig's frame and the world."""
    centers, directions, points, tolerance = [], [], [], []
    for view in views:
        rays = normalized_rays(view.camera, view.pixels)
        usable = np.isfinite(rays).all(axis=1) & np.isfinite(view.points).all(axis=1)
        rig_from_cam = view.cam_from_rig.inverse()
        rays = rays[usable] / np.linalg.norm(rays[usable], axis=1, keepdims=True)
        centers.append(np.tile(rig_from_cam.translation, (len(rays), 1)))
        directions.append(rays @ rig_from_cam.rotation.T)
        points.append(view.points[usable])
        tolerance.append(np.full(len(rays), max_error_px / view.camera.focal_length + slack))
    return _Rays(*(np.concatenate(part) for part in (centers, directions, points, tolerance)))


def _search(rays: _Rays, random: np.random.Generator) -> list[NDArray[np.float64]]:
    """Candidates (3, 4) for rays in upright frames, best first."""
    candidates: list[NDArray[np.float64]] = []
    best_score = 0.0
    num_samples, num_needed = 0, _MAX_SAMPLES
    while num_samples < num_needed:
        num_samples += _BATCH
        poses = _solve(rays, random)
        if len(poses) == 0:
            continue
        scores, shares = _scores(rays, poses)
        top = int(np.argmax(scores))
        if scores[top] > best_score:
            best_score = float(scores[top])
            candidates.append(poses[top])
            num_needed = min(_MAX_SAMPLES, _num_needed(float(shares[top])))
    return candidates[::-1][:_MAX_CANDIDATES]


def _solve(rays: _Rays, random: np.random.Generator) -> NDArray[np.float64]:
    """Poses (k, 3, 4) of a batch of samples, of which each may give none, one or two."""
    first = random.integers(0, len(rays), _BATCH)
    second = (first + random.integers(1, len(rays), _BATCH)) % len(rays)  # never the same
    poses = [
        pose.Rt
        for pair in np.column_stack([first, second])
        for pose in poselib.ugp2p(rays.centers[pair], rays.directions[pair], rays.points[pair])
    ]
    found: NDArray[np.float64] = np.array(poses).reshape(-1, 3, 4)
    return found[np.isfinite(found).all(axis=(1, 2))]


def _scores(
    rays: _Rays, poses: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """MSAC scores (k,), and the shares (k,) of correspondences within their tolerance."""
    homogeneous = np.vstack([rays.points.T, np.ones(len(rays))])
    along = np.zeros((len(poses), len(rays)))
    distance2 = np.zeros_like(along)
    for axis in range(3):
        seen = poses[:, axis] @ homogeneous - rays.centers[:, axis]
        along += seen * rays.directions[:, axis]
        distance2 += seen * seen
    cosine = along / np.sqrt(np.maximum(distance2, np.finfo(float).tiny))
    # 2 - 2 cos a is a^2 for the small angles that count.
    gain = np.maximum(1.0 - (2.0 - 2.0 * cosine) / rays.tolerance**2, 0.0)
    return gain.sum(axis=1), np.mean(gain > 0, axis=1)


def _num_needed(share: float) -> int:
    """Return after how many samples one was right, with the stated confidence."""
    right = share**_SAMPLE_SIZE
    if not 0.0 < right < 1.0:
        return 0 if right else _MAX_SAMPLES
    return math.ceil(_SAMPLES_PER_NEED * math.log(1.0 - _CONFIDENCE) / math.log1p(-right))


def _upright(down: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation (3, 3) that turns a unit vector to y."""
    across = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    across /= np.linalg.norm(across)
    return np.array([across, down, np.cross(across, down)])
