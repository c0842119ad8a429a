from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mapping.anchor import Similarity, align_poses, align_positions
from visloc.evaluation import pose_error
from visloc.geometry import Pose

RANDOM = np.random.default_rng(0)
TRUE = Similarity(
    2.5, Rotation.from_rotvec([0.3, -1.0, 0.2]).as_matrix(), np.array([10.0, -4.0, 2.0])
)
CENTERS = RANDOM.uniform(-5, 5, (12, 3))


def test_positions_are_aligned_exactly_and_outliers_are_named() -> None:
    known = TRUE.apply(CENTERS)
    known[[2, 7]] += [30.0, 0.0, -20.0]
    found = align_positions(CENTERS, known, max_error=0.5)
    assert found is not None
    similarity, agrees = found
    assert np.flatnonzero(~agrees).tolist() == [2, 7]
    assert similarity.scale == pytest.approx(TRUE.scale)
    np.testing.assert_allclose(similarity.rotation, TRUE.rotation, atol=1e-9)
    np.testing.assert_allclose(similarity.translation, TRUE.translation, atol=1e-8)


@pytest.mark.parametrize(
    ("centers", "why"),
    [
        (CENTERS[:2], "two positions leave a rotation open"),
        (np.outer(np.arange(6.0), [1.0, 2.0, 3.0]), "the world could turn about a line"),
        (np.zeros((5, 3)), "one place says nothing of scale and rotation"),
    ],
)
def test_positions_that_do_not_fix_a_similarity_are_refused(
    centers: NDArray[np.float64], why: str
) -> None:
    assert align_positions(centers, TRUE.apply(centers), max_error=0.5) is None, why


def test_positions_that_contradict_each_other_are_refused() -> None:
    known = RANDOM.uniform(-50, 50, (12, 3))
    assert align_positions(CENTERS, known, max_error=1e-3) is None


def poses_at(centers: NDArray[np.float64]) -> list[Pose]:
    rotations = Rotation.random(len(centers), rng=1).as_matrix()
    return [Pose(r, -r @ c) for r, c in zip(rotations, centers, strict=True)]


@pytest.mark.parametrize("centers", [CENTERS, np.outer(np.arange(6.0), [1.0, 2.0, 3.0])])
def test_poses_are_brought_back_also_when_their_positions_lie_in_a_line(
    centers: NDArray[np.float64],
) -> None:
    moved = poses_at(centers)
    given = [TRUE.move(pose) for pose in moved]
    back = align_poses(moved, given)
    assert back.scale == pytest.approx(TRUE.scale)
    for pose, truth in zip(moved, given, strict=True):
        assert max(pose_error(back.move(pose), truth)) < 1e-9


def test_a_moved_pose_sees_moved_points_where_it_saw_them() -> None:
    pose = poses_at(CENTERS)[3]
    seen, seen_after = pose.apply(CENTERS), TRUE.move(pose).apply(TRUE.apply(CENTERS))
    np.testing.assert_allclose(seen_after, TRUE.scale * seen, atol=1e-12)
