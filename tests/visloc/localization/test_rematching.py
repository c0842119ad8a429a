from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest

from tests.turning import turned_pixels, turned_points
from visloc.archive import MapStore
from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.features.networks.lightglue.model import SeenKeypoints
from visloc.geometry import Camera, Pose
from visloc.localization.localizer import Localizer
from visloc.matching.correspondences import NUM_REMATCHED, mutual_nearest_neighbours
from visloc.matching.products import round_descriptors
from visloc.options import LocalizeOptions, Matcher
from visloc.photos.reading import Photo, read_photo
from visloc.types import Localized

LIGHTGLUE = LocalizeOptions(matcher=Matcher.LIGHTGLUE)


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


@dataclass
class NearestNeighbours:
    """In the place of a network; notes what it was shown."""

    shown: list[tuple[SeenKeypoints, SeenKeypoints]] = field(default_factory=list)

    def match(self, a: SeenKeypoints, b: SeenKeypoints) -> Any:
        self.shown.append((a, b))
        return mutual_nearest_neighbours(
            round_descriptors(a.descriptors), round_descriptors(b.descriptors)
        )


@pytest.fixture
def network() -> NearestNeighbours:
    return NearestNeighbours()


@pytest.fixture
def localizer(built_maps: Path, network: NearestNeighbours) -> Localizer:
    extractor = make_local_features("sift")
    names: Any = {"sift": network}
    return Localizer(MapStore(built_maps).open("room"), extractor, make_matcher=names.__getitem__)


def localized(answer: object) -> Localized:
    assert isinstance(answer, Localized), answer
    return answer


def test_the_network_sees_the_photo_and_those_it_has_most_in_common_with(
    localizer: Localizer, network: NearestNeighbours, query: Query
) -> None:
    before = localized(localizer.localize(read_photo(query.image), query.camera, LocalizeOptions()))
    assert not network.shown  # only who asks for it pays for it
    answer = localized(localizer.localize(read_photo(query.image), query.camera, LIGHTGLUE))
    assert len(network.shown) == NUM_REMATCHED
    opened = localizer.map
    keypoints = [opened.keypoints(image).tolist() for image in range(len(opened.images))]
    for ours, theirs in network.shown:
        assert (ours.width, ours.height) == (theirs.width, theirs.height) == (256, 192)
        assert len(ours.keypoints) == len(ours.descriptors) == answer.evidence.num_keypoints
        assert len(theirs.descriptors) == len(
            opened.observations(keypoints.index(theirs.keypoints.tolist()))[0]
        )
        for seen in (ours, theirs):
            norms = np.linalg.norm(seen.descriptors, axis=1)
            np.testing.assert_allclose(norms, 1.0, atol=0.02)
    # What finds the same pairs gives the same pose.
    assert pose_error(answer.cam_from_world, before.cam_from_world) == pytest.approx(
        (0, 0), abs=1e-3
    )


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_that_is_read_upright_is_shown_upright(
    localizer: Localizer, network: NearestNeighbours, query: Query, orientation: int
) -> None:
    photo = read_photo(query.image)
    stored = Photo(turned_pixels(photo.rgb, orientation), orientation)
    localizer.look(stored, None, LIGHTGLUE)
    expected = localizer.look(photo, None, LIGHTGLUE)
    assert len(expected.matches.pixels) > 100
    turned, straight = network.shown[0][0], network.shown[-1][0]
    assert (turned.width, turned.height) == (straight.width, straight.height) == (256, 192)
    np.testing.assert_allclose(turned.keypoints, straight.keypoints, atol=1e-3)
    assert np.array_equal(turned.descriptors, straight.descriptors)


def test_photos_of_a_map_are_shown_as_their_features_were_found(
    localizer: Localizer, network: NearestNeighbours, query: Query
) -> None:
    photo = read_photo(query.image)
    localizer.look(photo, None, LIGHTGLUE)
    stored = [seen for _, seen in network.shown]
    network.shown.clear()
    opened = localizer.map
    turned = tuple(replace(image, turn=6) for image in opened.images)
    extractor = make_local_features("sift")
    names: Any = {"sift": network}
    of_turned = Localizer(replace(opened, images=turned), extractor, make_matcher=names.__getitem__)
    of_turned.look(photo, None, LIGHTGLUE)

    assert len(network.shown) == len(stored) > 0
    for (_, seen), before in zip(network.shown, stored, strict=True):
        assert (seen.width, seen.height) == (before.height, before.width)
        np.testing.assert_allclose(
            turned_points(seen.keypoints, (seen.width, seen.height), 6), before.keypoints, atol=1e-4
        )
        assert np.array_equal(seen.descriptors, before.descriptors)


def test_a_map_whose_features_have_no_network_says_so(built_maps: Path, query: Query) -> None:
    localizer = Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))
    with pytest.raises(InvalidInput) as caught:
        localizer.localize(read_photo(query.image), query.camera, LIGHTGLUE)
    assert caught.value.code == "options.matcher"


def test_clear_pairs_alone_give_the_pose_too(localizer: Localizer, queries: list[Query]) -> None:
    for query in queries:
        photo = read_photo(query.image)
        every = localized(localizer.localize(photo, query.camera, LocalizeOptions()))
        clear = localized(
            localizer.localize(photo, query.camera, LocalizeOptions(matcher=Matcher.RATIO))
        )
        assert clear.evidence.num_correspondences < every.evidence.num_correspondences
        assert clear.evidence.inlier_ratio > every.evidence.inlier_ratio
        position_m, orientation_deg = pose_error(clear.cam_from_world, query.cam_from_world)
        assert position_m < 0.003
        assert orientation_deg < 0.1


def test_a_map_of_xfeat_is_matched_by_its_network(
    sample: Path, tmp_path: Path, query: Query
) -> None:
    from mapping.pipeline.build import build_map
    from mapping.pipeline.settings import BuildSettings

    build_map(
        BuildSettings(sample / "mapping", "room", tmp_path, local_features="xfeat"), lambda *_: None
    )
    localizer = Localizer(MapStore(tmp_path).open("room"), make_local_features("xfeat"))
    answer = localized(localizer.localize(read_photo(query.image), query.camera, LIGHTGLUE))
    position_m, orientation_deg = pose_error(answer.cam_from_world, query.cam_from_world)
    assert position_m < 0.006
    assert orientation_deg < 0.2
    again = localized(localizer.localize(read_photo(query.image), query.camera, LIGHTGLUE))
    assert np.array_equal(again.cam_from_world.translation, answer.cam_from_world.translation)
