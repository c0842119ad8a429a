"""Figures of outcomes, against figures worked out otherwise."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.trust.asking import Maps
from benchmarks.trust.maps import floor_of
from benchmarks.trust.measures import at_most, calibration_error, uncertainty
from benchmarks.trust.outcomes import Outcome, Query, RigPhoto, outcome_of
from benchmarks.trust.table import write_tables
from visloc.archive import MapStore
from visloc.evaluation import Threshold
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc.photos.reading import read_photo_file
from visloc.types import InstantAnswer, PoseSource, RigPose, Uncertainty

ASKED = Outcome("redkitchen", "redkitchen", "a.jpg", accepted=True, right=True)


def with_errors(random: np.random.Generator, covariance: np.ndarray, scale: float) -> list[Outcome]:
    root = np.linalg.cholesky(covariance)
    rows = tuple(tuple(map(float, row)) for row in covariance)
    return [
        replace(ASKED, error=tuple(scale * root @ random.normal(size=3)), covariance=rows)
        for _ in range(200)
    ]


def test_the_binomial_test_is_the_sum_of_its_terms() -> None:
    terms = [math.comb(39, k) * 0.95**k * 0.05 ** (39 - k) for k in range(40)]

    for inside in (0, 30, 34, 39):
        assert at_most(inside, 39) == pytest.approx(sum(terms[: inside + 1]))


def test_true_covariances_hold_and_narrow_ones_do_not() -> None:
    random = np.random.default_rng(0)
    spread = random.normal(size=(3, 3))
    covariance = spread @ spread.T + 0.1 * np.eye(3)

    true = uncertainty(with_errors(random, covariance, 1.0))
    narrow = uncertainty(with_errors(random, covariance, 2.0))

    assert true is not None
    assert narrow is not None
    assert true.holds
    assert 0.5 < true.ratio < 1.5
    assert not narrow.holds
    assert narrow.ratio == pytest.approx(2 * true.ratio, rel=0.2)


def test_answers_without_truth_are_not_counted() -> None:
    assert uncertainty([ASKED, replace(ASKED, error=(1.0, 0.0, 0.0))]) is None
    exact = replace(ASKED, error=(0.0, 0.0, 2.0), covariance=((1, 0, 0), (0, 1, 0), (0, 0, 2)))
    found = uncertainty([ASKED, exact])
    assert found is not None
    assert (found.count, found.inside, found.ratio) == (1, 1, 1.0)


def test_calibration_error_is_the_weighted_distance_of_ten_bins() -> None:
    # 4 of 0.95 of which 3 are right; 2 of 0.25 of which none is; 1.0 falls into the last bin.
    stated = [0.95, 0.95, 0.95, 0.95, 0.25, 0.25]
    came = [True, True, True, False, False, False]
    assert calibration_error(stated, came) == pytest.approx((4 * 0.20 + 2 * 0.25) / 6)
    assert calibration_error([1.0, 1.0], [True, True]) == 0.0
    assert calibration_error([0.55, 0.59], [True, False]) == pytest.approx(0.07)


def test_an_answer_that_is_asked_for_twice_counts_once_in_the_calibration() -> None:
    by_day = [replace(ASKED, photo=f"{i}.jpg", probability=0.9) for i in range(10)]
    at_night = replace(ASKED, scenario="gardenspoint night", map_id="walk", probability=0.3)
    by_number = replace(at_night, scenario="night by number")
    other = replace(at_night, photo="b.jpg", right=False, probability=0.995)

    told = "\n".join(write_tables([*by_day, at_night, by_number, other]))

    assert "| all | 12 | 0.86 | 0.92 | 0.059 | 1 | 1 |" in told
    assert "| by night | 2 | 0.65 | 0.50 | 0.847 | 1 | 1 |" in told
    assert "| others | 10 | 0.90 | 1.00 | 0.100 | 0 | 0 |" in told
    assert "look alike" not in told


def test_an_answer_is_held_against_the_truth() -> None:
    truth = Pose.from_quaternion((0.9, 0.1, -0.3, 0.2), (1.0, 2.0, 3.0))
    query = Query("tried", "room", "b.jpg", (), truth, Threshold(0.15, 5.0))
    # The camera moved by 0.1 along the world's x.
    moved = Pose(truth.rotation, truth.translation - truth.rotation @ [0.1, 0.0, 0.0])
    in_camera = np.diag([0, 0, 0, 1e-4, 4e-4, 9e-4])
    pose = RigPose(
        moved,
        in_camera,
        np.ones(3),
        np.ones(3),
        PoseSource.ESTIMATED,
        photo_covariance=in_camera,
        uncertainty=Uncertainty.WHOLE,
    )

    outcome = outcome_of(query, InstantAnswer(None, (), pose, None, {}))

    assert outcome.accepted
    assert outcome.right
    assert outcome.error == pytest.approx((0.1, 0.0, 0.0))
    in_world = truth.rotation.T @ np.diag([1e-4, 4e-4, 9e-4]) @ truth.rotation
    assert np.array(outcome.covariance) == pytest.approx(in_world)
    assert outcome.probability is None

    def rightness(query: Query) -> bool | None:
        return outcome_of(query, InstantAnswer(None, (), pose, None, {})).right

    assert rightness(replace(query, within=Threshold(0.05, 5.0))) is False
    assert rightness(replace(query, truth=None)) is None
    assert rightness(replace(query, truth=None, within=None)) is False


@pytest.mark.parametrize(
    ("name", "floor"),
    [("lobby11@1", "11"), ("floor10-left@1", "10"), ("floor13/f13_lobby.jpg", "13")],
)
def test_floors_are_read_from_names(name: str, floor: str) -> None:
    assert floor_of(name) == floor


def test_photos_of_the_sample_are_asked_and_tabled(sample: Path, built_maps: Path) -> None:
    dataset = read_dataset(sample / "query")
    record = dataset.images[0]
    camera = dataset.sensors[record.sensor_id].camera
    assert camera is not None
    photo = RigPhoto("camera", Pose.identity(), read_photo_file(dataset.path_of(record)), camera)
    within = Threshold(0.05, 1.0)
    right = Query("sample", "room", record.path, (photo,), dataset.pose(record), within)
    other_size = replace(photo, camera=replace(camera, width=camera.width + 60))
    error = replace(right, scenario="stretched", photos=(other_size,))

    outcomes = list(Maps(MapStore(built_maps), None).ask([right, error]))

    assert [each.reason for each in outcomes] == [None, "camera.size_mismatch"]
    assert outcomes[0].right
    told = "\n".join(write_tables(outcomes))
    assert "| sample | 1 | 1 | 1 | 0 | 1, 0 |" in told
    assert "| stretched | 1 | 0 | 0 | 0 | 0, 0 | camera.size_mismatch 1 |" in told
