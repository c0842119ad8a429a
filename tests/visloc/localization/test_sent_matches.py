"""Matches that come with features replace matching by descriptors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import Map, MapStore
from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.types import Answer, Localized, NotLocalized, QueryFeatures


@pytest.fixture(scope="module")
def localizer(built_maps: Path) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


def shared(opened: Map, a: int, b: int) -> NDArray[np.float32]:
    """Matches (k, 3) of two photos of a map: those where both see a landmark."""
    seen_a, seen_b = (opened.observations(image)[0] for image in (a, b))
    _, i, j = np.intersect1d(seen_a, seen_b, return_indices=True)
    return np.column_stack([i, opened.keypoints(b)[j]]).astype(np.float32)


def asked(
    localizer: Localizer, matches: dict[str, NDArray[np.float32]], *, shuffled: bool = True
) -> Answer:
    """Localize the first photo by what the map keeps of it, without its own landmarks."""
    opened = localizer.map
    descriptors = opened.observations(0)[1].astype(np.float32)
    if shuffled:
        descriptors = np.random.default_rng(0).permutation(descriptors)
    vectors = {
        name: rows[:1][0] for name, rows in opened.global_descriptors.items() if name != "localvlad"
    }
    features = QueryFeatures("sift", opened.keypoints(0), descriptors, vectors, matches)
    others = tuple(image.name for image in opened.images[1:])
    camera = opened.cameras[opened.images[0].camera]
    return localizer.localize_features(features, camera, LocalizeOptions(photos=others))


def test_the_pose_is_that_of_the_matches(localizer: Localizer) -> None:
    opened = localizer.map
    by_photo = {
        opened.images[row].name: shared(opened, 0, row) for row in range(1, len(opened.images))
    }
    answer = asked(localizer, by_photo)
    assert isinstance(answer, Localized)
    row = opened.image_poses[0]
    truth = Pose.from_quaternion(row[:4], row[4:])
    metres, degrees = pose_error(answer.cam_from_world, truth)
    assert metres < 0.01
    assert degrees < 0.2
    # The same descriptors, which belong to other keypoints, localize nothing.
    assert isinstance(asked(localizer, {}), NotLocalized)


def test_matches_beside_keypoints_of_the_map_say_nothing(localizer: Localizer) -> None:
    opened = localizer.map
    beside = {
        opened.images[row].name: shared(opened, 0, row) + np.float32([0, 0.5, 0])
        for row in range(1, len(opened.images))
    }
    answer = asked(localizer, beside, shuffled=False)
    assert isinstance(answer, NotLocalized)
    assert answer.evidence.num_correspondences < 30
    none = {opened.images[1].name: np.empty((0, 3), np.float32)}
    assert isinstance(asked(localizer, none, shuffled=False), NotLocalized)


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((4, 2)),
        np.zeros((100_000, 3)),  # more than there are keypoints
        np.zeros(3),
        np.array([[-1.0, 5, 5]]),
        np.array([[0.5, 5, 5]]),
        np.array([[1e9, 5, 5]]),
        np.array([[np.nan, 5, 5]]),
        np.array([[0, np.inf, 5]]),
    ],
)
def test_matches_that_mean_nothing_are_refused(
    localizer: Localizer, wrong: NDArray[np.float64]
) -> None:
    name = localizer.map.images[1].name
    with pytest.raises(InvalidInput, match="a row of the") as caught:
        asked(localizer, {name: wrong})
    assert (caught.value.code, caught.value.field) == (
        "features.matches",
        f"features.matches.{name}",
    )


def test_matches_with_photos_that_the_map_lacks_are_refused_by_name(localizer: Localizer) -> None:
    opened = localizer.map
    known = {opened.images[1].name: shared(opened, 0, 1)}
    unknown = {f"left/{number}.jpgg": shared(opened, 0, 1) for number in range(5)}
    with pytest.raises(InvalidInput) as caught:
        asked(localizer, known | unknown)
    error = caught.value
    assert (error.code, error.field) == ("features.matches", "features.matches.left/0.jpgg")
    assert "left/0.jpgg, left/1.jpgg, left/2.jpgg and 2 more" in str(error.got)
    assert opened.images[1].name not in str(error.got)
