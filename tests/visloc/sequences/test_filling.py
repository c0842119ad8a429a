from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.geometry import Pose, center_covariance, covariance_from_center, rotation_angle
from visloc.kapture import read_dataset
from visloc.sequences.filling import (
    TimeUnit,
    TracedPose,
    fill_rig,
    fill_sequence,
    guess_time_unit,
    interpolate_pose,
)
from visloc.types import PoseSource, Uncertainty

# The 99.73 % (3 sigma) quantile of the chi-square distribution with 6 degrees of freedom.
THREE_SIGMA_OF_SIX = 20.06

numbers = st.floats(-1, 1)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
quaternions = st.tuples(numbers, numbers, numbers, numbers).filter(
    lambda q: np.linalg.norm(q) > 1e-3
)
poses = st.builds(Pose.from_quaternion, quaternions, vectors.map(lambda v: 1000 * v))
seeds = st.integers(0, 2**32 - 1)


def exp(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rodrigues' formula."""
    angle = float(np.linalg.norm(w))
    x, y, z = w / angle if angle > 0 else w
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: NDArray[np.float64] = (
        np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    )
    return rotation


def log(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of a rotation by much less than a half turn."""
    r = rotation
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine = float(np.linalg.norm(axis)) / 2
    return np.asarray(axis / 2 * (rotation_angle(r) / sine if sine > 0 else 1.0))


def at(center: NDArray[np.float64], rotation: NDArray[np.float64]) -> Pose:
    return Pose(rotation, -rotation @ center)


def moved(pose: Pose, error: NDArray[np.float64]) -> Pose:
    """R <- Exp(w) R, t <- t + dt."""
    return Pose(exp(error[:3]) @ pose.rotation, pose.translation + error[3:])


def difference(pose: Pose, other: Pose) -> NDArray[np.float64]:
    """(w, dt) that moves ``other`` to ``pose``."""
    w = log(pose.rotation @ other.rotation.T)
    return np.concatenate([w, pose.translation - other.translation])


def squared_sigmas(true: Pose, filled: TracedPose) -> float:
    """Squared error in units of its covariance; about 6 when that is right.

    Of the centre, not of t: that far from the origin and for large angles, t is not linear in w.
    """
    w = log(true.rotation @ filled.pose.rotation.T)
    error = np.concatenate([w, true.center - filled.pose.center])
    covariance = center_covariance(filled.pose, filled.covariance)
    return float(error @ np.linalg.solve(covariance, error))


def covariances(seed: int, scale: float = 1e-3) -> NDArray[np.float64]:
    """Correlated, and of different spread along every direction."""
    half = np.random.default_rng(seed).normal(size=(6, 6)) * scale
    covariance: NDArray[np.float64] = half @ half.T + (0.1 * scale) ** 2 * np.eye(6)
    return covariance


def traced(
    pose: Pose, seed: int = 0, source: PoseSource = PoseSource.ESTIMATED, num_inliers: int = 50
) -> TracedPose:
    return TracedPose(pose, covariances(seed), source, Uncertainty.WHOLE, num_inliers)


def smallest_eigenvalue(covariance: NDArray[np.float64]) -> float:
    scale = np.sqrt(np.abs(np.diag(covariance)))
    return float(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0])


def assert_covariance(covariance: NDArray[np.float64]) -> None:
    np.testing.assert_array_equal(covariance, covariance.T)
    assert smallest_eigenvalue(covariance) > 0


def in_world(device: TracedPose) -> NDArray[np.float64]:
    """Covariance of the rotation and the centre, both along the world's axes."""
    to_world = np.eye(6)
    to_world[:3, :3] = device.pose.rotation.T
    covariance: NDArray[np.float64] = (
        to_world @ center_covariance(device.pose, device.covariance) @ to_world.T
    )
    return covariance


# --- the unit of time


@pytest.mark.parametrize("unit", TimeUnit)
@pytest.mark.parametrize("unix_s", [1_000_000_000, 1_764_000_000, 4_000_000_000])
def test_the_unit_of_unix_times_shows_in_their_size(unit: TimeUnit, unix_s: int) -> None:
    steps = round(1 / unit.seconds)
    assert guess_time_unit([unix_s * steps, (unix_s + 1) * steps + 7]) is unit


@pytest.mark.parametrize(
    "timestamps",
    [
        [],
        [0, 100, 200],
        [0],
        [100, 300, 500, 4900],
        [-1_764_000_000],
        [900_000_000],  # 1998
        [5_000_000_000],  # 2128 in seconds, 1970 in milliseconds
        [1_764_000_000, 1_764_000_000_000],
        [0, 1_764_000_000],
        [10**30],
    ],
)
def test_a_unit_that_cannot_be_told_is_not_guessed(timestamps: list[int]) -> None:
    assert guess_time_unit(timestamps) is None


@given(timestamps=st.lists(st.integers(-(10**20), 10**20)))
def test_the_guess_does_not_depend_on_order_and_every_timestamp_agrees(
    timestamps: list[int],
) -> None:
    unit = guess_time_unit(timestamps)
    assert guess_time_unit(timestamps[::-1]) is unit
    assert unit is None or {guess_time_unit([each]) for each in timestamps} == {unit}


# --- interpolation


@given(a=poses, b=poses)
def test_the_ends_of_an_interpolation_are_the_poses_themselves(a: Pose, b: Pose) -> None:
    for share, end in ((0.0, a), (1.0, b)):
        pose = interpolate_pose(a, b, share)
        np.testing.assert_allclose(pose.rotation, end.rotation, atol=1e-13)
        np.testing.assert_allclose(pose.center, end.center, atol=1e-9)


@given(a=poses, b=poses, share=st.floats(0, 1))
def test_the_way_is_straight_even_and_the_shortest(a: Pose, b: Pose, share: float) -> None:
    pose = interpolate_pose(a, b, share)
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(pose.center, (1 - share) * a.center + share * b.center, atol=1e-9)
    whole = rotation_angle(b.rotation @ a.rotation.T)
    assert rotation_angle(pose.rotation @ a.rotation.T) == pytest.approx(share * whole, abs=1e-7)
    assert rotation_angle(b.rotation @ pose.rotation.T) == pytest.approx(
        (1 - share) * whole, abs=1e-7
    )


@given(a=poses, b=poses, share=st.floats(0, 1))
def test_an_interpolation_read_backwards_is_the_same(a: Pose, b: Pose, share: float) -> None:
    angle = rotation_angle(b.rotation @ a.rotation.T)
    if angle > math.pi - 1e-3:
        return  # both ways round are as short
    there, back = interpolate_pose(a, b, share), interpolate_pose(b, a, 1 - share)
    np.testing.assert_allclose(there.rotation, back.rotation, atol=1e-9)
    np.testing.assert_allclose(there.center, back.center, atol=1e-9)


@pytest.mark.parametrize("angle", [math.pi - 1e-3, math.pi - 1e-7, 1e-3, 1e-9, 1e-160, 0.0])
@pytest.mark.parametrize("start", [0.0, 1.0, 3.0, 3.141, 5.0])
def test_rotations_of_nearly_a_half_turn_and_of_nearly_none(angle: float, start: float) -> None:
    # Starting from 1.0 on, the quaternion of one end has its sign turned to keep w >= 0.
    axis = np.array([1.0, -2.0, 3.0]) / math.sqrt(14)
    a, b = (Pose(exp(turn * axis), np.zeros(3)) for turn in (start, start + angle))
    for share in (0.25, 0.5, 0.9):
        expected = exp((start + share * angle) * axis)
        np.testing.assert_allclose(
            interpolate_pose(a, b, share).rotation, expected, rtol=0, atol=1e-8
        )


def test_a_half_turn_goes_one_of_both_ways() -> None:
    a, b = Pose.identity(), Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    half_way = interpolate_pose(a, b, 0.5).rotation
    np.testing.assert_allclose(np.abs(log(half_way)), [math.pi / 2, 0, 0], atol=1e-12)


# --- along time


@pytest.mark.parametrize("origin", [0.0, 5e6])
def test_constant_velocity_and_constant_turn_are_filled_exactly(origin: float) -> None:
    def truth(t: float) -> Pose:
        center = origin + np.array([1.0, 2.0, -0.5]) * t
        return at(center, exp(np.array([0.3, -1.1, 0.4]) * t) @ exp(np.array([2.0, 1.0, 0.0])))

    times = [0.1 * i for i in range(41)]
    known = {0, 1, 7, 20, 21, 40}
    given_poses = [traced(truth(t)) if i in known else None for i, t in enumerate(times)]
    filled = fill_sequence(times, given_poses, max_gap_s=1.9)
    for time, pose in zip(times, filled, strict=True):
        assert pose is not None
        position_error, orientation_error = pose_error(pose.pose, truth(time))
        assert position_error < 1e-12 * max(origin, 1) * 5
        assert orientation_error < 1e-9


def test_turning_on_the_spot_does_not_move_the_centre() -> None:
    # Interpolating t instead would: here by more than half of the 100 m to the origin.
    center = np.array([100.0, 0.0, 0.0])
    ends = [traced(at(center, exp(np.array([0, 0, w])))) for w in (0.0, 2.8)]
    filled = fill_sequence([0, 1, 2], [ends[0], None, ends[1]], max_gap_s=2)
    assert filled[1] is not None
    np.testing.assert_allclose(filled[1].pose.center, center, atol=1e-12)


def line(*known: float, source: PoseSource = PoseSource.ESTIMATED) -> dict[float, TracedPose]:
    return {t: traced(at(np.array([t, 0, 0]), np.eye(3)), source=source) for t in known}


def sources(times: list[float], known: dict[float, TracedPose], max_gap_s: float) -> list[str]:
    filled = fill_sequence(times, [known.get(t) for t in times], max_gap_s)
    return ["-" if pose is None else pose.source.value[0] for pose in filled]


@pytest.mark.parametrize(
    ("max_gap_s", "expected"),
    [
        # known:  1 and 3, then 9
        (0.0, "-e-e-----e--"),
        (0.5, "-e-e-----e--"),
        (1.0, "nenen---nen-"),
        (2.0, "neienn-nnenn"),
        (5.9, "neiennnnnenn"),
        (6.0, "neieiiiiienn"),
    ],
)
def test_gaps_are_interpolated_or_take_the_nearest_and_never_beyond_the_limit(
    max_gap_s: float, expected: str
) -> None:
    times = [float(t) for t in range(12)]
    assert "".join(sources(times, line(1, 3, 9), max_gap_s)) == expected


def test_filled_poses_fill_no_others() -> None:
    # 0 1 2 3: were 1, filled from 0, a neighbour, 2 would be within reach of it.
    assert sources([0.0, 1.0, 2.0, 3.0], line(0), 1.0) == ["e", "n", "-", "-"]


@pytest.mark.parametrize("source", PoseSource)
def test_whatever_was_posed_on_input_is_a_neighbour_and_stays(source: PoseSource) -> None:
    known = line(0, 2, source=source)
    filled = fill_sequence([0.0, 1.0, 2.0], [known[0], None, known[2]], 2.0)
    assert filled[0] is known[0]
    assert filled[2] is known[2]
    assert filled[1] is not None
    assert filled[1].source is PoseSource.INTERPOLATED
    assert filled[1].num_inliers == 0


def test_the_nearest_pose_is_repeated_and_of_two_as_near_the_earlier() -> None:
    known = line(0, 4)
    filled = fill_sequence([0.0, 1.0, 2.0, 3.0, 4.0], [known[0], None, None, None, known[4]], 3.0)
    assert [pose and pose.pose for pose in filled[1:4]] == [
        known[0].pose,
        known[0].pose,
        known[4].pose,
    ]
    assert {pose.source for pose in filled[1:4] if pose} == {PoseSource.NEAREST}
    assert {pose.num_inliers for pose in filled[1:4] if pose} == {0}


def test_a_gap_of_exactly_the_limit_counts_with_unix_times_too() -> None:
    # 0.4 s apart, but 0.40000009 s as floats.
    times = [1_764_000_000.3, 1_764_000_000.5, 1_764_000_000.7]
    assert times[2] - times[0] > 0.4
    known = line(times[0], times[2])
    assert sources(times, known, 0.4) == ["e", "i", "e"]
    assert sources(times, known, 0.399) == ["e", "n", "e"]


def test_nothing_to_fill_and_nothing_to_fill_from() -> None:
    assert fill_sequence([], [], 1.0) == []
    assert fill_sequence([5.0], [None], 1.0) == [None]
    assert fill_sequence([0.0, 1.0], [None, None], 1.0) == [None, None]


@pytest.mark.parametrize(
    ("times", "field"),
    [
        ([0.0, 0.0], "times_s[1]"),
        ([0.0, 2.0, 1.0], "times_s[2]"),
        ([0.0, math.nan], "times_s[1]"),
        ([math.nan], "times_s[0]"),
        ([0.0, 1.0, math.inf], "times_s[2]"),
    ],
)
@pytest.mark.parametrize("max_gap_s", [0.0, 1.0])
def test_times_that_repeat_or_go_backwards_are_refused(
    times: list[float], field: str, max_gap_s: float
) -> None:
    with pytest.raises(InvalidInput) as refusal:
        fill_sequence(times, [None] * len(times), max_gap_s)
    assert refusal.value.code == "sequence.timestamps"
    assert refusal.value.field == field


@pytest.mark.parametrize("max_gap_s", [-0.1, math.nan, math.inf])
def test_a_gap_that_is_no_duration_is_refused(max_gap_s: float) -> None:
    with pytest.raises(InvalidInput) as refusal:
        fill_sequence([0.0], [None], max_gap_s)
    assert refusal.value.code == "sequence.max_gap"


@given(
    steps=st.lists(st.integers(1, 20), max_size=12),
    data=st.data(),
    max_gap=st.integers(0, 40),
)
def test_every_filled_instant_has_a_measured_one_within_the_gap(
    steps: list[int], data: st.DataObject, max_gap: int
) -> None:
    times = [float(t) for t in np.cumsum(steps)]
    known = data.draw(st.lists(st.booleans(), min_size=len(times), max_size=len(times)))
    given_poses = [
        traced(at(np.array([t, 0, 0]), np.eye(3)), seed=i) if is_known else None
        for i, (t, is_known) in enumerate(zip(times, known, strict=True))
    ]
    filled = fill_sequence(times, given_poses, max_gap)
    assert len(filled) == len(times)
    for time, before, after in zip(times, given_poses, filled, strict=True):
        away = min(
            (abs(time - t) for t, is_known in zip(times, known, strict=True) if is_known),
            default=math.inf,
        )
        if before is not None:
            assert after is before
        elif after is not None:
            assert away <= max_gap
            assert after.source in (PoseSource.INTERPOLATED, PoseSource.NEAREST)
            assert_covariance(after.covariance)
        else:
            assert max_gap == 0 or away > max_gap


# --- how uncertain a filled instant is


@given(pose=poses, seed=seeds)
def test_covariances_of_centre_and_translation_are_each_others_inverse(
    pose: Pose, seed: int
) -> None:
    covariance = covariances(seed)
    there = center_covariance(pose, covariance)
    back = covariance_from_center(pose, there)
    size = np.sqrt(np.outer(np.diag(there), np.diag(there))).max()
    np.testing.assert_allclose(back, covariance, atol=1e-12 * max(size, 1))


@given(pose=poses, seed=seeds)
def test_the_covariance_of_the_centre_follows_from_how_it_moves(pose: Pose, seed: int) -> None:
    step = 1e-5
    jacobian = np.eye(6)
    for i, unit in enumerate(np.eye(6)):
        shift = moved(pose, step * unit).center - moved(pose, -step * unit).center
        jacobian[3:, i] = shift / (2 * step)
    expected = jacobian @ covariances(seed) @ jacobian.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(
        center_covariance(pose, covariances(seed)) / scale, expected / scale, atol=1e-5
    )


def test_a_centre_is_known_as_well_far_from_the_origin_as_near() -> None:
    shape = np.diag([1e-6] * 3 + [1e-4, 4e-4, 9e-4])
    pose = at(np.array([5e5, 5e6, 100.0]), exp(np.array([0.3, 0.2, -1.0])))
    again = center_covariance(pose, covariance_from_center(pose, shape))
    np.testing.assert_allclose(np.diag(again), np.diag(shape), rtol=1e-3)


@given(
    a=poses,
    turn=vectors,
    shift=vectors,
    seed=seeds,
    share=st.floats(0.01, 0.99),
    wide=st.floats(0.01, 100),
)
def test_an_interpolated_pose_is_less_certain_than_both_its_neighbours(
    a: Pose,
    turn: NDArray[np.float64],
    shift: NDArray[np.float64],
    seed: int,
    share: float,
    wide: float,
) -> None:
    b = at(a.center + shift, exp(turn) @ a.rotation)
    ends = (
        traced(a, seed),
        TracedPose(b, wide * covariances(seed + 1), PoseSource.ESTIMATED, Uncertainty.WHOLE),
    )
    _, filled, _ = fill_sequence([0, share, 1], [ends[0], None, ends[1]], max_gap_s=1)
    assert filled is not None
    assert_covariance(filled.covariance)
    # Rotations differ between the frames of the devices; their uncertainty is compared there.
    for end in ends:
        to_filled = np.eye(6)
        to_filled[:3, :3] = filled.pose.rotation @ end.pose.rotation.T
        own = to_filled @ center_covariance(end.pose, end.covariance) @ to_filled.T
        excess = center_covariance(filled.pose, filled.covariance) - own
        assert np.linalg.eigvalsh(excess)[0] > 0


def test_errors_of_independent_neighbours_do_not_exceed_the_covariance() -> None:
    """What a half turn nearly does to the interpolated rotation is covered too."""
    a = at(np.array([3.0, -2.0, 1.0]), exp(np.array([0.5, 0.1, -0.3])))
    for angle in (0.1, 1.5, 3.0):
        b = at(np.array([3.5, -2.0, 1.0]), exp(np.array([0.0, angle, 0.0])) @ a.rotation)
        ends = (traced(a, 1), traced(b, 2))
        for share in (0.1, 0.5, 0.8):
            jacobian = np.zeros((6, 12))
            for i, unit in enumerate(1e-5 * np.eye(12)):
                plus, minus = (
                    interpolate_pose(moved(a, s * unit[:6]), moved(b, s * unit[6:]), share)
                    for s in (1, -1)
                )
                jacobian[:, i] = difference(plus, minus) / 2e-5
            both = np.zeros((12, 12))
            both[:6, :6], both[6:, 6:] = (end.covariance for end in ends)
            _, filled, _ = fill_sequence([0, share, 1], [ends[0], None, ends[1]], max_gap_s=1)
            assert filled is not None
            excess = filled.covariance - jacobian @ both @ jacobian.T
            assert smallest_eigenvalue(excess) > 0


def test_the_doubt_about_an_interpolated_pose_grows_towards_the_middle_and_with_the_gap() -> None:
    def stds(gap: float, share: float) -> tuple[float, float]:
        known = line(0, gap)
        end = covariance_from_center(known[gap].pose, in_world(known[0]))  # as sure as the start
        ends = (known[0], None, replace(known[gap], covariance=end))
        _, filled, _ = fill_sequence([0, share * gap, gap], ends, max_gap_s=gap)
        assert filled is not None
        added = in_world(filled) - in_world(known[0])
        return math.sqrt(added[0, 0]), math.sqrt(added[3, 3])

    # (a / 2) (t - t_a) (t_b - t) with 1 rad/s^2 and 2 m/s^2
    assert stds(0.4, 0.5) == pytest.approx((0.02, 0.04))
    assert stds(0.4, 0.25) == pytest.approx((0.015, 0.03))
    assert stds(0.8, 0.5) == pytest.approx((0.08, 0.16))
    # ... and not more than at 0.5 rad/s and 1.4 m/s from the nearer end.
    assert stds(20.0, 0.1) == pytest.approx((1.0, 2.8))
    assert stds(20.0, 0.9) == pytest.approx((1.0, 2.8))
    assert stds(60.0, 0.5) == pytest.approx((math.pi / math.sqrt(3), 42.0))


@pytest.mark.parametrize("turned", [0.2, 1.0, 3.0])
def test_the_doubt_in_a_bend_covers_the_arc_beside_the_chord(turned: float) -> None:
    def on_the_arc(angle: float) -> Pose:
        forward = np.array([math.sin(angle), 1 - math.cos(angle), 0.0])
        return at(15.0 * forward, exp(np.array([0, 0, -angle])))

    seconds = turned * 1.5  # at 10 m/s
    ends = [traced(on_the_arc(angle)) for angle in (0.0, turned)]
    for share in (0.2, 0.5, 0.7):
        times = [0.0, share * seconds, seconds]
        _, filled, _ = fill_sequence(times, [ends[0], None, ends[1]], max_gap_s=seconds)
        assert filled is not None
        away = np.linalg.norm(filled.pose.center - on_the_arc(share * turned).center)
        added = in_world(filled) - in_world(ends[0])
        assert away < 1.2 * math.sqrt(added[3:, 3:].diagonal().min())
    assert away > 0.02 * turned**2


@pytest.mark.parametrize(
    ("known", "away", "expected_m"),
    [
        ((0.0,), 0.5, 5.0),  # nothing tells the speed: 10 m/s
        ((-9.0, 0.0), 0.5, 0.7),  # 1 m/s, but a walk is 1.4 m/s
        ((-9.0, -8.0, 0.0), 0.5, 0.7),
    ],
)
def test_the_doubt_about_the_nearest_pose_grows_with_time(
    known: tuple[float, ...], away: float, expected_m: float
) -> None:
    on_line = line(*known)
    *_, filled = fill_sequence([*known, away], [*on_line.values(), None], max_gap_s=1)
    assert filled is not None
    assert filled.source is PoseSource.NEAREST
    added = in_world(filled) - in_world(on_line[0.0])
    expected = np.diag([(0.5 * away) ** 2] * 3 + [expected_m**2] * 3)
    np.testing.assert_allclose(added, expected, atol=1e-12)


def test_the_doubt_about_the_nearest_pose_knows_how_fast_the_device_was() -> None:
    def driving(t: float) -> TracedPose:
        return traced(at(np.array([20.0 * t, 5e4, 0]), exp(np.array([0, 0, 2.0 * t]))))

    times = [0.0, 0.2, 0.4]
    *_, filled = fill_sequence(times, [driving(0.0), driving(0.2), None], max_gap_s=1)
    assert filled is not None
    added = in_world(filled) - in_world(driving(0.2))
    np.testing.assert_allclose(np.sqrt(np.diag(added)), [0.4] * 3 + [4.0] * 3, rtol=1e-6)


def car(t: float) -> Pose:
    """10 m/s through a bend of 15 m, somewhere in a large world."""
    angle = 10.0 / 15.0 * t
    center = np.array([300.0, -200.0, 5.0]) + 15.0 * np.array(
        [math.sin(angle), 1 - math.cos(angle), 0]
    )
    return at(center, exp(np.array([0, 0, -angle])))


def walker(t: float) -> Pose:
    """1.4 m/s with two steps a second: the head goes up and down, to and fro and looks about."""
    sway = math.sin(2 * math.pi * t)
    bob = math.sin(4 * math.pi * t)
    center = np.array([1.4 * t, 0.03 * sway, 1.7 + 0.02 * bob])
    return at(center, exp(np.array([0.02 * bob, 0.02 * sway, 0.6 * math.sin(1.1 * t)])))


@pytest.mark.parametrize(
    ("truth", "gap_s"), [(car, 0.4), (car, 1.0), (walker, 0.2), (walker, 0.5), (walker, 2.0)]
)
@pytest.mark.parametrize("source", [PoseSource.INTERPOLATED, PoseSource.NEAREST])
def test_the_truth_is_within_three_sigma(
    truth: Callable[[float], Pose], gap_s: float, source: PoseSource
) -> None:
    draw = np.random.default_rng(5)
    noise = np.diag([math.radians(0.1) ** 2] * 3 + [0.02**2] * 3)
    squares = []
    for _ in range(400):
        start = draw.uniform(0, 3)
        share = draw.uniform(0.05, 0.95)
        if source is PoseSource.INTERPOLATED:
            times = [start, start + share * gap_s, start + gap_s]
            hidden = 1
        else:
            times = [start, start + gap_s, start + gap_s + share * gap_s]
            hidden = 2
        measured = []
        for time in times:
            pose = truth(time)
            covariance = covariance_from_center(pose, noise)
            error = np.linalg.cholesky(covariance) @ draw.normal(size=6)
            measured.append(
                TracedPose(moved(pose, error), covariance, PoseSource.ESTIMATED, Uncertainty.WHOLE)
            )
        filled = fill_sequence(
            times, [None if i == hidden else p for i, p in enumerate(measured)], gap_s
        )[hidden]
        assert filled is not None
        assert filled.source is source
        squares.append(squared_sigmas(truth(times[hidden]), filled))
    assert np.mean(np.array(squares) < THREE_SIGMA_OF_SIX) >= 0.95
    # ... and the doubt says something: the errors are not lost in it.
    assert np.mean(squares) > 0.3


def test_a_thousand_instants_are_filled_at_once() -> None:
    known = random.Random(0).sample(range(1000), 300)
    given_poses = [traced(car(0.1 * i)) if i in known else None for i in range(1000)]
    filled = fill_sequence([0.1 * i for i in range(1000)], given_poses, max_gap_s=10)
    assert all(filled)


def test_a_real_bend_with_every_second_instant_lost(shared_data: Path) -> None:
    trajectory = sorted(read_dataset(shared_data / "kitti_curve" / "query").trajectories.items())
    times = [timestamp / 1000 for (timestamp, _), _ in trajectory]
    truth = [pose for _, pose in trajectory]
    small = np.diag([math.radians(0.04) ** 2] * 3 + [0.008**2] * 3)
    known = [
        TracedPose(
            pose, covariance_from_center(pose, small), PoseSource.ESTIMATED, Uncertainty.WHOLE
        )
        if i % 2 == 0
        else None
        for i, pose in enumerate(truth)
    ]
    filled = fill_sequence(times, known, max_gap_s=0.4)
    errors, squares = [], []
    for pose, true in list(zip(filled, truth, strict=True))[1::2]:
        assert pose is not None
        assert pose.source is PoseSource.INTERPOLATED
        errors.append(pose_error(pose.pose, true))
        squares.append(squared_sigmas(true, pose))
    assert len(errors) == 12
    position_m, orientation_deg = np.median(errors, axis=0)
    assert position_m < 0.09
    assert orientation_deg < 0.25
    assert max(squares) < THREE_SIGMA_OF_SIX


# --- along a rig

RIG = {
    "left": Pose.identity(),
    "right": at(np.array([0.5, 0, 0]), exp(np.array([0.01, 0.02, -0.01]))),
    "back": at(np.array([0.1, 0.2, -2.0]), exp(np.array([0.1, 3.0, -0.2]))),
}
RIG_POSE = at(np.array([100.0, -40.0, 2.0]), exp(np.array([1.0, -0.4, 0.7])))


def seen_by(sensor: str, num_inliers: int = 50) -> TracedPose:
    return traced(RIG[sensor] @ RIG_POSE, seed=len(sensor), num_inliers=num_inliers)


@pytest.mark.parametrize("giver", RIG)
def test_one_camera_gives_all_cameras_of_its_rig_their_exact_pose(giver: str) -> None:
    instant = {sensor: seen_by(sensor) if sensor == giver else None for sensor in RIG}
    filled = fill_rig(instant, RIG)
    assert list(filled) == list(RIG)
    assert filled[giver] is instant[giver]
    for sensor in set(RIG) - {giver}:
        pose = filled[sensor]
        assert pose is not None
        assert pose.source is PoseSource.RIG
        assert pose.num_inliers == 0
        np.testing.assert_allclose(
            pose.pose.rotation, (RIG[sensor] @ RIG_POSE).rotation, atol=1e-14
        )
        np.testing.assert_allclose(pose.pose.center, (RIG[sensor] @ RIG_POSE).center, atol=1e-12)


@pytest.mark.parametrize(
    ("inliers", "giver"),
    [
        ({"a": 31, "z": 300}, "z"),
        ({"z": 31, "a": 300}, "a"),
        ({"z": 40, "a": 40, "k": 40}, "a"),  # of equals the first by name
        ({"z": 40, "a": 39, "k": 40}, "k"),
    ],
)
def test_the_camera_with_most_inliers_gives(inliers: dict[str, int], giver: str) -> None:
    # With every camera at the same place, the pose shows whose it was.
    instant: dict[str, TracedPose | None] = {"lost": None}
    for i, (sensor, count) in enumerate(inliers.items()):
        instant[sensor] = traced(at(np.array([i, 0.0, 0.0]), np.eye(3)), num_inliers=count)
    filled = fill_rig(instant, dict.fromkeys(instant, Pose.identity()))
    given_pose, best = filled["lost"], instant[giver]
    assert given_pose is not None
    assert best is not None
    np.testing.assert_array_equal(given_pose.pose.center, best.pose.center)


@pytest.mark.parametrize("source", sorted(set(PoseSource) - {PoseSource.ESTIMATED}))
def test_only_measured_poses_are_given_on(source: PoseSource) -> None:
    instant = {"left": replace(seen_by("left"), source=source), "right": None}
    assert fill_rig(instant, RIG) == instant


def test_cameras_that_the_rig_lacks_neither_give_nor_take() -> None:
    stranger = traced(Pose.identity(), num_inliers=1000)
    filled = fill_rig(
        {"phone": stranger, "other": None, "left": seen_by("left"), "right": None}, RIG
    )
    assert filled["phone"] is stranger
    assert filled["other"] is None
    assert filled["right"] is not None
    np.testing.assert_allclose(filled["right"].pose.center, (RIG["right"] @ RIG_POSE).center)
    assert fill_rig({"phone": stranger, "left": None}, RIG)["left"] is None


def test_an_instant_without_any_pose_or_camera_stays_so() -> None:
    assert fill_rig({"left": None, "right": None}, RIG) == {"left": None, "right": None}
    assert fill_rig({}, RIG) == {}


def test_a_rig_does_not_change_what_it_was_given() -> None:
    instant = {"left": seen_by("left"), "right": None}
    fill_rig(instant, RIG)
    assert instant["right"] is None


@given(giver=poses, lever=poses, seed=seeds)
def test_the_covariance_goes_along_the_rig_as_numerical_derivatives_say(
    giver: Pose, lever: Pose, seed: int
) -> None:
    """What is left when the derivatives' part is taken off is the calibration's own error."""
    start = traced(giver, seed)
    cams = {"a": Pose.identity(), "b": lever}
    filled = fill_rig({"a": start, "b": None}, cams)["b"]
    assert filled is not None
    step = 1e-5
    jacobian = np.column_stack(
        [
            (
                difference(lever @ moved(giver, step * unit), filled.pose)
                - difference(lever @ moved(giver, -step * unit), filled.pose)
            )
            / (2 * step)
            for unit in np.eye(6)
        ]
    )
    expected = jacobian @ start.covariance @ jacobian.T
    distance = float(np.linalg.norm(lever.center))
    calibration = np.diag([math.radians(0.2) ** 2] * 3 + [(0.005 + 0.01 * distance) ** 2] * 3)
    expected += covariance_from_center(filled.pose, calibration)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(filled.covariance / scale, expected / scale, atol=1e-6)


@given(seed=seeds)
def test_a_camera_filled_from_the_rig_is_less_certain_than_its_giver(seed: int) -> None:
    start = traced(RIG_POSE, seed)
    filled = fill_rig({"left": start, "right": None, "back": None}, RIG)
    for sensor in ("right", "back"):
        pose = filled[sensor]
        assert pose is not None
        assert_covariance(pose.covariance)
        # In the world's axes, and of the point where the giver is, both tell of the same thing.
        back = TracedPose(
            RIG[sensor].inverse() @ pose.pose, np.eye(6), PoseSource.RIG, Uncertainty.WHOLE
        )
        turn = np.kron(np.eye(2), RIG[sensor].rotation.T)
        same = replace(back, covariance=turn @ pose.covariance @ turn.T)
        excess = in_world(same) - in_world(start)
        assert np.linalg.eigvalsh(excess)[0] > 0


def test_rig_then_sequence_fills_what_neither_fills_alone() -> None:
    # The left camera sees at the start, the right one at the end.
    start = fill_rig({"left": seen_by("left"), "right": None}, RIG)
    end = fill_rig({"left": None, "right": seen_by("right")}, RIG)
    filled = fill_sequence([0, 1, 2], [start["left"], None, end["left"]], max_gap_s=2)
    assert [pose and pose.source for pose in filled] == ["estimated", "interpolated", "rig"]


@pytest.mark.parametrize("second", Uncertainty)
@pytest.mark.parametrize("first", Uncertainty)
def test_a_filled_pose_is_whole_only_if_all_are_that_it_comes_from(
    first: Uncertainty, second: Uncertainty
) -> None:
    a, b = (
        replace(traced(Pose(np.eye(3), np.array([x, 0.0, 0.0]))), uncertainty=uncertainty)
        for x, uncertainty in ((0.0, first), (1.0, second))
    )
    _, between, _, after = fill_sequence([0.0, 0.5, 1.0, 1.5], [a, None, b, None], 1.0)

    assert between is not None
    assert after is not None
    whole = first is second is Uncertainty.WHOLE
    assert between.uncertainty is (Uncertainty.WHOLE if whole else Uncertainty.PHOTO_ONLY)
    assert after.uncertainty is second
    rig = {name: Pose.identity() for name in ("left", "right")}
    beside = fill_rig({"left": a, "right": None}, rig)["right"]
    assert beside is not None
    assert beside.uncertainty is first
