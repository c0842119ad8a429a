"""A stereo rig drives a bend between walls; the geometry is exact but for the noise added to it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose, covariance_from_center
from visloc.options import PRESETS, RegistrationPreset
from visloc.pose.covariance import pose_covariance
from visloc.pose.generalized import GeneralizedPose, refine_generalized_pose
from visloc.pose.motion import (
    PHOTO_ONLY,
    MapErrors,
    RelativeMotion,
    default_motion_covariance,
    position_covariance,
)
from visloc.pose.refinement import LOSS_SCALE_PX
from visloc.pose.reprojection import MatchedView, project
from visloc.sequences.window import WindowInstant, WindowPose, solve_window

GATE = PRESETS["default"]
CAMERA = Camera("PINHOLE", 1240, 376, (700.0, 700.0, 620.0, 188.0))
STEREO = (Pose.identity(), Pose(np.eye(3), np.array([-0.54, 0.0, 0.0])))
MONO = STEREO[:1]
RADIUS = 40.0
FORWARD = np.array([0.0, 0.0, 1.0])
Lie = Callable[[int, Pose], Pose]


def make_street(rng: np.random.Generator) -> NDArray[np.float64]:
    """Points (n, 3) on the walls of a bend, y down."""
    angle = rng.uniform(-0.3, 2.2, 6000)
    wall = np.where(rng.random(6000) < 0.5, rng.uniform(-8, -5, 6000), rng.uniform(5, 8, 6000))
    out = RADIUS + wall
    y = rng.uniform(-5, 1.6, 6000)
    return np.column_stack([RADIUS - out * np.cos(angle), y, out * np.sin(angle)])


def make_drive(count: int) -> list[Pose]:
    """True ``rig_from_world``, 2 m apart."""
    poses = []
    for angle in np.arange(count) * 2.0 / RADIUS:
        center = RADIUS * np.array([1.0 - math.cos(angle), 0.0, math.sin(angle)])
        rotation = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix().T
        poses.append(Pose(rotation, -rotation @ center))
    return poses


def look(
    rng: np.random.Generator,
    street: NDArray[np.float64],
    rig_from_world: Pose,
    right: int,
    wrong: int,
    rig: Sequence[Pose] = STEREO,
) -> tuple[MatchedView, ...]:
    """Views with so many right correspondences, 1 px of noise, and so many wrong ones."""
    views = []
    for cam_from_rig in rig:
        seen = (cam_from_rig @ rig_from_world).apply(street)
        pixels = project(CAMERA, seen)
        inside = ((pixels > 0) & (pixels < [CAMERA.width, CAMERA.height])).all(axis=1)
        near = np.flatnonzero(inside & (np.linalg.norm(seen, axis=1) < 50.0))
        chosen = rng.choice(near, right, replace=False)
        other = rng.choice(len(street), wrong, replace=False)
        views.append(
            MatchedView(
                CAMERA,
                cam_from_rig,
                np.vstack(
                    [
                        pixels[chosen] + rng.normal(size=(right, 2)),
                        rng.uniform(0, [CAMERA.width, CAMERA.height], (wrong, 2)),
                    ]
                ),
                street[np.concatenate([chosen, other])],
            )
        )
    return tuple(views)


def measure(views: Sequence[MatchedView], near: Pose) -> GeneralizedPose:
    """The pose of an instant on its own, as RANSAC would have found it, in less time."""
    pose = refine_generalized_pose(views, near, max_error_px=GATE.max_error_px)
    assert pose is not None
    assert pose.num_inliers >= GATE.min_inliers
    return pose


def make_motion(
    rng: np.random.Generator, true: Pose, share: float = 0.01, degrees: float = 0.1
) -> RelativeMotion:
    """The true motion with noise per axis: a share of the distance, and an angle."""
    shift, turn = share * float(np.linalg.norm(true.translation)), math.radians(degrees)
    rotation = Rotation.from_rotvec(rng.normal(size=3) * turn).as_matrix()
    pose = Pose(rotation @ true.rotation, true.translation + rng.normal(size=3) * shift)
    return RelativeMotion(pose, np.diag([turn**2] * 3 + [shift**2] * 3))


def make_window(
    seed: int,
    count: int,
    anchors: Sequence[int],
    *,
    lie: Lie = lambda _, motion: motion,
    share: float = 0.01,
    degrees: float = 0.1,
    matches: int = 100,
    look_alike: Sequence[int] = (),
) -> tuple[list[Pose], list[WindowInstant], list[RelativeMotion | None]]:
    """Truth, instants of which only ``anchors`` see anything right, and motions."""
    rng = np.random.default_rng(seed)
    street, truth = make_street(rng), make_drive(count)
    elsewhere = Pose(np.eye(3), np.array([3.0, 0.0, 0.5]))
    instants = []
    for i, pose in enumerate(truth):
        if i in anchors:
            seen_from = pose @ elsewhere if i in look_alike else pose
            views = look(rng, street, seen_from, matches * 2 // 3, matches // 3)
            instants.append(WindowInstant(views, measure(views, seen_from)))
        else:
            instants.append(WindowInstant(look(rng, street, pose, 0, matches), None))
    motions: list[RelativeMotion | None] = []
    for i in range(count - 1):
        motion = make_motion(rng, truth[i + 1] @ truth[i].inverse(), share, degrees)
        motions.append(replace(motion, current_from_previous=lie(i, motion.current_from_previous)))
    return truth, instants, motions


def solve(
    instants: Sequence[WindowInstant],
    motions: Sequence[RelativeMotion | None],
    registration: RegistrationPreset = GATE,
) -> list[WindowPose | None]:
    return solve_window(instants, motions, registration=registration, seed=0)


def normalized_error(found: WindowPose, truth: Pose) -> float:
    """Squared error, normalized by the stated covariance: chi-square(6) when that is right."""
    w = Rotation.from_matrix(truth.rotation @ found.rig_from_world.rotation.T).as_rotvec()
    error = np.concatenate([w, truth.translation - found.rig_from_world.translation])
    return float(error @ np.linalg.solve(found.covariance, error))


def test_every_second_instant_may_be_destroyed() -> None:
    errors = []
    for seed in range(5):
        truth, instants, motions = make_window(seed, 12, range(0, 12, 2))
        for i, found in enumerate(solve(instants, motions)):
            assert found is not None
            assert found.measured == (i % 2 == 0)
            if not found.measured:
                errors.append(pose_error(found.rig_from_world, truth[i]))
    distance, angle = np.median(errors, axis=0)
    assert distance < 0.03
    assert angle < 0.15


@pytest.mark.parametrize(("share", "degrees"), [(1e-6, 1e-5), (0.01, 0.1)])
def test_motion_never_moves_a_measured_pose(share: float, degrees: float) -> None:
    """A bias that adds up: no comparison of neighbours sees it, and no statement covers it."""

    def bias(i: int, motion: Pose) -> Pose:
        del i
        return Pose(motion.rotation, 1.002 * motion.translation)

    _, instants, motions = make_window(0, 8, range(8), lie=bias, share=share, degrees=degrees)
    for instant, pose in zip(instants, solve(instants, motions), strict=True):
        assert instant.alone is not None
        assert pose is not None
        assert pose.measured
        assert pose.rig_from_world is instant.alone.rig_from_world
        assert pose.covariance is instant.alone.covariance


def test_one_good_frame_localizes_its_neighbours_less_surely_with_distance() -> None:
    truth, instants, motions = make_window(1, 11, [5])
    found = solve(instants, motions)
    volumes = []
    for i, pose in enumerate(found):
        assert pose is not None
        assert pose.measured == (i == 5)
        assert normalized_error(pose, truth[i]) < chi2.ppf(0.9999, 6)
        volumes.append(np.linalg.slogdet(pose.covariance)[1])
    assert (np.diff(volumes[5:]) > 0).all()
    assert (np.diff(volumes[:6]) < 0).all()


def test_many_weak_instants_localize_all() -> None:
    """12 of 60 correspondences are right in each: less than any gate takes."""
    rng = np.random.default_rng(0)
    street, truth = make_street(rng), make_drive(8)
    instants = [WindowInstant(look(rng, street, pose, 12, 48, MONO), None) for pose in truth]
    motions = [make_motion(rng, b @ a.inverse()) for a, b in itertools.pairwise(truth)]
    for pose, found in zip(truth, solve(instants, motions), strict=True):
        assert found is not None
        assert not found.measured
        assert pose_error(found.rig_from_world, pose)[0] < 0.12
        assert normalized_error(found, pose) < chi2.ppf(0.9999, 6)
        assert found.inliers[0][:12].mean() > 0.9


def test_weak_instants_correct_the_drift_from_the_only_good_one() -> None:
    distances = []
    for right in (0, 12):
        rng = np.random.default_rng(4)
        street, truth = make_street(rng), make_drive(15)
        views = look(rng, street, truth[0], 100, 0)
        instants = [WindowInstant(views, measure(views, truth[0]))] + [
            WindowInstant(look(rng, street, pose, right, 60 - right, MONO), None)
            for pose in truth[1:]
        ]
        motions = [make_motion(rng, b @ a.inverse()) for a, b in itertools.pairwise(truth)]
        last = solve(instants, motions)[-1]
        assert last is not None
        assert normalized_error(last, truth[-1]) < chi2.ppf(0.9999, 6)
        distances.append(np.trace(last.covariance[3:, 3:]))
    assert distances[1] < 0.2 * distances[0]


def test_garbage_alone_gives_nothing() -> None:
    for seed in range(3):
        _, instants, motions = make_window(seed, 6, [], matches=60)
        assert solve(instants, motions) == [None] * 6


def test_garbage_is_not_found_where_the_gate_asks_for_no_share() -> None:
    _, instants, motions = make_window(0, 8, [], matches=150)
    lax = replace(GATE, min_inliers=12, min_inlier_ratio=0.0)
    assert solve(instants, motions, lax) == [None] * 8


def test_destroyed_images_do_not_bend_the_result() -> None:
    _, instants, motions = make_window(2, 7, [0, 3, 6])
    blind = [i if i.alone is not None else WindowInstant((), None) for i in instants]
    for one, other in zip(solve(instants, motions), solve(blind, motions), strict=True):
        assert one is not None
        assert other is not None
        assert one.rig_from_world.translation == pytest.approx(other.rig_from_world.translation)


def scaled(factor: float) -> Lie:
    return lambda _, motion: Pose(motion.rotation, factor * motion.translation)


def turned(degrees: float) -> Lie:
    turn = Pose(Rotation.from_euler("y", degrees, degrees=True).as_matrix(), np.zeros(3))
    return lambda _, motion: turn @ motion


@pytest.mark.parametrize(
    "lie",
    [
        pytest.param(scaled(1.1), id="scaled by 1.1"),
        pytest.param(scaled(0.0), id="standing still"),
        pytest.param(turned(1.0), id="turned by 1 degree"),
        pytest.param(lambda _, motion: motion.inverse(), id="backwards"),
    ],
)
@pytest.mark.parametrize("stated", [True, False])
def test_motion_that_contradicts_fills_nothing_and_moves_nothing(lie: Lie, stated: bool) -> None:
    _, instants, motions = make_window(0, 11, [1, 4, 5, 8], lie=lie)
    if not stated:
        motions = [
            replace(m, covariance=default_motion_covariance(m.current_from_previous))
            for m in motions
            if m is not None
        ]
    found = solve(instants, motions)
    for i, (instant, pose) in enumerate(zip(instants, found, strict=True)):
        if instant.alone is None:
            assert pose is None
        elif i in (1, 8) or stated:
            assert pose is not None
            assert pose.measured
            before, after = instant.alone.rig_from_world, pose.rig_from_world
            assert after.translation == pytest.approx(before.translation, abs=0.01)


@pytest.mark.parametrize("shift", [0.02, 0.05, 0.1, 0.3, 1.0, 30.0])
def test_one_lying_link_never_gives_a_wrong_pose_that_looks_sure(shift: float) -> None:
    """Whether it is noticed, or too small for that: what is stated holds."""

    def lie(i: int, motion: Pose) -> Pose:
        return Pose(motion.rotation, motion.translation + (i == 4) * shift * FORWARD)

    for seed in range(3):
        truth, instants, motions = make_window(seed, 10, [0, 3, 6, 9], lie=lie)
        found = solve(instants, motions)
        for pose, true in zip(found, truth, strict=True):
            if pose is not None:
                assert normalized_error(pose, true) < chi2.ppf(0.9999, 6)
        assert all(found[i] is not None for i in (0, 1, 2, 3, 6, 7, 8, 9))
        if shift >= 0.3:
            assert found[4] is None
            assert found[5] is None


def test_a_slight_lie_of_motion_that_claims_to_be_exact_widens_what_it_fills() -> None:
    def lie(i: int, motion: Pose) -> Pose:
        return Pose(motion.rotation, motion.translation + (i == 1) * 0.05 * FORWARD)

    truth, instants, motions = make_window(0, 4, [0, 3], lie=lie, share=1e-4, degrees=1e-3)
    for pose, true in zip(solve(instants, motions), truth, strict=True):
        assert pose is not None
        assert normalized_error(pose, true) < chi2.ppf(0.9999, 6)


def test_a_look_alike_place_is_overruled_by_its_neighbours() -> None:
    truth, instants, motions = make_window(0, 7, [0, 2, 4, 6], look_alike=[2])
    for i, found in enumerate(solve(instants, motions)):
        assert found is not None
        assert found.measured == (i in (0, 4, 6))
        assert pose_error(found.rig_from_world, truth[i])[0] < 0.15


def test_of_two_poses_that_contradict_none_is_preferred() -> None:
    _, instants, motions = make_window(0, 3, [0, 2], look_alike=[2])
    found = solve(instants, motions)
    assert found[1] is None
    for i in (0, 2):
        pose, alone = found[i], instants[i].alone
        assert pose is not None
        assert alone is not None
        assert pose.rig_from_world is alone.rig_from_world


def test_nothing_is_carried_over_unknown_motion() -> None:
    _, instants, motions = make_window(0, 5, [0, 4])
    found = solve(instants, [motions[0], None, None, motions[3]])
    assert [pose is None for pose in found] == [False, False, True, False, False]


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_absurd_covariances_of_motion_do_no_harm(size: float) -> None:
    truth, instants, motions = make_window(0, 5, [0, 4])
    absurd = [replace(m, covariance=size * np.eye(6)) for m in motions if m is not None]
    found = solve(instants, absurd)
    assert all(pose is not None for pose in (found[0], found[4]))
    for pose, true in zip(found, truth, strict=True):
        if pose is not None:
            assert np.isfinite(pose.covariance).all()
            assert normalized_error(pose, true) < chi2.ppf(0.9999, 6)
            assert (np.linalg.eigvalsh(pose.covariance) > 0).all()


def test_an_instant_that_only_its_neighbours_make_findable_counts_as_measured() -> None:
    rng = np.random.default_rng(0)
    street, truth = make_street(rng), make_drive(2)
    views = look(rng, street, truth[0], 100, 0)
    instants = [
        WindowInstant(views, measure(views, truth[0])),
        WindowInstant(look(rng, street, truth[1], 40, 300, MONO), None),
    ]
    found = solve(instants, [make_motion(rng, truth[1] @ truth[0].inverse())])[1]
    assert found is not None
    assert found.measured
    assert found.inliers[0][:40].sum() >= 39
    alone = pose_covariance(
        [replace(v, pixels=v.pixels[:40], points=v.points[:40]) for v in instants[1].views],
        found.rig_from_world,
        LOSS_SCALE_PX,
    )
    assert alone is not None
    assert found.covariance == pytest.approx(alone.whole, rel=1e-6)  # motion adds nothing to it


def test_covariances_agree_with_monte_carlo() -> None:
    """Measured, filled between two, filled beyond, and weak: the mean of chi-square(6) is 6.

    Somewhat less where the stated covariance of the motion is widened by what is compared.
    """
    normalized: dict[str, list[float]] = {"measured": [], "between": [], "beyond": [], "weak": []}
    for seed in range(120):
        rng = np.random.default_rng(1000 + seed)
        truth, instants, motions = make_window(seed, 5, [0, 2], matches=60)
        street = make_street(np.random.default_rng(seed))
        instants[3] = WindowInstant(look(rng, street, truth[3], 10, 10, MONO), None)
        found = solve(instants, motions)
        for name, i in (("measured", 0), ("between", 1), ("weak", 3), ("beyond", 4)):
            pose = found[i]
            assert pose is not None
            normalized[name].append(normalized_error(pose, truth[i]))
    for values in normalized.values():
        assert 4.0 < np.mean(values) < 7.0
        assert np.mean(np.array(values) < chi2.ppf(0.95, 6)) >= 0.91


def shared_offset(count: int, errors: MapErrors) -> list[WindowInstant]:
    """Measured instants with the same photo's part, all off by the same error of the map.

    The one in the middle is blind.
    """
    drive = make_drive(count)
    photo_part = np.diag([1e-3**2] * 3 + [0.02**2] * 3)
    offset = np.array([0.08, 0.0, 0.0])  # four times what a photo leaves open
    instants = []
    for i, pose in enumerate(drive):
        shifted = Pose(pose.rotation, pose.translation - pose.rotation @ offset)
        covariance = covariance_from_center(shifted, photo_part)
        alone = None if i == count // 2 else GeneralizedPose(shifted, (), covariance)
        instants.append(WindowInstant((), alone, errors))
    return instants


def exact_motions(count: int) -> list[RelativeMotion | None]:
    drive = make_drive(count)
    tiny = np.diag([1e-5**2] * 3 + [1e-4**2] * 3)
    return [RelativeMotion(b @ a.inverse(), tiny) for a, b in itertools.pairwise(drive)]


def position_stds(found: WindowPose | None) -> NDArray[np.float64]:
    assert found is not None
    return np.sqrt(np.diag(position_covariance(found.rig_from_world, found.covariance)))


def test_errors_of_the_map_that_instants_share_do_not_average_out() -> None:
    factor, of_a_photo = 5.0, 0.02
    of_the_map = of_a_photo * math.sqrt(factor**2 - 1.0)
    for count in (3, 9, 25):
        motions, middle = exact_motions(count), count // 2
        whole = solve(shared_offset(count, MapErrors(factor, factor)), motions)[middle]
        photo = solve(shared_offset(count, PHOTO_ONLY), motions)[middle]
        assert whole is not None
        assert not whole.measured
        # Of the photos' parts, many are less.
        np.testing.assert_allclose(
            position_stds(photo), of_a_photo / math.sqrt(count - 1), rtol=0.15
        )
        expected = np.hypot(position_stds(photo), of_the_map)
        np.testing.assert_allclose(position_stds(whole), expected, rtol=0.05)
        off = np.linalg.norm(whole.rig_from_world.center - make_drive(count)[middle].center)
        assert off == pytest.approx(0.08, rel=0.05)  # which is within the stated deviation
        assert off < position_stds(whole)[0]


def test_a_pose_from_one_neighbour_has_its_whole_uncertainty() -> None:
    instants = shared_offset(3, MapErrors(5.0, 4.0))
    found = solve([replace(instants[0]), instants[1]], exact_motions(3)[:1])

    stds = [position_stds(each) for each in found]
    np.testing.assert_allclose(stds[1], stds[0], rtol=0.02)


def test_pixels_of_many_instants_share_the_errors_of_the_map() -> None:
    """None is found alone; more of them leave the photo's part smaller, and the map's as it is."""
    weak = replace(GATE, min_inliers=60)
    stds = {}
    for count in (5, 15):
        rng = np.random.default_rng(3)
        street, drive = make_street(rng), make_drive(count)
        instants = [
            WindowInstant(look(rng, street, pose, 25, 10, MONO), None, MapErrors(5.0, 5.0))
            for pose in drive
        ]
        found = solve(instants, exact_motions(count), weak)
        without = [replace(each, errors=PHOTO_ONLY) for each in instants]
        photo = solve(without, exact_motions(count), weak)
        middle = count // 2
        stds[count] = np.linalg.norm(position_stds(found[middle]))
        alone = math.sqrt(count) * np.linalg.norm(position_stds(photo[middle]))
        assert stds[count] >= 0.95 * alone * math.sqrt(5.0**2 - 1.0)
    assert stds[15] > 0.7 * stds[5]


def test_equal_seeds_give_equal_bits() -> None:
    rng = np.random.default_rng(3)
    street, truth = make_street(rng), make_drive(4)
    instants = [WindowInstant(look(rng, street, pose, 12, 30, MONO), None) for pose in truth]
    motions = [make_motion(rng, b @ a.inverse()) for a, b in itertools.pairwise(truth)]
    bits = set()
    for _ in range(2):
        found = solve(instants, motions)
        assert all(pose is not None for pose in found)
        bits.add(b"".join(p.rig_from_world.translation.tobytes() for p in found if p is not None))
    assert len(bits) == 1


def test_a_wrong_number_of_motions_is_refused() -> None:
    with pytest.raises(ValueError, match="2 instants with 0 motions"):
        solve([WindowInstant((), None)] * 2, [])


def test_no_instants_and_no_images_give_no_poses() -> None:
    assert solve([], []) == []
    assert solve([WindowInstant((), None)], []) == [None]
    motion = RelativeMotion(Pose.identity(), np.eye(6) * 1e-4)
    assert solve([WindowInstant((), None)] * 3, [motion] * 2) == [None] * 3
