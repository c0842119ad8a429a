from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose, center_covariance
from visloc.localization.solving import Matches, SeenImage, solve_instant
from visloc.options import LocalizeOptions
from visloc.pose.motion import MapErrors
from visloc.priors import NO_PRIORS, HeightBand, PositionPrior, Priors
from visloc.sequences import solver as sequence_module
from visloc.sequences.filling import MAX_GAP_S, Odometry, TimeUnit
from visloc.sequences.solver import MAX_WAITING, MapSequenceSolver, SeenInstant
from visloc.types import CameraSource, InstantAnswer, PoseSource, Reason, Refusal

OPTIONS = LocalizeOptions()
ODOMETRY_FROM_LOCAL = Pose(
    Rotation.from_rotvec([0.5, 1.0, -2.0]).as_matrix(), np.array([40.0, -3.0, 7.0])
)


def rig_at(step: float) -> Pose:
    """On a gentle bend, 0.5 further at each step of 0.1 s."""
    rotation = Rotation.from_rotvec([0.1, 0.02 * step, 0.0]).as_matrix()
    return Pose(rotation, -rotation @ [0.5 * step, 0.002 * step**2, 0.3])


ELSEWHERE = Pose(Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix(), np.array([9.0, 0.0, 4.0]))


@cache
def image_of(place: Any, kind: str, step: float) -> tuple[SeenImage, ...]:
    """What the camera has at a step: 'good', 'weak' (too few inliers), 'blind', 'none', 'twin'."""
    seed = round(10 * step) + 1000
    if kind == "none":
        return ()
    if kind == "broken":
        return (place.image(None),)
    pose = ELSEWHERE if kind == "twin" else rig_at(step)
    right, wrong = {"good": (50, 10), "twin": (50, 10), "weak": (14, 20), "blind": (0, 40)}[kind]
    return (place.image(place.matches(pose, right, wrong, seed=seed)),)


def odometry(step: float, jump: Pose | None = None, covariance: Any = None) -> Odometry:
    """Exact, unless it has made a ``jump``."""
    pose = rig_at(step) @ ODOMETRY_FROM_LOCAL.inverse()
    return Odometry(pose if jump is None else jump @ pose, covariance)


def solver(
    place: Any, max_gap_s: float, unit: TimeUnit = TimeUnit.MS, metric: bool = True
) -> MapSequenceSolver:
    return MapSequenceSolver(
        place.geometry, metric=metric, options=OPTIONS, time_unit=unit, max_gap_s=max_gap_s
    )


def answers_to(solving: MapSequenceSolver, instants: list[SeenInstant]) -> list[InstantAnswer]:
    answers = [answer for instant in instants for answer in solving.add(instant)]
    return answers + solving.finish()


def instants_of(
    place: Any,
    kinds: str | list[str],
    *,
    step_ms: int = 100,
    moving: bool = False,
    start: int = 0,
    priors: Priors = NO_PRIORS,
) -> list[SeenInstant]:
    """One instant for each kind; a string names them by letters."""
    names = {"g": "good", "w": "weak", "b": "blind", ".": "none", "x": "broken", "t": "twin"}
    return [
        SeenInstant(
            start + i * step_ms,
            image_of(place, names.get(kind, kind), i),
            odometry(i) if moving else None,
            priors,
        )
        for i, kind in enumerate(kinds)
    ]


def sources(answers: list[InstantAnswer]) -> str:
    """E: estimated, M: motion, I: interpolated, N: nearest, '-': none."""
    return "".join("-" if a.pose is None else a.pose.source.value[0].upper() for a in answers)


def normalized_errors(answer: InstantAnswer, truth: Pose) -> np.ndarray[Any, Any]:
    """Of rotation and centre, in standard deviations along the axes of the covariance."""
    assert answer.pose is not None
    pose = answer.pose.rig_from_world
    w = Rotation.from_matrix(pose.rotation @ truth.rotation.T).as_rotvec()
    error = np.concatenate([w, pose.center - truth.center])
    covariance = center_covariance(pose, answer.pose.covariance)
    scale = np.sqrt(np.diag(covariance))
    values, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(np.abs(axes.T @ (error / scale)) / np.sqrt(values))


def check_answers(
    answers: list[InstantAnswer], place: Any, truths: list[Pose], most: float = 5.0
) -> None:
    """Whatever has a pose is right within its stated uncertainty, and says what it rests on."""
    for answer, truth in zip(answers, truths, strict=True):
        if answer.pose is None:
            assert answer.refusal is not None
            continue
        # The exact comparison is near the origin: there the numbers have all their digits.
        errors = normalized_errors(answer, place.to_world(truth))
        assert (errors < most).all(), (answer.timestamp, answer.pose.source, errors)
        assert (answer.refusal is None) == (answer.pose.source is PoseSource.ESTIMATED)


