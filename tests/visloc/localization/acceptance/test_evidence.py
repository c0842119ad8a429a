from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import MapStore
from visloc.features import make_local_features
from visloc.geometry import Camera, Pose
from visloc.localization.acceptance.evidence import (
    FEATURES,
    SeenView,
    Shown,
    compared_landmarks,
    evidence_of,
)
from visloc.localization.acceptance.gates import Problem, likely
from visloc.localization.acceptance.probability import read_model, shipped_model
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import Constraints
from visloc.matching.products import EightBitRows
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo, read_photo
from visloc.pose.generalized import GeneralizedPose
from visloc.pose.reprojection import MatchedView, project
from visloc.priors import NO_PRIORS
from visloc.types import CameraSource, Localized, NotLocalized, Reason, Refusal

OPTIONS = LocalizeOptions()


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


@pytest.fixture(scope="module")
def localizer(built_maps: Path) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


def seen_from(localizer: Localizer, photo: int, shown_share: float = 1.0) -> tuple[SeenView, Pose]:
    """What a camera sees that stands where a mapping photo was taken, exactly.

    The descriptors of the others of its keypoints are those of other landmarks.
    """
    opened, geometry = localizer.map, localizer.geometry
    camera = opened.cameras[opened.images[photo].camera]
    pose = geometry.viewpoints.pose(photo)
    landmarks, descriptors = opened.observations(photo)
    points = opened.landmarks[landmarks].astype(np.float64)
    pixels = project(camera, pose.apply(points))
    num = round(shown_share * len(points))
    order = np.argsort(pixels[:, 0], kind="stable")
    rows = descriptors[order].copy()
    rows[num:] = np.roll(rows[num:], len(rows) // 7, axis=0)
    pixels, points = pixels[order], points[order]
    scale = opened.manifest.local_features.descriptor_scale
    shown = Shown(pixels.astype(np.float32), EightBitRows(rows, scale))
    inliers = np.arange(len(points)) < num
    return SeenView(MatchedView(camera, Pose.identity(), pixels, points), shown, inliers), pose


def features_of(
    localizer: Localizer, seen: list[SeenView], pose: Pose, std: float = 1e-3
) -> NDArray[np.float64]:
    return evidence_of(localizer.geometry, seen, pose, std**2 * np.eye(6), 12.0)


def value(features: NDArray[np.float64], name: str) -> float:
    return float(features[FEATURES.index(name)])


def test_what_the_map_has_is_found_in_a_photo_that_shows_all_of_it(localizer: Localizer) -> None:
    features = features_of(localizer, *_listed(seen_from(localizer, 3)))
    assert value(features, "shown") > 0.0  # log odds
    assert value(features, "weak_cells") > 0.5
    assert value(features, "contradicted") < 0.05
    assert value(features, "keypoints_outside") < 0.05
    assert value(features, "tight") > 0.99
    assert shipped_model().probability(features) > 0.95


def test_other_content_in_half_of_a_photo_lowers_the_probability(localizer: Localizer) -> None:
    probabilities = []
    for share in (1.0, 0.5, 0.2):
        features = features_of(localizer, *_listed(seen_from(localizer, 3, share)))
        probabilities.append(float(shipped_model().probability(features)))
    assert probabilities[0] > probabilities[1] > probabilities[2]
    half = features_of(localizer, *_listed(seen_from(localizer, 3, 0.5)))
    assert 0.35 < value(half, "keypoints_outside") < 0.65
    assert value(half, "contradicted") > 0.2


def test_pictures_show_where_a_photo_looks_like_something_else(localizer: Localizer) -> None:
    seen, pose = seen_from(localizer, 3, 0.5)
    pixels, alike = compared_landmarks(localizer.geometry, seen, pose, 12.0)
    # Keypoints are in the order of their columns: the left half looks like the map.
    left = pixels[:, 0] < np.median(seen.view.pixels[:, 0])
    assert alike[left].mean() > 0.6
    assert alike[~left].mean() < 0.3
    assert len(pixels) == len(alike) > 50


def test_all_cameras_of_a_rig_count(localizer: Localizer) -> None:
    good, pose = seen_from(localizer, 3)
    bad, _ = seen_from(localizer, 3, 0.1)
    alone = features_of(localizer, [good], pose)
    both = features_of(localizer, [good, bad], pose)
    assert shipped_model().log_odds(both) < shipped_model().log_odds(alone) - 0.5


def test_odd_input_gives_finite_numbers(localizer: Localizer) -> None:
    seen, pose = seen_from(localizer, 3)
    view, none = seen.view, np.zeros(len(seen.view), dtype=np.bool_)
    width = seen.shown.descriptors.rows.shape[1]
    no_keypoints = Shown(
        np.empty((0, 2), np.float32), EightBitRows(np.empty((0, width), np.int8), 1.0)
    )
    one = Shown(seen.shown.keypoints[:1], EightBitRows(seen.shown.descriptors.rows[:1], 1.0))
    spot = replace(seen.shown, keypoints=np.full_like(seen.shown.keypoints, 5.0))
    blank = replace(
        seen.shown, descriptors=EightBitRows(np.zeros_like(seen.shown.descriptors.rows), 1.0)
    )
    away = Pose(pose.rotation, pose.translation + 1e4)  # no landmark is expected there
    behind = Pose(np.diag([-1.0, 1.0, -1.0]) @ pose.rotation, pose.translation)
    nowhere = MatchedView(view.camera, Pose.identity(), np.empty((0, 2)), np.empty((0, 3)))
    tiny = replace(view, camera=Camera("SIMPLE_PINHOLE", 1, 1, (1.0, 0.5, 0.5)))
    cases = [
        (SeenView(view, no_keypoints, none), pose),
        (SeenView(view, one, none), pose),
        (SeenView(view, spot, none), pose),
        (SeenView(view, blank, none), pose),
        (SeenView(view, seen.shown, none), away),
        (SeenView(view, seen.shown, none), behind),
        (SeenView(nowhere, seen.shown, none[:0]), pose),
        (SeenView(tiny, seen.shown, none), pose),
    ]
    for odd, under in cases:
        for std in (0.0, 1e-3, 1e9):
            features = features_of(localizer, [odd], under, std)
            assert np.isfinite(features).all()
            assert 0.0 < shipped_model().probability(features) < 1.0


def test_bits_are_equal_in_every_thread(localizer: Localizer) -> None:
    seen = [seen_from(localizer, photo, 0.7) for photo in range(4)]
    alone = [features_of(localizer, [each], pose) for each, pose in seen]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda each: features_of(localizer, [each[0]], each[1]), seen * 4))
    for i, features in enumerate(together):
        assert np.array_equal(features, alone[i % 4])


