from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.visloc.answers import localized, refused
from visloc.geometry import Similarity
from visloc.localization.acceptance.judge import PlaceAnswer, Tie, judge
from visloc.types import Reason, Refusal

SLACK = 0.3


def one_frame(*_: int) -> Tie:
    return Tie(Similarity.identity(), SLACK)


def untied(*_: int) -> None:
    return None


def of(*answers: Any) -> list[PlaceAnswer]:
    return [PlaceAnswer(f"map-{i}@v1", answer) for i, answer in enumerate(answers)]


def test_most_inliers_win() -> None:
    assert judge(of(localized(40), localized(200), refused(300)), one_frame) == 1


def test_of_similar_answers_that_agree_the_more_certain_one_counts() -> None:
    found = of(
        localized(200, std=0.05),
        localized(170, (0.1, 0, 0), std=0.01),
        localized(120, (0.1, 0, 0), std=0.001),
    )

    assert judge(found, one_frame) == 1


def test_two_places_that_explain_it_are_refused() -> None:
    answer = judge(of(localized(200), localized(100, (100, 0, 0))), one_frame)

    assert isinstance(answer, Refusal)
    assert answer.reason is Reason.AMBIGUOUS
    assert "map-0@v1 and map-1@v1" in answer.message
    assert "at different places, with 200 and 100 inliers" in answer.message


def test_a_refusal_states_both_places_and_what_speaks_for_them() -> None:
    few, many = localized(150, (3, 0, 0)), localized(200, turn=np.pi)
    few = replace(few, scores=np.ones(40, np.float32))
    many = replace(many, scores=np.ones(40, np.float32))
    few.scores[:9] = 0.0
    places = [PlaceAnswer("set@v1", few, "left@v1"), PlaceAnswer("set@v1", many, "right@v2")]

    answer = judge(places, one_frame)

    assert isinstance(answer, Refusal)
    first, second = answer.candidates
    assert (first.num_inliers, first.map, first.tile) == (200, "set@v1", "right@v2")
    assert (second.num_inliers, second.map, second.tile) == (150, "set@v1", "left@v1")
    np.testing.assert_allclose(second.rig_from_world.center, (3, 0, 0))
    # Nine keypoints speak for the first alone.
    assert first.preference == pytest.approx(3.0)
    assert second.preference == pytest.approx(-3.0)
    assert first.image is None  # these answers name no retrieved photo


def test_keypoints_of_different_features_are_not_compared() -> None:
    few = replace(localized(150, (3, 0, 0)), scores=np.ones(7, np.float32))
    many = replace(localized(200), scores=np.ones(8, np.float32))

    answer = judge(of(many, few), one_frame)

    assert isinstance(answer, Refusal)
    assert [each.preference for each in answer.candidates] == [None, None]


def test_a_rival_of_few_inliers_is_no_reason_to_refuse() -> None:
    found = of(localized(99, (100, 0, 0)), localized(200))

    assert judge(found, one_frame) == 1
    assert judge(found, untied) == 1


def test_the_same_position_the_other_way_round_is_another_place() -> None:
    assert isinstance(judge(of(localized(200), localized(190, turn=np.pi)), one_frame), Refusal)


def test_how_well_places_are_tied_is_no_contradiction() -> None:
    near = of(localized(200), localized(190, (0.25, 0, 0), np.radians(3)))
    far = of(localized(200), localized(190, (0.5, 0, 0)))
    unsure = of(localized(200), localized(190, (0.5, 0, 0), std=0.2))

    assert judge(near, one_frame) == 0
    assert isinstance(judge(far, one_frame), Refusal)
    assert judge(unsure, one_frame) == 0


@pytest.mark.parametrize("best", [{"inliers": 100, "std": 0.3}, {"inliers": 170, "std": 2.0}])
def test_places_that_only_an_uncertain_answer_agrees_with_are_refused(best: dict[str, Any]) -> None:
    apart = [localized(90, (1.1, 0, 0), std=0.01), localized(89, (-1.1, 0, 0), std=0.02)]
    together = [localized(**best), *apart]

    for found in (apart, together, together[::-1]):
        answer = judge(of(*found), one_frame)
        assert isinstance(answer, Refusal)
        assert answer.reason is Reason.AMBIGUOUS
    assert judge(of(*together[:2]), one_frame) == (1 if best["inliers"] == 100 else 0)


def test_places_that_nothing_ties_cannot_agree() -> None:
    # Coordinates that are equal say nothing: both maps may begin at a lift of their own.
    answer = judge(of(localized(200), localized(150)), untied)

    assert isinstance(answer, Refusal)
    assert answer.reason is Reason.AMBIGUOUS
    assert "in frames without a known transform" in answer.message


def test_a_set_that_could_not_decide_leaves_no_room_for_a_weaker_answer() -> None:
    undecided = refused(300, Reason.AMBIGUOUS)

    assert judge(of(localized(200), undecided), one_frame) == 1
    assert judge(of(localized(601), undecided), one_frame) == 0


def test_a_wrong_camera_in_one_place_makes_no_other_place_right() -> None:
    wrong_camera = refused(300, Reason.CAMERA_CONTRADICTED)

    assert judge(of(localized(60), wrong_camera), one_frame) == 1
    assert judge(of(localized(301), wrong_camera), one_frame) == 0


def with_scores(answer: Any, scores: Any) -> Any:
    return replace(answer, scores=np.array(scores, np.float32))


def test_a_place_of_few_inliers_is_a_rival_unless_the_keypoints_speak_against_it() -> None:
    both, one, none = np.ones(40), np.ones(20), np.zeros(20)
    best = with_scores(localized(200), np.concatenate([both, one]))
    like = with_scores(localized(60, (100, 0, 0)), np.concatenate([both, none]))
    unlike = with_scores(localized(60, (100, 0, 0)), np.concatenate([0 * both, none]))

    undecided = judge(of(best, like), one_frame)

    assert isinstance(undecided, Refusal)
    assert undecided.reason is Reason.AMBIGUOUS
    assert judge(of(best, unlike), one_frame) == 0
    # Of other keypoints, which cannot be compared.
    assert judge(of(best, with_scores(like, [1.0])), one_frame) == 0


def test_without_a_pose_the_answer_that_came_furthest_counts() -> None:
    assert judge(of(refused(5), refused(25)), one_frame) == 1