def same(a: InstantAnswer, b: InstantAnswer) -> bool:
    """The same but for the time that it took."""
    if (a.timestamp, a.refusal, a.num_inliers) != (b.timestamp, b.refusal, b.num_inliers):
        return False
    if a.pose is None or b.pose is None:
        return a.pose is b.pose
    return a.pose.source is b.pose.source and all(
        np.array_equal(x, y)
        for x, y in (
            (a.pose.rig_from_world.rotation, b.pose.rig_from_world.rotation),
            (a.pose.rig_from_world.translation, b.pose.rig_from_world.translation),
            (a.pose.covariance, b.pose.covariance),
            (a.pose.position_std, b.pose.position_std),
        )
    )


# Focal lengths that are a guess


def without_camera(place: Any, step: float, right: int) -> tuple[SeenImage, ...]:
    image = place.image(place.matches(rig_at(step), right, 20, seed=int(step)))
    assert image.look is not None
    camera = Camera("SIMPLE_PINHOLE", 640, 480, (768.0, 320.0, 240.0))
    evidence = replace(image.look.evidence, camera=camera, camera_source=CameraSource.GUESS)
    return (replace(image, look=replace(image.look, evidence=evidence)),)


@pytest.mark.parametrize(("around", "expected"), [(60, "---"), (300, "EME")])
def test_photos_refused_for_their_guessed_camera_have_no_say(
    place: Any, around: int, expected: str
) -> None:
    instants = [
        SeenInstant(100 * i, without_camera(place, i, right), odometry(i), NO_PRIORS)
        for i, right in enumerate((around, 60, around))
    ]
    answers = answers_to(solver(place, 10.0), instants)
    assert sources(answers) == expected
    check_answers(answers, place, [rig_at(i) for i in range(3)])
    assert answers[1].num_inliers == (0 if answers[1].pose else 60)


# What holds for every sequence


@st.composite
def patterns(draw: st.DrawFn) -> tuple[list[tuple[str, str, int]], float]:
    """Kind, odometry and time since the one before (ms) of each instant, and the largest gap."""
    count = draw(st.integers(1, 12))
    instants = [
        (
            draw(st.sampled_from(["good", "good", "weak", "blind", "none", "broken"])),
            draw(st.sampled_from(["", "plain", "plain", "stated"])),
            draw(st.sampled_from([50, 100, 100, 300, 700, 2000])),
        )
        for _ in range(count)
    ]
    return instants, draw(st.sampled_from([0.0, 0.1, 0.3, 1.0, 10.0]))


class Remembering:
    """``solve_instant`` that solves each instant once, however many sequences it is in.

    So no instant learns of the cameras of those before.
    """

    def __init__(self, place: Any) -> None:
        self.place = place
        self.solved: dict[tuple[int, ...], Any] = {}

    def __call__(self, images: Any, *arguments: Any, cameras: Any) -> Any:  # noqa: ARG002
        key = tuple(id(image) for image in images)
        if key not in self.solved:
            self.solved[key] = solve_instant(images, *arguments)
        found = self.solved[key]
        return replace(found, answer=replace(found.answer, timestamp=arguments[-1]))


PLACE: list[Any] = []