def test_photos_of_the_place_are_probably_right(localizer: Localizer, queries: list[Query]) -> None:
    for query in queries:
        answer = localizer.localize(read_photo(query.image), query.camera, OPTIONS)
        assert isinstance(answer, Localized)
        assert answer.probability is not None
        assert answer.probability > 0.9


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_a_print_is_never_believed(
    localizer: Localizer, queries: list[Query], share: float
) -> None:
    """The photo hangs on a wall of dots; the camera that sees it is given."""
    for query in queries[:3]:
        rgb = read_photo(query.image).rgb
        wall = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        height, width = 3 * rgb.shape[0], 3 * rgb.shape[1]
        scene = cv2.resize(wall, (width, height), interpolation=cv2.INTER_NEAREST)
        size = round(share * width), round(share * height)
        scene[20 : 20 + size[1], 30 : 30 + size[0]] = cv2.resize(rgb, size)
        camera = Camera("SIMPLE_PINHOLE", width, height, (0.9 * width, width / 2, height / 2))
        answer = localizer.localize(Photo(np.ascontiguousarray(scene)), camera, OPTIONS)
        assert isinstance(answer, NotLocalized), answer.probability


def test_who_names_thresholds_gets_the_pose_and_its_probability(localizer: Localizer) -> None:
    """The photo shows a tenth of what the map has there; the pose is uncertain by a metre."""
    seen, pose = seen_from(localizer, 0, shown_share=0.1)
    found = GeneralizedPose(pose, (seen.inliers,), np.eye(6))

    def judged(options: LocalizeOptions) -> tuple[GeneralizedPose, Refusal | None]:
        constraints = Constraints(localizer.geometry, NO_PRIORS)
        sources = (CameraSource.GIVEN,)
        return likely(Problem((seen.view,), sources, options, constraints, (seen.shown,)), found)

    believed, none = judged(LocalizeOptions(min_inliers=12))
    refused, refusal = judged(OPTIONS)

    assert none is None
    assert believed.probability is not None
    assert believed.probability == refused.probability < 0.1
    assert refusal is not None
    assert refusal.reason is Reason.UNLIKELY_POSE


def test_a_raised_gate_refuses_a_right_pose_that_is_not_sure_enough(
    localizer: Localizer, queries: list[Query]
) -> None:
    query = queries[0]
    photo = read_photo(query.image)
    believed = localizer.localize(photo, query.camera, OPTIONS)
    assert isinstance(believed, Localized)
    assert believed.probability is not None

    least = replace(OPTIONS, min_probability=believed.probability)
    more = replace(OPTIONS, min_probability=np.nextafter(believed.probability, 1.0))

    assert isinstance(localizer.localize(photo, query.camera, least), Localized)
    refused = localizer.localize(photo, query.camera, more)
    assert isinstance(refused, NotLocalized)
    assert (refused.stage, refused.reason) == ("gate", Reason.UNLIKELY_POSE)
    assert "min_probability" in refused.message


def test_a_model_of_other_features_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "model.json"
    other.write_text('{"bias": 0.0, "mean_scale_weight": {"luck": [0.0, 1.0, 1.0]}}')
    with pytest.raises(ValueError, match="luck"):
        read_model(other)


def _listed(seen: tuple[SeenView, Pose]) -> tuple[list[SeenView], Pose]:
    return [seen[0]], seen[1]
