from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.turning import png, turned_camera, turned_pixels, turned_pose
from visloc.archive import MapStore
from visloc.evaluation import CHI2_95_OF_3, pose_error
from visloc.features import make_local_features
from visloc.geometry import Camera, Pose, center_covariance
from visloc.localization.coarse import _Widening
from visloc.localization.localizer import Localizer
from visloc.options import Fallback, LocalizeOptions, ReadAs
from visloc.photos.reading import read_photo
from visloc.priors import NO_PRIORS, PositionPrior, Priors
from visloc.types import CoarsePose, Localized, NotLocalized

# No pose has so many inliers: every photo is refused.
REFUSED = LocalizeOptions(fallback=Fallback.COARSE, min_inliers=1_000_000, read_as=ReadAs.UPRIGHT)


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


@pytest.fixture(scope="module")
def localizer(built_maps: Path) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


def coarse(localizer: Localizer, query: Query, priors: Priors = NO_PRIORS) -> CoarsePose | None:
    answer = localizer.localize(read_photo(query.image), query.camera, REFUSED, priors)
    assert isinstance(answer, NotLocalized)
    return answer.coarse


def test_a_refused_photo_has_a_coarse_pose_whose_spread_holds(
    localizer: Localizer, queries: list[Query]
) -> None:
    squares, errors = [], []
    for query in queries:
        found = coarse(localizer, query)
        assert found is not None
        errors.append(pose_error(found.cam_from_world, query.cam_from_world))
        truth = query.cam_from_world
        spread = center_covariance(found.cam_from_world, found.covariance)
        turned = Rotation.from_matrix(truth.rotation @ found.cam_from_world.rotation.T).as_rotvec()
        moved = truth.center - found.cam_from_world.center
        for error, part in ((turned, spread[:3, :3]), (moved, spread[3:, 3:])):
            squares.append(error @ np.linalg.solve(part, error))
        np.testing.assert_allclose(found.position_std**2, np.diag(spread)[3:], rtol=1e-6)
        np.testing.assert_allclose(found.orientation_std**2, np.diag(spread)[:3], rtol=1e-6)
    # The map has eight photos; three queries cannot show that it is 95 %.
    assert np.mean(np.array(squares) <= CHI2_95_OF_3) >= 0.8
    assert max(squares) < 3 * CHI2_95_OF_3
    # The room is 5 m wide, and mapping photos look every way.
    assert np.median([error for error, _ in errors]) < 1.0
    assert np.median([error for _, error in errors]) < 30.0


def test_it_is_told_only_where_it_is_asked_for_and_no_pose_is_found(
    localizer: Localizer, query: Query
) -> None:
    photo = read_photo(query.image)
    refused = localizer.localize(photo, query.camera, replace(REFUSED, fallback=Fallback.NONE))
    assert isinstance(refused, NotLocalized)
    assert refused.coarse is None
    assert refused.status == "not_localized"
    approximated = localizer.localize(photo, query.camera, REFUSED)
    assert approximated.status == "coarse"  # as over HTTP and gRPC
    accepted = localizer.localize(photo, query.camera, LocalizeOptions(fallback=Fallback.COARSE))
    assert isinstance(accepted, Localized)


def test_it_changes_no_pose(localizer: Localizer, query: Query) -> None:
    photo = read_photo(query.image)
    a, b = (
        localizer.localize(photo, query.camera, LocalizeOptions(fallback=fallback))
        for fallback in Fallback
    )
    assert isinstance(a, Localized)
    assert isinstance(b, Localized)
    np.testing.assert_array_equal(a.cam_from_world.rotation, b.cam_from_world.rotation)
    np.testing.assert_array_equal(a.covariance, b.covariance)


def test_a_photo_without_keypoints_has_none(localizer: Localizer) -> None:
    blank = png(np.full((480, 640, 3), 90, np.uint8))
    answer = localizer.localize(read_photo(blank), None, REFUSED)
    assert isinstance(answer, NotLocalized)
    assert answer.coarse is None


def test_a_pose_that_contradicts_a_prior_is_not_told(localizer: Localizer, query: Query) -> None:
    centers = localizer.geometry.centers + localizer.geometry.origin
    truth = query.cam_from_world.center
    far = centers[np.argmax(np.linalg.norm(centers - truth, axis=1))]

    assert coarse(localizer, query, Priors(position=PositionPrior(truth, 0.5))) is not None
    # The photos there look like the query, and it is not there.
    assert coarse(localizer, query, Priors(position=PositionPrior(far, 0.01))) is None
    # No photo was taken there.
    assert coarse(localizer, query, Priors(position=PositionPrior(far + 1000.0, 1.0))) is None


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_a_photo_that_is_stored_turned_has_the_pose_of_its_stored_pixels(
    localizer: Localizer, query: Query, orientation: int
) -> None:
    upright = coarse(localizer, query)
    stored = turned_pixels(read_photo(query.image).rgb, orientation)
    turned = localizer.localize(
        read_photo(png(stored, orientation)), turned_camera(query.camera, orientation), REFUSED
    )

    assert isinstance(turned, NotLocalized)
    assert turned.coarse is not None
    assert upright is not None
    expected = turned_pose(upright.cam_from_world, orientation)
    metres, degrees = pose_error(turned.coarse.cam_from_world, expected)
    assert metres < 0.3
    assert degrees < 10.0


def test_the_learned_ellipsoid_holds_the_share_that_it_states() -> None:
    random = np.random.default_rng(0)

    def draw(num: int) -> tuple[np.ndarray, np.ndarray]:
        roots = random.normal(size=(num, 3, 3)) * random.uniform(0.1, 10, (num, 1, 1))
        scatters = roots @ roots.transpose(0, 2, 1)
        # Three times as far off as the scatter says, and by 0.5 whatever it says.
        errors = 3.0 * np.einsum("nij,nj->ni", roots, random.normal(size=(num, 3)))
        return errors + 0.5 * random.normal(size=(num, 3)), scatters

    widening = _Widening.learned(*draw(200))

    errors, scatters = draw(5000)
    stated = np.stack([widening.covariance(scatter) for scatter in scatters])
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(stated), errors)
    assert np.mean(squares <= CHI2_95_OF_3) == pytest.approx(0.95, abs=0.03)