@pytest.fixture
def remembered(far_place: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    if not PLACE:
        PLACE.append(Remembering(HashablePlace(far_place)))
    monkeypatch.setattr(sequence_module, "solve_instant", PLACE[0])
    return PLACE[0].place


class HashablePlace:
    """A place by identity."""

    def __init__(self, place: Any) -> None:
        self._place = place

    def __getattr__(self, name: str) -> Any:
        return getattr(self._place, name)


@pytest.fixture
def here(place: Any) -> HashablePlace:
    return HashablePlace(place)


STATED = np.diag([np.radians(0.1) ** 2] * 3 + [0.005**2] * 3)


def test_whatever_the_pattern_every_instant_is_answered_once_in_order_and_in_time(
    remembered: Any,
) -> None:
    place = remembered

    @settings(max_examples=60, deadline=None, derandomize=True)
    @given(pattern=patterns())
    def check(pattern: tuple[list[tuple[str, str, int]], float]) -> None:
        steps, max_gap_s = pattern
        times = np.cumsum([since for _, _, since in steps]).tolist()
        instants = [
            SeenInstant(
                times[i],
                image_of(place, kind, times[i] / 100),
                odometry(times[i] / 100, None, STATED if moving == "stated" else None)
                if moving
                else None,
                NO_PRIORS,
            )
            for i, (kind, moving, _) in enumerate(steps)
        ]
        solving = solver(place, max_gap_s)
        answers: list[InstantAnswer] = []
        for i, instant in enumerate(instants):
            answers += solving.add(instant)
            # Whatever the newest is too late to help is answered, and what measured itself
            # without odometry is not kept waiting by anything but its elders.
            due = sum(times[i] - time >= 1000 * max_gap_s for time in times[: i + 1])
            assert len(answers) >= due
            if not any(moving for _, moving, _ in steps[: i + 1]) and steps[i][0] == "good":
                assert len(answers) == i + 1
        answers += solving.finish()
        assert solving.finish() == []

        assert [answer.timestamp for answer in answers] == times
        check_answers(answers, place, [rig_at(time / 100) for time in times])
        estimated = [
            time
            for time, answer in zip(times, answers, strict=True)
            if answer.pose is not None and answer.pose.source is PoseSource.ESTIMATED
        ]
        for time, answer, (kind, moving, _) in zip(times, answers, steps, strict=True):
            assert len(answer.images) == (kind != "none")
            assert "sequence" in answer.seconds
            if kind == "good":
                assert answer.pose is not None
                assert answer.pose.source is PoseSource.ESTIMATED
            elif answer.pose is not None:
                source = answer.pose.source
                if kind != "weak":
                    assert source is not PoseSource.ESTIMATED
                assert moving or source is not PoseSource.MOTION
                away = [e - time for e in estimated]
                # What agrees with the pose that the others give it supports motion, too.
                weak = [
                    t - time
                    for t, (k, m, _) in zip(times, steps, strict=True)
                    if k == "weak" and m and source is PoseSource.MOTION
                ]
                assert any(abs(a) <= 1000 * max_gap_s for a in away + weak)
                if source is PoseSource.INTERPOLATED:
                    before = max(a for a in away if a < 0)
                    after = min(a for a in away if a > 0)
                    assert after - before <= 1000 * max_gap_s
        if max_gap_s == 0:
            for i, (answer, (kind, _, _)) in enumerate(zip(answers, steps, strict=True)):
                alone = solve_instant(
                    image_of(place, kind, times[i] / 100),
                    place.geometry,
                    OPTIONS,
                    NO_PRIORS,
                    times[i],
                ).answer
                assert same(answer, alone)

        again = answers_to(solver(place, max_gap_s), instants)
        assert all(map(same, answers, again))

    check()


def test_no_more_than_so_many_instants_wait_however_long_the_gap(here: Any) -> None:
    for moving in (False, True):
        solving = solver(here, MAX_GAP_S)
        answered = 0
        for i in range(MAX_WAITING + 15):
            instant = instants_of(here, ["none"], start=i)[0]
            odometry_here = odometry(i) if moving else None
            answered += len(solving.add(replace(instant, odometry=odometry_here)))
            assert i + 1 - answered <= MAX_WAITING
            # What is remembered is bounded, too.
            assert len(solving._entries) <= 2 * MAX_WAITING + 1
        assert answered + len(solving.finish()) == MAX_WAITING + 15


# Without odometry


def test_a_gap_is_interpolated_and_its_ends_repeated(here: Any) -> None:
    instants = instants_of(here, "bggbbwg.x", step_ms=100)
    answers = answers_to(solver(here, 0.45), instants)
    assert sources(answers) == "NEEIIIENN"
    check_answers(answers, here, [rig_at(i) for i in range(9)])
    assert [a.refusal.reason for a in answers if a.refusal is not None] == [
        Reason.TOO_FEW_INLIERS,
        *[Reason.TOO_FEW_INLIERS] * 3,
        *[Reason.NO_USABLE_IMAGE] * 2,
    ]
    # Nearly straight and evenly: the error is the bend's.
    for i in (3, 4, 5):
        pose = answers[i].pose
        assert pose is not None
        assert np.linalg.norm(pose.rig_from_world.center - rig_at(i).center) < 0.15
        assert (pose.position_std > answers[2].pose.position_std).all()  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("max_gap_s", "expected"),
    [(0.0, "E----E"), (0.1, "EN--NE"), (0.25, "ENNNNE"), (0.49, "ENNNNE"), (0.5, "EIIIIE")],
)
def test_nothing_is_filled_beyond_the_gap(here: Any, max_gap_s: float, expected: str) -> None:
    instants = instants_of(here, "gbbbbg", step_ms=100)
    assert sources(answers_to(solver(here, max_gap_s), instants)) == expected


@pytest.mark.parametrize("unit", list(TimeUnit))
def test_times_of_this_century_in_every_unit_give_the_same(here: Any, unit: TimeUnit) -> None:
    start = round(1_700_000_000 / unit.seconds)
    step = max(1, round(0.1 / unit.seconds))
    max_gap_s = 0.3 if unit is not TimeUnit.S else 3.0
    for moving, expected in ((False, "EIIE-"), (True, "EMMEM")):
        kinds = "gbbgb" if moving else "gbbg"
        instants = instants_of(here, kinds, step_ms=step, moving=moving, start=start)
        if not moving:
            last = instants_of(here, "b", start=start + 10 * step)
            instants += last
        assert sources(answers_to(solver(here, max_gap_s, unit), instants)) == expected


def test_a_sequence_where_nothing_is_seen_is_answered(here: Any) -> None:
    for moving in (False, True):
        answers = answers_to(solver(here, 1.0), instants_of(here, "b.xb", moving=moving))
        assert sources(answers) == "----"
        assert [a.refusal.reason for a in answers if a.refusal is not None] == [
            Reason.TOO_FEW_INLIERS,
            Reason.NO_USABLE_IMAGE,
            Reason.NO_USABLE_IMAGE,
            Reason.TOO_FEW_INLIERS,
        ]


