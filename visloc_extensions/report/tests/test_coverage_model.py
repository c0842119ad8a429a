from __future__ import annotations

import numpy as np
import pytest

from mapping.cluster.workers import Workers
from mapping.own_test.held_out import HeldOut, tolerance_of
from mapping.stages.work_folder import WorkFolder
from visloc.geometry import Camera
from visloc.localization.map_view.constraints import MapGeometry
from visloc.options import LocalizeOptions
from visloc_extensions.report.chance import Outlook, fit_chance, fit_precision, outlook_of
from visloc_extensions.report.held_out import hold_out
from visloc_extensions.report.model import learn
from visloc_extensions.report.rematch import Rematch, count, fit_rematch
from visloc_extensions.report.sight import Sight

CAMERA = Camera("PINHOLE", 320, 240, (220.0, 220.0, 160.0, 120.0))


def sight_of(points, *, angles_deg=0.0, octaves=0.0, observers=1, behind=0.0):
    """Points (n, 3) in the camera's frame, all known from the same aside."""
    count_, distances = len(points), np.linalg.norm(points, axis=1)

    def all_of(value, dtype=np.float64):
        return np.broadcast_to(np.asarray(value, dtype=dtype), count_)

    return Sight(
        0.1,
        np.arange(count_),
        np.zeros((count_, 2)),
        points / distances[:, None],
        distances,
        all_of(angles_deg),
        all_of(octaves),
        all_of(observers, np.int64),
        all_of(behind),
    )


def cloud(count_=400, depth=3.0):
    random = np.random.default_rng(0)
    return np.column_stack(
        [random.uniform(-1, 1, (count_, 2)), random.uniform(0.7 * depth, 1.3 * depth, count_)]
    )


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("angles_deg", np.linspace(0, 180, 40)),
        ("octaves", np.linspace(0, 4, 40)),
        ("octaves", np.linspace(0, -4, 40)),
        ("observers", np.arange(20, 0, -1)),
        ("behind", np.linspace(0, 3, 40)),
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_seen_less_alike_is_never_found_more_often(name, values, seed):
    # Even when fitted to counts that say nothing, or the contrary.
    random = np.random.default_rng(seed)
    runs = [
        count(sight_of(cloud(60), **{name: float(v) if name != "observers" else int(v)}), matches)
        for v in values
        for matches in [random.integers(0, 3, 60)]
    ]
    model = fit_rematch(runs)
    expected = [model.expected(sight_of(cloud(1), **{name: v}))[0] for v in values]
    assert (np.diff(expected) <= 1e-12).all()


def test_the_angle_table_is_learned_from_counts():
    random = np.random.default_rng(0)
    truth = {1.0: 0.6, 15.0: 0.3, 35.0: 0.05}
    runs = [
        count(sight_of(cloud(3000), angles_deg=angle), random.poisson(rate, 3000))
        for angle, rate in truth.items()
    ]
    model = fit_rematch(runs)
    for angle, rate in truth.items():
        found = model.expected(sight_of(cloud(1), angles_deg=angle))[0]
        assert found == pytest.approx(rate, rel=0.15)


def test_expected_matches_of_nothing_in_view_are_none():
    outlook = outlook_of(sight_of(np.empty((0, 3))), np.empty(0), 1.0, CAMERA, 1.0)
    assert outlook.expected_inliers == 0.0
    assert outlook.scatter == np.inf


