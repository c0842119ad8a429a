from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from visloc.geometry import Camera, Pose
from visloc.pose.motion import (
    RelativeMotion,
    UncertainPose,
    adjoint,
    chain,
    default_motion_covariance,
    difference,
    link_from_motion,
    moved,
)
from visloc.pose.reprojection import MatchedView, project
from visloc.sequences.pose_graph import Chain, solve_chain

RNG = np.random.default_rng(0)


def some_pose(size: float = 1.0) -> Pose:
    return Pose(Rotation.from_rotvec(RNG.normal(size=3)).as_matrix(), size * RNG.normal(size=3))


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 0.1, 3.0])
def test_difference_undoes_moved(size: float) -> None:
    change = np.array([0.3, -0.5, 0.81, 1.0, 2.0, 3.0]) * size
    pose = some_pose()
    assert difference(moved(pose, change), pose) == pytest.approx(change, rel=1e-9, abs=1e-15)


def test_adjoint_takes_a_change_through_a_pose() -> None:
    pose, change = some_pose(), 1e-6 * RNG.normal(size=6)
    inside = pose @ moved(Pose.identity(), change)
    assert difference(inside, pose) == pytest.approx(adjoint(pose) @ change, abs=1e-10)


def test_both_ways_to_state_a_covariance_describe_the_same_poses() -> None:
    pose = some_pose(100.0)
    root = RNG.normal(size=(6, 6)) * 1e-3
    uncertain = UncertainPose.from_additive(pose, root @ root.T)
    assert uncertain.additive() == pytest.approx(root @ root.T, rel=1e-2, abs=1e-4)
    samples = RNG.normal(size=(20000, 6)) @ root.T
    local = np.array(
        [
            difference(
                Pose(
                    Rotation.from_rotvec(s[:3]).as_matrix() @ pose.rotation,
                    pose.translation + s[3:],
                ),
                pose,
            )
            for s in samples[:4000]
        ]
    )
    assert uncertain.covariance == pytest.approx(
        np.cov(local.T), rel=0.1, abs=0.05 * uncertain.covariance.max()
    )


def test_a_chain_there_and_back_is_the_inverse() -> None:
    links = [UncertainPose(some_pose(), np.eye(6) * 1e-4) for _ in range(4)]
    there, back = chain(links, 1, 4), chain(links, 4, 1)
    assert difference(there.pose @ back.pose, Pose.identity()) == pytest.approx(np.zeros(6))
    assert back.inverse().covariance == pytest.approx(there.covariance)
    assert chain(links, 2, 2).covariance == pytest.approx(np.zeros((6, 6)))


def test_the_spread_of_a_chain_agrees_with_monte_carlo() -> None:
    std = np.array([1e-3] * 3 + [1e-2] * 3)
    links = [UncertainPose(some_pose(), np.diag(std**2)) for _ in range(3)]
    total = chain(links, 0, 3)
    errors = []
    for _ in range(3000):
        pose = Pose.identity()
        for link in links:
            pose = moved(link.pose, RNG.normal(size=6) * std) @ pose
        errors.append(difference(pose, total.pose))
    assert np.trace(np.linalg.solve(total.covariance, np.cov(np.array(errors).T))) == pytest.approx(
        6.0, abs=0.3
    )


def test_a_pose_between_two_measured_ones_is_their_weighted_mean() -> None:
    step = Pose(np.eye(3), np.array([0.0, 0.0, -1.0]))
    firm_in_rotation = np.diag([1e-12] * 3 + [1e-4] * 3)
    links = [UncertainPose(step, firm_in_rotation)] * 2
    ends = {
        0: UncertainPose(Pose.identity(), np.eye(6) * 1e-8),
        2: UncertainPose(Pose(np.eye(3), np.array([0.02, 0.0, -2.0])), np.eye(6) * 1e-8),
    }
    solved = solve_chain(Chain(links, ends, {}), [Pose.identity(), step, step @ step], 3.0, 1.0)
    assert solved is not None
    poses, covariances = solved
    assert poses[1].center == pytest.approx([-0.01, 0.0, 1.0], abs=1e-4)
    assert covariances[1][3, 3] == pytest.approx(0.5e-4, rel=0.01)


def test_motion_alone_leaves_the_poses_undetermined() -> None:
    links = [UncertainPose(some_pose(), np.eye(6) * 1e-4)]
    assert solve_chain(Chain(links, {}, {}), [Pose.identity(), links[0].pose], 3.0, 1.0) is None


def test_a_point_at_the_very_edge_of_a_fisheye_does_not_cost_the_poses() -> None:
    camera = Camera("OPENCV_FISHEYE", 640, 640, (200.0, 200.0, 320.0, 320.0, 0.0, 0.0, 0.0, 0.0))
    points = np.random.default_rng(4).uniform([-3.0, -3.0, 1.0], [3.0, 3.0, 5.0], (50, 3))
    found = []
    for seen in (points, np.vstack([points, [[5.0, 0.0, 2e-5]]])):
        view = MatchedView(camera, Pose.identity(), project(camera, seen), seen)
        link = UncertainPose(Pose.identity(), 1e-4 * np.eye(6))
        solved = solve_chain(Chain([link], {}, {0: [view]}), [Pose.identity()] * 2, 3.0, 1.0)
        assert solved is not None
        found.append(solved)
    assert np.array_equal(found[0][1], found[1][1])


def test_motion_that_says_nothing_is_no_link() -> None:
    motion = RelativeMotion(Pose.identity(), np.eye(6) * 1e-4)
    assert link_from_motion(motion) is not None
    assert link_from_motion(None) is None
    assert link_from_motion(RelativeMotion(Pose.identity(), np.eye(6))) is None


def test_the_default_covariance_grows_with_the_motion() -> None:
    turned = Rotation.from_rotvec([0.0, math.radians(10.0), 0.0]).as_matrix()
    covariance = default_motion_covariance(Pose(turned, np.array([2.0, 0.0, 0.0])))
    std = np.sqrt(np.diag(covariance))
    assert std[:3] == pytest.approx(np.full(3, math.radians(0.2 + 0.2)))
    assert std[3:] == pytest.approx(np.full(3, 0.01 + 0.04))