def test_an_instant_that_waits_is_answered_as_soon_as_a_later_one_is_localized(here: Any) -> None:
    solving = solver(here, 10.0)
    answered = [len(solving.add(instant)) for instant in instants_of(here, "bgbbgb")]
    assert answered == [0, 2, 0, 0, 3, 0]
    assert len(solving.finish()) == 1


# Priors


def test_a_filled_pose_that_contradicts_a_prior_is_not_given(here: Any) -> None:
    far = Priors(PositionPrior(np.array([500.0, 0.0, 0.0]), 1.0))
    near = Priors(PositionPrior(rig_at(2).center, 1.0))
    for moving, filled in ((False, "I"), (True, "M")):
        instants = instants_of(here, "gg.gg", moving=moving)
        for priors, expected in ((near, filled), (far, "-")):
            instants[2] = replace(instants[2], priors=priors)
            answers = answers_to(solver(here, 1.0), instants)
            assert sources(answers) == f"EE{expected}EE"
            refusal = answers[2].refusal
            assert refusal is not None
            assert refusal.reason is Reason.NO_USABLE_IMAGE


def test_an_instant_whose_prior_lies_is_refused_and_filled_only_as_its_prior_allows(
    here: Any,
) -> None:
    lie = Priors(PositionPrior(np.array([500.0, 0.0, 0.0]), 1.0))
    for moving in (False, True):
        instants = instants_of(here, "ggggg", moving=moving)
        instants[2] = replace(instants[2], priors=lie)
        answers = answers_to(solver(here, 1.0), instants)
        assert sources(answers) == "EE-EE"
        assert answers[2].refusal is not None
        assert answers[2].refusal.reason is Reason.CONTRADICTS_PRIOR


def test_priors_that_mean_nothing_in_the_map_are_refused(here: Any) -> None:
    priors = Priors(height=HeightBand(0.0, 3.0))
    with pytest.raises(InvalidInput) as caught:
        solver(here, 1.0).add(instants_of(here, "g", priors=priors)[0])
    assert caught.value.code == "priors.height"


# With odometry


def test_good_frames_that_confirm_the_motion_localize_all_that_it_links(here: Any) -> None:
    for kinds in ("gg.b.x", "..gg..", ".x.bgg", "g.b..g"):
        answers = answers_to(solver(here, 1.0), instants_of(here, kinds, moving=True))
        assert sources(answers) == "".join("E" if kind == "g" else "M" for kind in kinds)
        check_answers(answers, here, [rig_at(i) for i in range(6)])
        for i, answer in enumerate(answers):
            assert answer.pose is not None
            assert np.linalg.norm(answer.pose.rig_from_world.center - rig_at(i).center) < 0.03


def test_many_weak_frames_localize_all(here: Any) -> None:
    alone = answers_to(solver(here, 1.0), instants_of(here, "wwwww"))
    assert sources(alone) == "-----"
    answers = answers_to(solver(here, 1.0), instants_of(here, "wwwww", moving=True))
    check_answers(answers, here, [rig_at(i) for i in range(5)])
    assert all(answer.pose is not None for answer in answers)


@pytest.mark.parametrize(
    "reason", [Reason.AMBIGUOUS, Reason.CAMERA_CONTRADICTED, Reason.UNLIKELY_POSE]
)
def test_photos_with_evidence_against_their_pose_do_not_pass_together(
    here: Any, reason: Reason
) -> None:
    """A print, or another floor, that is filmed is in every photo."""
    solving = solver(here, 1.0)
    answers = []
    for seen in instants_of(here, "ggggg", moving=True):
        refused = solving.solve(seen).refused(Refusal("gate", reason, "refused"))
        answers += solving.take(seen, refused)
    answers += solving.finish()
    assert sources(answers) == "-----"
    assert {a.refusal.reason for a in answers if a.refusal is not None} == {reason}


def test_instants_less_probable_than_asked_for_are_filled_by_those_that_are_not(here: Any) -> None:
    solving = MapSequenceSolver(
        here.geometry,
        metric=True,
        options=replace(OPTIONS, min_probability=0.8),
        time_unit=TimeUnit.MS,
        max_gap_s=1.0,
    )
    answers = []
    for seen, probability in zip(
        instants_of(here, "ggggg", moving=True), (0.9, 0.5, 0.79, 0.8, 0.2), strict=True
    ):
        solved = solving.solve(seen)
        pose = solved.answer.pose
        assert pose is not None
        judged = replace(solved.answer, pose=replace(pose, probability=probability))
        answers += solving.take(seen, replace(solved, answer=judged))
    answers += solving.finish()

    assert sources(answers) == "EMMEM"
    check_answers(answers, here, [rig_at(i) for i in range(5)])
    for answer in answers:
        assert answer.pose is not None
        if answer.pose.source is PoseSource.MOTION:
            assert answer.refusal is not None
            assert answer.refusal.reason is Reason.UNLIKELY_POSE
            assert answer.pose.probability is None