def test_scatter_is_that_of_a_least_squares_pose():
    # Monte Carlo: perturb directions by the noise, solve the linear problem for the pose.
    points, noise_px = cloud(), 2.0
    sight = sight_of(points)
    stated = outlook_of(sight, np.ones(len(points)), 1.0, CAMERA, noise_px).scatter
    random = np.random.default_rng(0)
    rows = []
    for ray, distance in zip(sight.rays, sight.distances, strict=True):
        first = np.cross(ray, [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        for axis in (first, np.cross(ray, first)):
            # d ray = w x ray + P dt / d, along an axis at right angles to the ray.
            rows.append(np.concatenate([np.cross(ray, axis), axis / distance]))
    design = np.array(rows)
    noise = random.normal(scale=noise_px / CAMERA.focal_length, size=(len(design), 400))
    solved = np.linalg.lstsq(design, noise, rcond=None)[0]
    assert stated == pytest.approx(np.sqrt((solved[3:] ** 2).sum(axis=0).mean()), rel=0.05)


def test_scatter_shrinks_with_matches_and_a_sample_stands_for_all():
    points = cloud()
    all_seen = outlook_of(sight_of(points), np.ones(400), 1.0, CAMERA, 1.0)
    half = outlook_of(sight_of(points), np.full(400, 0.25), 1.0, CAMERA, 1.0)
    assert half.scatter == pytest.approx(2.0 * all_seen.scatter)
    sampled = outlook_of(sight_of(points), np.full(400, 0.25), 0.25, CAMERA, 1.0)
    assert sampled.expected_inliers == pytest.approx(all_seen.expected_inliers)
    assert sampled.scatter == pytest.approx(all_seen.scatter)


def test_points_in_one_spot_determine_no_position():
    spot = np.broadcast_to(np.array([0.1, 0.2, 3.0]), (100, 3))
    assert outlook_of(sight_of(spot), np.ones(100), 1.0, CAMERA, 1.0).scatter == np.inf


def test_chances_lie_between_0_and_1_and_rise_with_what_is_found():
    chance = fit_chance([], np.empty(0, dtype=np.bool_), 0.25)
    inliers = [0.0, 1.0, 10.0, 100.0, 1e4, 1e9]
    found = chance.of([Outlook(number, 0.02, 0.3) for number in inliers])
    assert (found >= 0).all()
    assert (found <= 1).all()
    assert (np.diff(found) > 0).all()
    assert found[0] < 0.01
    assert found[-1] > 0.99
    assert chance.of([Outlook(0.0, np.inf, np.inf)])[0] < 0.01


def test_the_border_between_success_and_failure_is_learned():
    outlooks = [Outlook(float(number), 0.02, 0.3) for number in np.geomspace(5, 5000, 200)]
    succeeded = np.array([outlook.expected_inliers > 400 for outlook in outlooks])
    chance = fit_chance(outlooks, succeeded, 0.25)
    assert chance.of([Outlook(120.0, 0.02, 0.3)])[0] < 0.1
    assert chance.of([Outlook(1200.0, 0.02, 0.3)])[0] > 0.9


def test_runs_that_all_succeed_do_not_promise_success_everywhere():
    outlooks = [Outlook(1000.0 + i, 0.005, 0.1) for i in range(100)]
    chance = fit_chance(outlooks, np.ones(100, dtype=np.bool_), 0.25)
    assert chance.of([Outlook(10.0, 0.2, 1.5)])[0] < 0.1


def test_the_standard_deviation_learns_how_large_errors_are():
    random = np.random.default_rng(0)
    outlooks = [Outlook(300.0, s, 0.3) for s in random.uniform(0.001, 0.01, 300)]
    scatters = np.array([outlook.scatter for outlook in outlooks])
    errors = np.linalg.norm(random.normal(size=(300, 3)), axis=1) * 4.0 * scatters / np.sqrt(3)
    errors[::10] = np.inf
    precision = fit_precision(outlooks, errors, 0.25)
    assert precision.std(Outlook(300.0, 0.004, 0.3)) == pytest.approx(0.016, rel=0.2)
    assert precision.std(Outlook(2.0, np.inf, 0.3)) == np.inf


@pytest.fixture(scope="module")
def learned(half_mapped_room, tmp_path_factory):
    viewpoints = MapGeometry(half_mapped_room).viewpoints
    with Workers(1) as workers:
        work = WorkFolder(tmp_path_factory.mktemp("work"))
        runs = hold_out(half_mapped_room, work, workers, lambda *_: None)
    within = tolerance_of(half_mapped_room, viewpoints)
    return runs, learn(half_mapped_room, viewpoints, runs, within, lambda *_: None)


def test_expected_inliers_follow_what_was_matched(learned):
    runs, found = learned
    measured = np.array([len(run.correct) for run in runs])
    assert np.corrcoef(found.expected_inliers, measured)[0, 1] > 0.8
    assert found.expected_inliers.sum() == pytest.approx(measured.sum(), rel=0.2)
    assert ((found.probabilities >= 0) & (found.probabilities <= 1)).all()


def test_predictions_of_a_run_do_not_know_its_photo(half_mapped_room, learned):
    # The same map, but all runs of one photo lie: what is said of these runs stays the same.
    runs, found = learned
    lying = [
        HeldOut(r.image, r.left_out, "no_pose", np.inf, np.inf, 0, r.correct[:0], r.errors_px[:0])
        if r.image == 3
        else r
        for r in runs
    ]
    viewpoints = MapGeometry(half_mapped_room).viewpoints
    within = tolerance_of(half_mapped_room, viewpoints)
    again = learn(half_mapped_room, viewpoints, lying, within, lambda *_: None)
    of_photo = np.array([run.image == 3 for run in runs])
    assert again.probabilities[of_photo].tolist() == found.probabilities[of_photo].tolist()
    assert again.probabilities[~of_photo].tolist() != found.probabilities[~of_photo].tolist()


def test_a_photo_of_the_unphotographed_half_is_not_expected_to_be_localized(learned, looking):
    model = learned[1].model
    towards = model.forecast(looking((-0.5, 0.2, 0.1), 5.0), CAMERA)
    away = model.forecast(looking((-0.5, 0.2, 0.1), 185.0), CAMERA)
    assert towards.probability > 0.9
    assert away.probability < 0.1
    assert towards.position_std < 0.25
    assert towards.outlook.expected_inliers > 10 * away.outlook.expected_inliers


def test_as_many_photos_are_asked_as_queries_ask():
    assert LocalizeOptions().top_k == 20  # what the documentation says of the model


def test_without_runs_the_model_knows_what_was_thought_before():
    model = fit_rematch([])
    assert isinstance(model, Rematch)
    here, aside = (model.expected(sight_of(cloud(1), angles_deg=angle))[0] for angle in (0.0, 60.0))
    assert 0.1 < here < 0.5
    assert aside < 0.1 * here
