"""Incremental mapping in steps: the model of COLMAP's pipeline, and progress in every step."""

from __future__ import annotations

import _thread
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse import adjustment
from mapping.methods.sparse.adjustment import adjusted_robustly
from mapping.methods.sparse.colmap_scene import colmap_database
from mapping.methods.sparse.incremental import largest_model
from mapping.methods.sparse.triangulation import pipeline_options
from tests.mapping.methods.sparse.test_triangulation import CONFIG, World, make_world

Told = list[tuple[int, int]]
PHOTOS = 12


@contextmanager
def prepared(
    world: World, work: Path
) -> Iterator[tuple[Path, pycolmap.IncrementalPipelineOptions]]:
    """A database of a world's photos, without their poses, and options that keep its camera."""
    photos = [replace(photo, cam_from_world=None) for photo in world.photos]
    with colmap_database(photos, {}, world.matches, work) as (path, scene):
        options = pipeline_options(CONFIG)
        options.constant_cameras = set(scene.camera_ids.values())
        options.image_names = [photo.name for photo in photos]
        yield path, options


def centers(model: pycolmap.Reconstruction) -> dict[str, list[float]]:
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    return {image.name: image.projection_center().tolist() for image in images}


def test_the_model_is_that_of_colmaps_pipeline(tmp_path: Path) -> None:
    with prepared(make_world(PHOTOS, noise_px=0.5), tmp_path) as (path, options):
        model = largest_model(path, options, lambda *_: None)
        (expected,) = pycolmap.incremental_mapping(path, tmp_path, tmp_path, options).values()
    assert model is not None
    found, known = centers(model), centers(expected)
    assert found.keys() == known.keys()
    assert len(found) == PHOTOS
    for name, center in known.items():
        np.testing.assert_allclose(found[name], center, atol=1e-5)


def test_each_photo_and_each_adjustment_is_told(tmp_path: Path) -> None:
    told: Told = []
    with prepared(make_world(PHOTOS, noise_px=0.5), tmp_path) as (path, options):
        largest_model(path, options, lambda *now: told.append(now))
    assert told == sorted(told)
    assert told[0][0] == 2
    assert {total for _, total in told} == {3 * PHOTOS}
    assert told[-1] == (3 * PHOTOS, 3 * PHOTOS)
    assert told.count(told[-1]) == 1
    # Each photo joins by itself, and the model is adjusted both while it grows and at its end.
    counts = [done for done, _ in told]
    assert len(set(counts)) >= PHOTOS + 3
    assert max(counts[:-1]) >= 3 * PHOTOS - 1


def test_large_models_are_told_more_often_and_come_out_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An adjustment reports after fewer steps where each takes long."""
    told: dict[str, Told] = {"few": [], "many": []}
    found = {}
    with prepared(make_world(PHOTOS, noise_px=0.5), tmp_path) as (path, options):
        for how, steps in (("many", Told()), ("few", Told())):
            if how == "few":
                monkeypatch.setattr(adjustment, "_OBSERVED_IN_STEPS", 1)
            model = largest_model(path, options, lambda *now: steps.append(now))  # noqa: B023
            assert model is not None
            told[how], found[how] = steps, centers(model)
    assert len(told["few"]) > len(told["many"])
    assert found["few"].keys() == found["many"].keys()
    for name, center in found["many"].items():
        np.testing.assert_allclose(found["few"][name], center, atol=1e-4)


@pytest.mark.parametrize("steps", [1, 2, 3, 8])
def test_adjustments_of_few_steps_at_once_do_not_repeat_steps_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    """They end before the limit of 100 steps, where all steps at once end."""
    with prepared(make_world(PHOTOS, noise_px=0.5), tmp_path) as (path, options):
        model = largest_model(path, options, lambda *_: None)
    assert model is not None
    rng = np.random.default_rng(1)
    for point in model.points3D.values():
        point.xyz += rng.normal(0, 3.0, 3)  # so far off that some steps fail
    told: Told = []
    errors = {}
    for at_once in (100, steps):
        monkeypatch.setattr(adjustment, "_STEPS", at_once)
        told.clear()
        adjusted = adjusted_robustly(model, set(), lambda *now: told.append(now))
        errors[at_once] = adjusted.compute_mean_reprojection_error()
    assert errors[steps] == pytest.approx(errors[100], rel=1e-3)
    assert steps * len(told) < 90


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_ends_an_adjustment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: Told = []

    def stop(*now: int) -> None:
        told.append((now[0], now[1]))
        if len(told) == 8:  # within the adjustments of the first photos
            _thread.interrupt_main()
            # The main thread sees it as soon as pycolmap lets it run.
            assert interrupted.wait(10)

    interrupted = threading.Event()
    before = pycolmap.CancellationToken.cancel

    def cancel(token: pycolmap.CancellationToken) -> None:
        before(token)
        interrupted.set()

    monkeypatch.setattr(pycolmap.CancellationToken, "cancel", cancel)
    with (
        prepared(make_world(PHOTOS, noise_px=0.5), tmp_path) as (path, options),
        pytest.raises(KeyboardInterrupt),
    ):
        largest_model(path, options, stop)
    assert len(told) <= 9


def test_of_two_places_the_larger_is_the_model(tmp_path: Path) -> None:
    """Whichever of them mapping begins with: photos left that may be more are mapped too."""
    world = make_world(PHOTOS)
    for first, last in ((0, 5), (7, PHOTOS)):  # the place with most matches is not the larger one
        few = [p for p in world.matches if first <= p.first and p.second < last]
        others = [
            Matches(p.first, p.second, p.rows[:150])
            for p in world.matches
            if not (first <= p.first < last or first <= p.second < last)
        ]
        with prepared(replace(world, matches=[*few, *others]), tmp_path) as (path, options):
            model = largest_model(path, options, lambda *_: None)
        assert model is not None
        placed = {int(Path(name).stem) for name in centers(model)}
        assert placed == set(range(PHOTOS)) - set(range(first, last))


def test_photos_that_share_nothing_make_no_model_and_the_stage_ends(tmp_path: Path) -> None:
    world, told = make_world(4), Told()
    few = [replace(world.matches[0], rows=world.matches[0].rows[: CONFIG.min_num_matches])]
    with prepared(replace(world, matches=few), tmp_path) as (path, options):
        assert largest_model(path, options, lambda *now: told.append(now)) is None
        options.image_names = []
        assert largest_model(path, options, lambda *_: None) is None
    assert told[-1] == (6, 6)  # of the two photos that have matches