def test_poses_that_only_the_window_measures_are_not_judged_and_pass_no_raised_gate(
    here: Any,
) -> None:
    """Weak photos pass together; each alone has too few inliers to be judged."""
    weak = instants_of(here, "wwwww", moving=True)
    found = answers_to(solver(here, 1.0), weak)
    raised = MapSequenceSolver(
        here.geometry,
        metric=True,
        options=replace(OPTIONS, min_probability=0.8),
        time_unit=TimeUnit.MS,
        max_gap_s=1.0,
    )

    assert all(answer.pose is not None for answer in found)
    for answer in found:
        assert answer.pose is not None
        assert answer.pose.probability is None
    assert sources(answers_to(raised, weak)) == "-----"


def test_motion_reaches_no_further_than_the_gap(here: Any) -> None:
    answers = answers_to(solver(here, 0.25), instants_of(here, "gg....", moving=True))
    assert sources(answers) == "EEMM--"
    apart = instants_of(here, "gg..", moving=True, step_ms=300)
    assert sources(answers_to(solver(here, 0.25), apart)) == "EE--"


def test_the_uncertainty_grows_with_the_way_since_the_last_look(here: Any) -> None:
    answers = answers_to(solver(here, 1.0), instants_of(here, "gg.......", moving=True))
    spread = [np.linalg.norm(a.pose.position_std) for a in answers[1:] if a.pose is not None]
    assert len(spread) == 8
    assert (np.diff(spread) > 0).all()


@pytest.mark.parametrize("right_inside", [40, 14])
def test_a_floor_that_lies_is_refused_however_many_instants_agree_on_it(
    here: Any, right_inside: int
) -> None:
    # All instants look most like a floor that the priors exclude; on the one that they allow,
    # fewer matches fit, of a path of the same shape.
    instants = []
    for i in range(6):
        right = rig_at(i)
        wrong = right @ Pose(np.eye(3), np.array([0.0, 0.0, -3.0]))
        image = here.image(
            here.matches(wrong, right_inside, 20, seed=i),
            elsewhere=here.matches(right, 80, 20, seed=50 + i),
        )
        priors = Priors(PositionPrior(wrong.center, 2.0))
        instants.append(SeenInstant(100 * i, (image,), odometry(i), priors))
    answers = answers_to(solver(here, 1.0), instants)
    assert sources(answers) == "------"
    assert {a.refusal.reason for a in answers if a.refusal is not None} == {
        Reason.CONTRADICTS_PRIOR
    }


def test_odometry_of_a_few_instants_only_helps_those(here: Any) -> None:
    instants = instants_of(here, "gg.bgb.", moving=True)
    instants[4:] = [replace(instant, odometry=None) for instant in instants[4:]]
    answers = answers_to(solver(here, 1.0), instants)
    assert sources(answers) == "EEMMENN"
    check_answers(answers, here, [rig_at(i) for i in range(7)])


def test_beyond_the_last_look_that_motion_links_to_it_a_pose_is_less_sure(here: Any) -> None:
    # A look before the odometry began says nothing of where it leads.
    linked = instants_of(here, "..gg", moving=True)
    (before,) = instants_of(here, "g", start=-300)
    (cut,) = instants_of(here, ".", start=-100)
    alone = answers_to(solver(here, 1.0), linked)
    after = answers_to(solver(here, 1.0), [before, cut, *linked])
    assert sources(alone) == "MMEE"
    assert sources(after)[2:] == "MMEE"
    for a, b in zip(alone, after[2:], strict=True):
        assert a.pose is not None
        assert b.pose is not None
        assert b.pose.position_std == pytest.approx(a.pose.position_std, rel=1e-6)


def test_odometry_that_jumps_between_two_looks_fills_nothing_there(here: Any) -> None:
    jump = Pose(Rotation.from_euler("y", 10, degrees=True).as_matrix(), np.array([3.0, 0.0, 0.0]))
    instants = instants_of(here, "gggbbgggg", moving=True)
    instants[4:] = [
        replace(instant, odometry=odometry(4 + i, jump)) for i, instant in enumerate(instants[4:])
    ]
    answers = answers_to(solver(here, 1.0), instants)
    assert sources(answers) == "EEE--EEEE"
    check_answers(answers, here, [rig_at(i) for i in range(9)])


def test_odometry_that_stays_wrong_costs_no_measured_pose(here: Any) -> None:
    # It has the world twice as large.
    instants = instants_of(here, "ggggg")
    instants = [
        replace(
            instant,
            odometry=Odometry(Pose(rig_at(i).rotation, 2.0 * rig_at(i).translation), None),
        )
        for i, instant in enumerate(instants)
    ]
    answers = answers_to(solver(here, 1.0), instants)
    assert sources(answers) == "EEEEE"
    check_answers(answers, here, [rig_at(i) for i in range(5)])


