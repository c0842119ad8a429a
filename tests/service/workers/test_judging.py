"""Which answer of maps, sets and tiles counts, with answers that are made up."""

from __future__ import annotations

from typing import Any

import numpy as np

from service.values import Localization
from service.workers.judging import judged
from tests.visloc.answers import localized, refused
from visloc.archive import Geodetic
from visloc.types import Reason


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
