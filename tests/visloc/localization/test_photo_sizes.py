"""The same view with more and with fewer pixels than the mapping photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.features import make_global_descriptor, make_local_features
from visloc.geometry import Camera, Pose
from visloc.localization.localizer import Localizer
from visloc.localization.solving import SeenImage
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo, read_photo
from visloc.types import Answer, CameraSource, Localized, QueryFeatures

OPTIONS = LocalizeOptions()


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


TIMES = 3


@pytest.fixture(scope="module")
def localizer(built_maps: Path) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


def localized(answer: Answer) -> Localized:
    assert isinstance(answer, Localized), answer
    return answer


def enlarged(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat each pixel, so that averaging gives the photo back bit by bit."""
    return rgb.repeat(TIMES, 0).repeat(TIMES, 1)


@pytest.fixture
def large(query: Query) -> tuple[Photo, Camera]:
    photo = Photo(enlarged(read_photo(query.image).rgb))
    return photo, query.camera.scaled(photo.width, photo.height)


def test_a_photo_with_more_pixels_has_the_same_pose_and_covariance(
    localizer: Localizer, query: Query, large: tuple[Photo, Camera]
) -> None:
    photo = read_photo(query.image)
    small = localized(localizer.localize(photo, query.camera, OPTIONS))
    same = localized(localizer.localize(*large, OPTIONS))
    metres, _ = pose_error(same.cam_from_world, small.cam_from_world)
    assert metres < 1e-5
    assert np.allclose(same.covariance, small.covariance, rtol=1e-3, atol=1e-12)
    assert same.probability == pytest.approx(small.probability, abs=1e-3)
    assert same.evidence.num_inliers == small.evidence.num_inliers


def test_keypoints_and_camera_are_those_of_the_photo_as_sent(
    localizer: Localizer, query: Query, large: tuple[Photo, Camera]
) -> None:
    photo, camera = large
    answer = localized(localizer.localize(photo, camera, OPTIONS))
    assert answer.evidence.camera == camera
    projected = camera_pixels(camera, answer.cam_from_world, answer.inlier_points)
    off = np.linalg.norm(projected - answer.inlier_keypoints, axis=1)
    assert np.median(off) < 1.0 * TIMES
    assert answer.inlier_keypoints.max() > max(query.camera.width, query.camera.height)


def test_the_focal_length_is_estimated_in_pixels_of_the_photo_as_sent(
    localizer: Localizer, large: tuple[Photo, Camera]
) -> None:
    photo, camera = large
    answer = localized(localizer.localize(photo, None, OPTIONS))
    found = answer.evidence.camera
    assert answer.evidence.camera_source is CameraSource.ESTIMATED
    assert (found.width, found.height) == (camera.width, camera.height)
    assert found.focal_length == pytest.approx(camera.focal_length, rel=0.03)


def test_a_photo_with_a_quarter_of_the_pixels_is_localized(
    localizer: Localizer, query: Query
) -> None:
    rgb = read_photo(query.image).rgb
    half = cv2.resize(rgb, (rgb.shape[1] // 2, rgb.shape[0] // 2), interpolation=cv2.INTER_AREA)
    photo = Photo(np.asarray(half, np.uint8))
    camera = query.camera.scaled(photo.width, photo.height)
    answer = localized(localizer.localize(photo, camera, OPTIONS))
    assert pose_error(answer.cam_from_world, query.cam_from_world)[0] < 0.02
    assert answer.inlier_keypoints[:, 0].max() <= photo.width


def test_a_mask_counts_in_the_photo_as_sent(
    localizer: Localizer, large: tuple[Photo, Camera]
) -> None:
    photo, camera = large
    mask = np.ones((photo.height, photo.width), dtype=np.bool_)
    mask[:, : photo.width // 2] = False
    answer = localizer.localize(replace(photo, mask=mask), camera, OPTIONS)
    assert localized(answer).inlier_keypoints[:, 0].min() >= photo.width // 2


def test_features_of_a_large_photo_are_localized_as_those_of_the_small_one(
    localizer: Localizer, query: Query
) -> None:
    camera = query.camera.scaled(query.camera.width * TIMES, query.camera.height * TIMES)
    rgb, opened = read_photo(query.image).rgb, localizer.map
    local = make_local_features("sift").extract(rgb, max_keypoints=2500)
    described = make_global_descriptor("densevlad").describe(
        rgb, local, opened.global_models["densevlad"]
    )
    sent = [
        QueryFeatures("sift", local.keypoints * times, local.descriptors, {"densevlad": described})
        for times in (1, TIMES)
    ]
    one, other = (
        localized(localizer.localize_features(features, own, OPTIONS))
        for features, own in zip(sent, (query.camera, camera), strict=True)
    )
    assert pose_error(one.cam_from_world, other.cam_from_world)[0] < 1e-4
    assert np.allclose(one.covariance, other.covariance, rtol=1e-2, atol=1e-12)
    assert other.evidence.camera == camera


def test_cameras_of_a_rig_may_have_more_and_fewer_pixels(
    localizer: Localizer, query: Query, large: tuple[Photo, Camera]
) -> None:
    small = localizer.look(read_photo(query.image), query.camera, OPTIONS)
    images = [
        SeenImage("small", Pose.identity(), small),
        SeenImage("large", Pose.identity(), localizer.look(*large, OPTIONS)),
    ]
    answer = localizer.solve(images, OPTIONS).answer
    assert answer.pose is not None
    assert pose_error(answer.pose.rig_from_world, query.cam_from_world)[0] < 0.01
    first, second = (image.evidence for image in answer.images)
    assert first is not None
    assert second is not None
    assert first.num_inliers == pytest.approx(second.num_inliers, abs=2)
    assert (first.camera, second.camera) == (query.camera, large[1])


def camera_pixels(
    camera: Camera, cam_from_world: Pose, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    fx, fy, cx, cy = camera.params
    x, y, z = cam_from_world.apply(points).T
    return np.column_stack([fx * x / z + cx, fy * y / z + cy])