def test_a_look_alike_place_is_not_believed_against_its_neighbours(here: Any) -> None:
    answers = answers_to(solver(here, 1.0), instants_of(here, "gggtggg", moving=True))
    assert sources(answers) == "EEEMEEE"
    refusal = answers[3].refusal
    check_answers(answers[:3] + answers[4:], here, [rig_at(i) for i in (0, 1, 2, 4, 5, 6)])
    pose = answers[3].pose
    assert pose is not None
    assert np.linalg.norm(pose.rig_from_world.center - rig_at(3).center) < 0.05
    assert refusal is not None
    assert refusal.reason is Reason.CONTRADICTS_MOTION


def test_what_was_refused_for_its_motion_fills_nothing_later(here: Any) -> None:
    # The look-alike place is the last with odometry; after it come blind instants without.
    kinds = "gggtg" + "b"
    instants = instants_of(here, kinds, moving=True)
    instants[5] = replace(instants[5], odometry=None)
    answers = answers_to(solver(here, 0.35), instants)
    assert sources(answers)[:5] == "EEEME"
    check_answers([answers[5]], here, [rig_at(5)])


def test_odometry_without_a_metric_map_is_refused(here: Any) -> None:
    solving = solver(here, 1.0, metric=False)
    plain, moving = instants_of(here, "g")[0], instants_of(here, "gg", moving=True)[1]
    assert len(solving.add(plain)) == 1
    with pytest.raises(InvalidInput) as caught:
        solving.add(moving)
    assert (caught.value.code, caught.value.field) == ("sequence.odometry", "odometry")
    # What came before is still there.
    assert sources(solving.add(replace(plain, timestamp=100))) == "E"


@pytest.mark.parametrize("size", [1e-12, 1e6, 1e15])
def test_motion_that_claims_everything_or_nothing_gives_no_wrong_pose(
    here: Any, size: float
) -> None:
    instants = [
        replace(instant, odometry=odometry(i, None, np.eye(6) * size))
        for i, instant in enumerate(instants_of(here, "g..wg"))
    ]
    answers = answers_to(solver(here, 1.0), instants)
    assert sources(answers)[0] == sources(answers)[-1] == "E"
    check_answers(answers, here, [rig_at(i) for i in range(5)])


def test_an_odometry_world_far_away_is_as_good_as_a_near_one(here: Any) -> None:
    away = Pose(np.eye(3), np.array([5e6, -1e6, 0.0]))
    instants = [
        replace(instant, odometry=Odometry(rig_at(i) @ away, None))
        for i, instant in enumerate(instants_of(here, "g...g"))
    ]
    answers = answers_to(solver(here, 1.0), instants)
    assert sources(answers) == "EMMME"
    check_answers(answers, here, [rig_at(i) for i in range(5)])


@pytest.mark.parametrize("gap", [-0.1, 60.1, np.nan, np.inf])
def test_a_gap_that_cannot_be_filled_is_refused(here: Any, gap: float) -> None:
    with pytest.raises(InvalidInput) as caught:
        solver(here, gap)
    assert caught.value.code == "sequence.max_gap"


def test_correspondences_of_filled_instants_are_those_that_agree(here: Any) -> None:
    answers = answers_to(solver(here, 1.0), instants_of(here, "ggwgg", moving=True))
    assert answers[2].pose is not None
    assert 10 <= answers[2].num_inliers <= 20
    assert answers[2].num_correspondences == 34


def test_matches_may_be_none(here: Any) -> None:
    empty = SeenInstant(200, (here.image(Matches.none()),), odometry(2), NO_PRIORS)
    instants = instants_of(here, "gg", moving=True)
    answers = answers_to(solver(here, 1.0), [*instants, empty])
    assert sources(answers) == "EEM"


# Trackers that are wrong, or cannot be checked


TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
OPENGL = np.diag([1.0, -1.0, -1.0])
MIRROR = np.diag([1.0, 1.0, -1.0])
WRONG: dict[str, tuple[Any, str]] = {
    "camera_to_world": (Pose.inverse, "camera-to-world poses"),
    "opengl_axes": (
        lambda p: Pose(OPENGL @ p.rotation, OPENGL @ p.translation),
        "world-to-camera poses with OpenGL axes (x right, y up, z backward)",
    ),
    "arkit_transform": (
        lambda p: Pose(OPENGL @ p.rotation, OPENGL @ p.translation).inverse(),
        "camera-to-world poses with OpenGL axes (x right, y up, z backward)",
    ),
    "centre_as_t": (
        lambda p: Pose(p.rotation, p.center),
        "poses with the camera's centre in place of the translation",
    ),
    "cm": (lambda p: Pose(p.rotation, 100.0 * p.translation), "poses in centimetres"),
    "left_handed": (
        lambda p: Pose(MIRROR @ p.rotation @ MIRROR, MIRROR @ p.translation),
        "world-to-camera poses in a left-handed frame (z mirrored)",
    ),
    "landscape_device": (
        lambda p: Pose(TURN @ p.rotation, TURN @ p.translation),
        "world-to-camera poses with axes turned by 90 degrees about the optical axis",
    ),
}


