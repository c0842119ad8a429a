"""Floors that look alike, one of them mapped poorly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.visloc.answers import localized
from visloc.archive import SetOutline
from visloc.localization.acceptance.judge import PlaceAnswer
from visloc.types import InstantAnswer, Reason
from visloc_extensions.sets.unheard import apart, hard_to_find, left_open

MakeOutline = Callable[..., SetOutline]
FLOORS = [((0, 0, 3 * floor), (10, 10, 3 * floor + 1)) for floor in range(3)]
ALL = np.ones(3, np.bool_)
GOOD, POOR, OTHER = range(3)


@pytest.fixture
def floors(outline: MakeOutline) -> SetOutline:
    """Photos of the poor floor are mistaken for those of the good one."""
    made = outline(FLOORS, names=("good", "poor", "other"))
    tiles = list(made.tiles)
    tiles[POOR] = tiles[POOR].model_copy(update={"mistaken_for": ("good@v1",)})
    return replace(made, manifest=made.manifest.model_copy(update={"tiles": tuple(tiles)}))


def probable(probability: float | None) -> InstantAnswer:
    answer = localized(150, (5, 5, 0.5))
    assert answer.pose is not None
    return replace(answer, pose=replace(answer.pose, probability=probability))


def place(outline: SetOutline, row: int, probability: float | None) -> dict[int, PlaceAnswer]:
    return {row: PlaceAnswer(outline.ref, probable(probability), outline.tiles[row].ref)}


def elsewhere(*rows: int) -> np.ndarray:
    return np.isin(np.arange(3), rows)


def test_a_doubtful_answer_is_refused_where_a_poor_tile_may_be_right(floors: SetOutline) -> None:
    refusal = left_open(floors, GOOD, place(floors, GOOD, 0.89), elsewhere(POOR, OTHER), (GOOD,))

    assert refusal is not None
    assert refusal.reason is Reason.AMBIGUOUS
    assert "good@v1 explains the query with 150 inliers" in refusal.message
    assert "may also show poor@v1, whose own photos look like those of good@v1" in refusal.message
    (only,) = refusal.candidates  # the poor tile has no pose to state
    assert (only.tile, only.num_inliers) == ("good@v1", 150)


def test_a_worse_pose_of_a_poor_tile_elsewhere_is_a_candidate_too(floors: SetOutline) -> None:
    worse = PlaceAnswer(floors.ref, localized(20, (5, 5, 3.5)), floors.tiles[POOR].ref)
    answers = {POOR: worse, **place(floors, GOOD, 0.8)}

    refusal = left_open(floors, GOOD, answers, elsewhere(POOR), (GOOD,))

    assert refusal is not None
    assert [each.tile for each in refusal.candidates] == ["good@v1", "poor@v1"]


@pytest.mark.parametrize("probability", [0.9, 1.0, None])
def test_a_sure_answer_stands(floors: SetOutline, probability: float | None) -> None:
    answer = place(floors, GOOD, probability)
    assert left_open(floors, GOOD, answer, elsewhere(POOR, OTHER), (GOOD, OTHER)) is None


def test_a_doubtful_answer_of_a_tile_that_misses_its_own_photos_is_nothing_unusual(
    floors: SetOutline,
) -> None:
    tiles = list(floors.tiles)
    tiles[GOOD] = tiles[GOOD].model_copy(update={"misses_own_photos": True})
    sparse = replace(floors, manifest=floors.manifest.model_copy(update={"tiles": tuple(tiles)}))

    for probability, is_refused in ((0.89, False), (0.5, False), (0.49, True)):
        answer = place(sparse, GOOD, probability)
        refusal = left_open(sparse, GOOD, answer, elsewhere(POOR, OTHER), (GOOD,))
        assert (refusal is not None) == is_refused
        if refusal is not None:
            assert "whose own photos look like those of good@v1" in refusal.message


def test_a_tile_that_agrees_or_is_excluded_is_not_left_open(floors: SetOutline) -> None:
    assert left_open(floors, GOOD, place(floors, GOOD, 0.3), elsewhere(OTHER), (GOOD,)) is None


def test_photos_of_a_poor_tile_are_no_doubt_about_tiles_that_they_do_not_resemble(
    floors: SetOutline,
) -> None:
    answer = place(floors, OTHER, 0.6)
    assert left_open(floors, OTHER, answer, elsewhere(GOOD, POOR), (GOOD, OTHER)) is None


def test_an_answer_more_likely_wrong_than_right_gives_way_to_a_tile_as_similar(
    floors: SetOutline,
) -> None:
    for probability, close, is_refused in (
        (0.49, (OTHER, GOOD), True),
        (0.49, (OTHER,), False),
        (0.5, (OTHER, GOOD), False),
    ):
        refusal = left_open(
            floors, OTHER, place(floors, OTHER, probability), elsewhere(GOOD, POOR), close
        )
        assert (refusal is not None) == is_refused
        if refusal is not None:
            assert "good@v1, which looks about as much like it" in refusal.message


def test_tiles_whose_photos_lie_among_each_other_do_not_contradict(outline: MakeOutline) -> None:
    boxes = [((0, 0, 0), (10, 10, 1)), ((8, 0, 0), (18, 10, 1)), ((10.5, 0, 0), (18, 10, 1))]
    overlapping = outline(boxes)
    answer = place(overlapping, 0, 0.2)

    assert apart(overlapping.photo_boxes, 0).tolist() == [False, False, True]
    assert left_open(overlapping, 0, answer, elsewhere(1), (0, 1)) is None
    assert left_open(overlapping, 0, answer, elsewhere(1, 2), (0, 2)) is not None


def test_tiles_that_the_set_does_not_find_are_searched_where_an_answer_is_doubtful(
    floors: SetOutline,
) -> None:
    assert hard_to_find(floors, {"good@v1"}, elsewhere(POOR, OTHER)) == (POOR,)
    assert hard_to_find(floors, {"other@v1"}, elsewhere(POOR, GOOD)) == ()
    assert hard_to_find(floors, {"good@v1"}, elsewhere(OTHER)) == ()
    assert hard_to_find(floors, set(), ALL) == ()
