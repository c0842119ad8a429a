"""Which answer of maps, sets and tiles counts, with answers that are made up."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from service.values import Localization
from service.workers.judging import gated, judged, settled
from tests.visloc.answers import localized, refused
from visloc.archive import Geodetic
from visloc.options import LocalizeOptions
from visloc.priors import NO_PRIORS
from visloc.types import InstantAnswer, Reason


def of_map(ref: str, answer: Any, tile: str | None = None, **frame: Any) -> Localization:
    map_id, _, version = ref.partition("@")
    return Localization(answer, map_id, version, tile=tile, reach=3.0, **frame)


def on_earth(scale: float = 1.0, shift: float = 0.0) -> Geodetic:
    return Geodetic(
        latitude_deg=48.0,
        longitude_deg=8.0,
        altitude_m=400.0,
        scale=scale,
        translation=(shift, 0.0, 0.0),
    )


def test_a_map_that_answers_by_itself_and_as_a_tile_is_no_rival_of_itself() -> None:
    found = [
        of_map("site@v1", localized(200, (100, 0, 0)), tile="room@v1"),
        of_map("room@v1", localized(200)),
    ]

    row, best = judged(found)

    assert (row, best.map_id) == (0, "site")
    assert best.answer.pose is not None


def test_what_another_map_made_ambiguous_stays_so_beside_the_pose_of_a_tile() -> None:
    undecided = of_map("room@v1", refused(200, Reason.AMBIGUOUS))
    tile = of_map("site@v1", localized(200), tile="room@v1")

    for found in ([tile, undecided], [undecided, tile]):
        answer = judged(found)[1].answer
        assert answer.refusal is not None
        assert (answer.pose, answer.refusal.reason) == (None, Reason.AMBIGUOUS)


def test_versions_in_frames_of_their_own_are_compared_on_earth() -> None:
    before = of_map("room@v1", localized(200, (1, 2, 3)), geodetic=on_earth())
    after = of_map("room@v2", localized(190, (-99, 2, 3)), geodetic=on_earth(shift=100.0))
    moved = of_map("room@v2", localized(190, (1, 2, 3)), geodetic=on_earth(shift=100.0))

    assert judged([before, after])[1].answer.pose is not None
    assert judged([before, moved])[1].answer.pose is None


def test_certainty_is_compared_in_one_unit() -> None:
    coarse = of_map("coarse@v1", localized(200, std=0.1), geodetic=on_earth(scale=10.0))
    fine = of_map("fine@v1", localized(190, std=0.5), geodetic=on_earth())

    for found in ([coarse, fine], [fine, coarse]):
        assert judged(found)[1].map_id == "fine"
    assert np.isclose(coarse.reach, fine.reach)


def likely(answer: InstantAnswer, probability: float) -> InstantAnswer:
    assert answer.pose is not None
    return replace(answer, pose=replace(answer.pose, probability=probability))


def test_a_raised_gate_refuses_the_best_place_and_never_makes_the_second_best_win() -> None:
    best = of_map("site@v1", likely(localized(400), 0.5), tile="a@v1")
    second = of_map("site@v1", likely(localized(60, (50, 0, 0)), 0.95), tile="b@v1")
    row, found = judged([second, best])
    assert row == 1

    for asked, believed in ((None, True), (0.4, True), (0.8, False)):
        answer = gated(found, LocalizeOptions(min_probability=asked)).answer
        assert (answer.pose is not None) == believed
        if not believed:
            assert answer.refusal is not None
            assert answer.refusal.reason is Reason.UNLIKELY_POSE
            assert "0.50" in answer.refusal.message


def test_a_sequence_settles_on_no_second_best_map() -> None:
    best = of_map("a@v1", likely(localized(400), 0.5))
    second = of_map("b@v1", likely(localized(60, (50, 0, 0)), 0.95))

    assert settled([second, best], LocalizeOptions(), NO_PRIORS) == (1, None)
    row, refusal = settled([second, best], LocalizeOptions(min_probability=0.8), NO_PRIORS)
    assert row is None
    assert refusal is not None
    assert refusal.reason is Reason.UNLIKELY_POSE
    rival = of_map("c@v1", likely(localized(390, (50, 0, 0)), 0.95))
    row, refusal = settled([rival, best], LocalizeOptions(), NO_PRIORS)
    assert row is None
    assert refusal is not None
    assert refusal.reason is Reason.AMBIGUOUS
    wrong_camera = of_map("d@v1", refused(500, Reason.CAMERA_CONTRADICTED))
    row, refusal = settled([second, wrong_camera], LocalizeOptions(), NO_PRIORS)
    assert row is None
    assert refusal is not None
    assert refusal.reason is Reason.CAMERA_CONTRADICTED


def test_a_pose_that_was_not_judged_passes_every_gate() -> None:
    found = of_map("room@v1", localized(200))

    assert gated(found, LocalizeOptions(min_probability=1.0)) is found