def steep(step: float) -> Pose:
    """A way that climbs and turns about all axes: no two conventions fit it."""
    rotation = Rotation.from_rotvec([0.1 + 0.03 * step, 0.05 * step, -0.02 * step]).as_matrix()
    return Pose(rotation, -rotation @ [0.3 * step, 0.05 * step**2, 0.3 + 0.1 * step])


@cache
def photo_of(place: Any, step: int) -> tuple[SeenImage, ...]:
    return (place.image(place.matches(steep(step), 50, 10, seed=step)),)


def on_the_steep_way(
    place: Any, photos: str, write: Any = lambda p: p, noise: float = 0.0, seed: int = 0
) -> list[SeenInstant]:
    rng = np.random.default_rng(seed)

    def drifted(step: int) -> Pose:
        turn = Rotation.from_rotvec(noise * np.radians(0.2) * rng.normal(size=3)).as_matrix()
        moved = Pose(turn, noise * 0.01 * rng.normal(size=3)) @ steep(step)
        return moved @ ODOMETRY_FROM_LOCAL.inverse()

    return [
        SeenInstant(
            100 * i,
            photo_of(place, i) if kind == "g" else (),
            Odometry(write(drifted(i)), None),
            NO_PRIORS,
        )
        for i, kind in enumerate(photos)
    ]


@pytest.mark.parametrize("write", [write for write, _ in WRONG.values()], ids=WRONG)
def test_motion_in_any_convention_fills_nothing_beyond_a_single_photo(
    here: Any, write: Any
) -> None:
    answers = answers_to(solver(here, 1.0), on_the_steep_way(here, "g.....", write))
    assert sources(answers) == "E-----"
    assert answers[1].refusal is not None
    assert answers[1].refusal.reason is Reason.NO_USABLE_IMAGE
    assert "the photos so far fit other conventions, too" in answers[1].refusal.message


@pytest.mark.parametrize("photos", ["g.g.g", "g.g.g....", "gg...."])
@pytest.mark.parametrize(("write", "name"), WRONG.values(), ids=WRONG)
def test_motion_in_another_convention_is_named_where_photos_show_it(
    here: Any, write: Any, name: str, photos: str
) -> None:
    answers = answers_to(solver(here, 1.0), on_the_steep_way(here, photos, write))
    assert sources(answers) == photos.replace("g", "E").replace(".", "-")
    for answer in answers:
        if answer.refusal is not None:
            assert f". The odometry looks like {name}: send" in answer.refusal.message


@pytest.mark.parametrize("factor", [0.5, 1.3])
def test_motion_of_another_size_is_refused_without_a_guess(here: Any, factor: float) -> None:
    instants = on_the_steep_way(here, "g.g.g..", lambda p: Pose(p.rotation, factor * p.translation))
    answers = answers_to(solver(here, 1.0), instants)
    assert sources(answers) == "E-E-E--"
    for answer in answers[1::2]:
        assert answer.refusal is not None
        assert answer.refusal.message.endswith("but the motion contradicts the photos")


@pytest.mark.parametrize("noise", [0.0, 0.5, 1.0])
def test_right_motion_goes_on_where_photos_confirmed_it(here: Any, noise: float) -> None:
    photos = "g.g.g...."
    answers = answers_to(solver(here, 1.0), on_the_steep_way(here, photos, noise=noise))
    assert sources(answers) == photos.replace("g", "E").replace(".", "M")
    check_answers(answers, here, [steep(i) for i in range(len(photos))])


@pytest.mark.parametrize("noise", [1.0, 5.0, 20.0])
def test_drift_is_never_taken_for_another_convention(here: Any, noise: float) -> None:
    for seed in range(5):
        instants = on_the_steep_way(here, "gg.g.g..", noise=noise, seed=seed)
        answers = answers_to(solver(here, 1.0), instants)
        messages = [a.refusal.message for a in answers if a.refusal is not None]
        assert not any("looks like" in message for message in messages)


def test_a_rig_that_stood_still_has_confirmed_no_motion(here: Any) -> None:
    for write in (lambda p: p, Pose.inverse):
        still = on_the_steep_way(here, "g", write) * 3
        moving = on_the_steep_way(here, ".....", write)[1:]
        instants = [
            replace(instant, timestamp=100 * i) for i, instant in enumerate([*still, *moving])
        ]
        assert sources(answers_to(solver(here, 1.0), instants)) == "EEE----"


def test_a_straight_way_confirms_what_goes_on_straight_and_no_turn(here: Any) -> None:
    def straight(step: int) -> Pose:
        turn = Rotation.from_rotvec([0.0, max(0, step - 6) * 0.2, 0.0]).as_matrix()
        return Pose(turn, np.array([0.0, 0.0, -0.5 * min(step, 6)]))

    instants = [
        SeenInstant(
            100 * i,
            (here.image(here.matches(straight(i), 50, 10, seed=i)),) if i < 4 else (),
            Odometry(straight(i) @ ODOMETRY_FROM_LOCAL.inverse()),
            NO_PRIORS,
        )
        for i in range(9)
    ]
    answers = answers_to(solver(here, 1.0), instants)
    assert sources(answers) == "EEEEMMM--"


