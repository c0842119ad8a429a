"""Cameras that were held turned, without EXIF, in a map of features that do not stand it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest

from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from tests.turning import turned_camera, turned_pixels, turned_pose
from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Camera, Pose
from visloc.localization.localizer import Localizer
from visloc.localization.turning import TurnFinder, turn_that_promises
from visloc.options import LocalizeOptions, ReadAs
from visloc.photos.reading import Photo, read_photo
from visloc.priors import GravityPrior, Priors
from visloc.types import Answer, Localized, NotLocalized

OPTIONS, UPRIGHT = LocalizeOptions(), LocalizeOptions(read_as=ReadAs.UPRIGHT)
DOWN = np.array([0.0, 0.0, -1.0])  # in the painted room


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


@pytest.fixture(scope="module")
def localizer(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Localizer:
    maps = tmp_path_factory.mktemp("turning")
    settings = BuildSettings(
        dataset=sample / "mapping",
        map_id="room",
        maps_dir=maps,
        method="rgbd",
        local_features="xfeat",
        max_keypoints=1500,
    )
    build_map(settings, lambda *_: None)
    return Localizer(MapStore(maps).open("room"), make_local_features("xfeat"))


def localized(answer: Answer) -> Localized:
    assert isinstance(answer, Localized), answer
    return answer


def refused(answer: Answer) -> NotLocalized:
    assert isinstance(answer, NotLocalized), answer
    return answer


def held(query: Query, orientation: int) -> tuple[Photo, Camera, Pose]:
    """The query of a camera that was held so, without EXIF."""
    pixels = turned_pixels(read_photo(query.image).rgb, orientation)
    pose = turned_pose(query.cam_from_world, orientation)
    return Photo(np.asarray(pixels, np.uint8)), turned_camera(query.camera, orientation), pose


@pytest.mark.parametrize(("orientation", "turned"), [(6, 90), (3, 180), (8, 270)])
def test_a_photo_of_a_turned_camera_is_found_and_the_answer_says_so(
    localizer: Localizer, query: Query, orientation: int, turned: int
) -> None:
    photo, camera, truth = held(query, orientation)
    refused(localizer.localize(photo, camera, UPRIGHT))
    answer = localized(localizer.localize(photo, camera, OPTIONS))
    assert answer.evidence.turned == turned
    assert answer.evidence.read_as is ReadAs.UPRIGHT
    assert answer.evidence.camera == camera
    assert pose_error(answer.cam_from_world, truth) < (0.02, 0.5)
    # The same features as those of the photo that was not turned.
    straight = localized(localizer.localize(*held(query, 1)[:2], OPTIONS))
    assert straight.evidence.turned == 0
    assert answer.evidence.num_inliers == pytest.approx(straight.evidence.num_inliers, rel=0.05)


def test_an_exif_orientation_that_is_wrong_is_seen_through(
    localizer: Localizer, query: Query
) -> None:
    photo, camera, truth = held(query, 3)
    answer = localized(localizer.localize(replace(photo, exif_orientation=6), camera, OPTIONS))
    assert answer.evidence.turned == 90
    assert pose_error(answer.cam_from_world, truth) < (0.02, 0.5)


def test_a_photo_that_is_upright_is_asked_once(
    localizer: Localizer, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TurnFinder, "find", _must_not)
    localized(localizer.localize(*held(query, 1)[:2], OPTIONS))


def test_a_photo_of_nothing_is_asked_once(
    localizer: Localizer, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    random = np.random.default_rng(2)
    rgb = random.integers(0, 256, read_photo(query.image).rgb.shape, dtype=np.uint8)
    looks: list[int] = []
    look = Localizer.look

    def counted(self: Localizer, *args: object) -> object:
        looks.append(args[5] if len(args) > 5 else 0)  # type: ignore[arg-type]
        return look(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(Localizer, "look", counted)
    refused(localizer.localize(Photo(rgb), query.camera, OPTIONS))
    assert looks == [0]


def test_gravity_tells_the_turn(
    localizer: Localizer, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo, camera, truth = held(query, 8)
    asked: list[int] = []
    count = TurnFinder._clear_matches

    def counted(self: TurnFinder, *args: object) -> int:
        asked.append(1)
        return count(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(TurnFinder, "_clear_matches", counted)
    gravity = GravityPrior(truth.rotation @ DOWN, 0.03, DOWN)
    answer = localized(localizer.localize(photo, camera, OPTIONS, Priors(gravity=gravity)))
    assert answer.evidence.turned == 270
    assert len(asked) == 2  # that turn, and the photo as it is
    # An upright photo of another place has nothing to turn.
    asked.clear()
    upright = GravityPrior(query.cam_from_world.rotation @ DOWN, 0.03, DOWN)
    rgb = np.random.default_rng(2).integers(
        0, 256, read_photo(query.image).rgb.shape, dtype=np.uint8
    )
    refused(localizer.localize(Photo(rgb), query.camera, OPTIONS, Priors(gravity=upright)))
    assert not asked


def test_a_clear_turn_counts_when_the_photo_as_it_was_shows_something_too() -> None:
    # An upside-down photo of a symmetric room; the last turn is not looked at, as 110 is clear.
    assert turn_that_promises({0: 60, 90: 3, 180: 110}) == 180
    assert turn_that_promises({0: 60, 90: 3, 180: 110, 270: 3}) == 180
    assert turn_that_promises({0: 60, 90: 58, 180: 110, 270: 57}) == 0
    assert turn_that_promises({0: 110, 90: 3, 180: 60, 270: 3}) == 0
    assert turn_that_promises({0: 2, 90: 19, 180: 1, 270: 2}) == 0


def _must_not(*_: object) -> int:
    raise AssertionError("the photo needs no turn")