def test_a_jump_of_the_tracker_does_not_undo_what_photos_confirmed(here: Any) -> None:
    jump = Pose(Rotation.from_euler("y", 10, degrees=True).as_matrix(), np.array([3.0, 0.0, 0.0]))
    instants = on_the_steep_way(here, "ggggg" + "." * 4)
    instants[3:] = [
        replace(seen, odometry=Odometry(seen.odometry.rig_from_odometry @ jump))  # type: ignore[union-attr]
        for seen in instants[3:]
    ]
    answers = answers_to(solver(here, 0.3), instants)
    # The first pose after it is not filled while the jump is in its window.
    assert sources(answers) == "EEEEE-MM-"


def test_motion_that_leads_out_of_the_map_fills_nothing_there(here: Any) -> None:
    answers = answers_to(solver(here, 2.0), on_the_steep_way(here, "g.g.g......."))
    found = [i for i, answer in enumerate(answers) if answer.pose is not None]
    # The map's only photo, at its origin, sees 5 far.
    assert found == [i for i in range(12) if np.linalg.norm(steep(i).center) <= 5.0]
    for answer in answers[len(found) :]:
        assert answer.refusal is not None
        assert "leads out of the map" in answer.refusal.message


def with_motion(
    place: Any, kinds: str, at: Any, covariances: list[Any] | None = None
) -> list[SeenInstant]:
    """Instants whose odometry says ``at(i)`` steps after i."""
    return [
        replace(
            instant,
            odometry=odometry(at(i), covariance=None if covariances is None else covariances[i]),
        )
        for i, instant in enumerate(instants_of(place, kinds))
    ]


SURE = 1e-8 * np.eye(6)


def test_a_tracker_that_freezes_after_the_last_photo_fills_nothing_surely(here: Any) -> None:
    instants = with_motion(here, "gggbbbbb", lambda i: min(i, 2), [SURE] * 8)
    answers = answers_to(solver(here, 1.0), instants)
    assert sources(answers).startswith("EEE")
    check_answers(answers, here, [rig_at(i) for i in range(8)])
    assert answers[-1].pose is not None
    assert (answers[-1].pose.position_std > 1.0).all()


def test_motion_that_says_nothing_cuts_a_sequence_as_missing_motion_does(here: Any) -> None:
    covariances = [SURE] * 6 + [1e4 * np.eye(6)]
    instants = with_motion(here, "gbbbbbg", lambda i: 1.3 * i, covariances)
    answers = answers_to(solver(here, 1.0), instants)
    for i in range(1, 6):
        pose = answers[i].pose
        if pose is not None and pose.source is PoseSource.MOTION:
            assert pose.position_std.max() > 0.04 * 0.5 * i


def test_a_window_without_any_pose_is_not_searched_again_for_every_instant(
    here: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched = []

    def counting(*args: Any, **settings: Any) -> Any:
        searched.append(len(args[0]))
        return solve_window(*args, **settings)

    solve_window = sequence_module.solve_window
    monkeypatch.setattr(sequence_module, "solve_window", counting)
    answers = answers_to(solver(here, 1.0), instants_of(here, "b" * 45, moving=True))
    assert sources(answers) == "-" * 45
    assert len(searched) <= 6


# Cameras that are off


OFF = 1.006


def with_focal_length(image: SeenImage, factor: float) -> SeenImage:
    """The same image, with another camera told than took it."""
    assert image.look is not None
    fx, fy, cx, cy = image.look.camera.params
    camera = replace(image.look.camera, params=(factor * fx, factor * fy, cx, cy))
    evidence = replace(image.look.evidence, camera=camera)
    return replace(image, look=replace(image.look, evidence=evidence))


def test_photos_of_a_camera_together_correct_what_none_of_them_tells_alone(place: Any) -> None:
    images = [
        with_focal_length(place.image(place.matches(rig_at(i), 60, seed=i)), OFF) for i in range(12)
    ]
    geometry = place.geometry
    geometry.errors = MapErrors(position_factor=4.0, orientation_factor=4.0)

    def solving() -> MapSequenceSolver:
        return MapSequenceSolver(
            geometry, metric=True, options=OPTIONS, time_unit=TimeUnit.MS, max_gap_s=0.0
        )

    sequence = solving()
    alone, together = [], []
    for i, image in enumerate(images):
        seen = SeenInstant(100 * i, (image,), None, NO_PRIORS)
        alone.append(solving().solve(seen).answer)
        together += sequence.add(seen)
    true = place.camera.focal_length
    for answers, expected in ((alone, OFF * true), (together, true)):
        evidence = answers[-1].images[0].evidence
        assert evidence is not None
        assert evidence.camera.focal_length == pytest.approx(expected, rel=0.002)
