from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.turning import png, turned_camera, turned_pixels, turned_pose
from visloc.archive import MapStore
from visloc.errors import Conflict, InvalidInput, TooLarge
from visloc.evaluation import pose_error
from visloc.features import (
    LocalFeatureExtractor,
    make_global_descriptor,
    make_local_features,
)
from visloc.features.local.sift import SiftExtractor
from visloc.geometry import Camera, Pose
from visloc.localization.localizer import Localizer
from visloc.localization.query.camera import resolve_camera
from visloc.localization.query.features import max_sent_keypoints
from visloc.options import LocalizeOptions, ReadAs
from visloc.photos.reading import Photo, read_photo
from visloc.types import (
    Answer,
    CameraSource,
    Fingerprint,
    LocalFeatures,
    Localized,
    NotLocalized,
    QueryFeatures,
    Reason,
)

OPTIONS = LocalizeOptions()
STORED = LocalizeOptions(read_as=ReadAs.STORED)


class Query(Protocol):
    path: Path
    image: bytes
    camera: Camera
    cam_from_world: Pose


@pytest.fixture(scope="module")
def extractor() -> LocalFeatureExtractor:
    return make_local_features("sift")


@pytest.fixture(scope="module")
def localizer(built_maps: Path, extractor: LocalFeatureExtractor) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), extractor)


def localized(answer: Answer) -> Localized:
    assert isinstance(answer, Localized), answer
    return answer


def same_bits(a: Localized, b: Localized) -> bool:
    return all(
        np.array_equal(x, y)
        for x, y in (
            (a.cam_from_world.rotation, b.cam_from_world.rotation),
            (a.cam_from_world.translation, b.cam_from_world.translation),
            (a.covariance, b.covariance),
            (a.position_std, b.position_std),
            (a.inlier_keypoints, b.inlier_keypoints),
            (a.inlier_points, b.inlier_points),
        )
    )


def test_every_query_is_localized_within_a_few_millimetres(
    localizer: Localizer, queries: list[Query]
) -> None:
    # 256 x 192 pixels, 8 mapping photos: measured 0.7 to 0.9 mm and 0.02 to 0.03 degrees.
    for query in queries:
        answer = localized(localizer.localize(read_photo(query.image), query.camera, OPTIONS))
        position_m, orientation_deg = pose_error(answer.cam_from_world, query.cam_from_world)
        assert position_m < 0.003
        assert orientation_deg < 0.1
        assert answer.evidence.camera == query.camera
        assert answer.evidence.camera_source is CameraSource.GIVEN
        assert answer.evidence.num_inliers == len(answer.inlier_keypoints) > 300
        assert answer.evidence.inlier_ratio > 0.5


def test_the_evidence_tells_how_the_answer_came_about(localizer: Localizer, query: Query) -> None:
    answer = localized(
        localizer.localize(read_photo(query.image), query.camera, LocalizeOptions(top_k=5))
    )
    evidence = answer.evidence
    assert list(evidence.seconds) == [
        *("local_features", "global_features", "retrieval", "matching", "pose")
    ]
    assert all(seconds > 0 for seconds in evidence.seconds.values())
    assert len(evidence.retrieved) == 5
    scores = [retrieved.score for retrieved in evidence.retrieved]
    assert scores == sorted(scores, reverse=True)
    assert all(set(r.similarities) == {"densevlad", "localvlad"} for r in evidence.retrieved)
    assert {r.name for r in evidence.retrieved} <= {image.name for image in localizer.map.images}
    assert evidence.num_keypoints >= evidence.num_correspondences >= evidence.num_inliers


def test_the_uncertainty_is_a_covariance_and_fits_the_errors(
    localizer: Localizer, queries: list[Query]
) -> None:
    for query in queries:
        answer = localized(localizer.localize(read_photo(query.image), query.camera, OPTIONS))
        assert np.array_equal(answer.covariance, answer.covariance.T)
        assert np.linalg.eigvalsh(answer.covariance).min() > 0
        assert answer.orientation_std == pytest.approx(np.sqrt(np.diag(answer.covariance)[:3]))
        # R <- Exp(w) R, so w is the rotation vector of estimated @ true^-1.
        error = answer.cam_from_world @ query.cam_from_world.inverse()
        rotation_vector = cv2.Rodrigues(error.rotation)[0].ravel()
        shift = answer.cam_from_world.center - query.cam_from_world.center
        assert (np.abs(rotation_vector) < 5 * answer.orientation_std).all()
        assert (np.abs(shift) < 5 * answer.position_std).all()


def test_inliers_are_seen_where_the_pose_says(localizer: Localizer, query: Query) -> None:
    answer = localized(localizer.localize(read_photo(query.image), query.camera, OPTIONS))
    fx, fy, cx, cy = query.camera.params
    x, y, z = answer.cam_from_world.apply(answer.inlier_points).T
    seen = np.column_stack([fx * x / z + cx, fy * y / z + cy])
    errors = np.linalg.norm(seen - answer.inlier_keypoints, axis=1)
    # The preset's 12 px are for photos of 640 px; this one has 256.
    assert 4.0 < errors.max() < 4.8 + 1e-3
    assert np.median(errors) < 0.5


def test_a_threshold_that_the_caller_names_is_taken_as_it_is(
    localizer: Localizer, query: Query
) -> None:
    photo = read_photo(query.image)
    by_preset, wider, same = (
        localized(localizer.localize(photo, query.camera, LocalizeOptions(max_error_px=error)))
        for error in (None, 12.0, 4.8)
    )
    assert wider.evidence.num_inliers > by_preset.evidence.num_inliers
    assert same_bits(same, by_preset)


def test_equal_seeds_give_equal_bits_and_others_nearly_the_same_pose(
    localizer: Localizer, query: Query
) -> None:
    photo = read_photo(query.image)
    first, again, other = (
        localized(localizer.localize(photo, query.camera, LocalizeOptions(seed=seed)))
        for seed in (7, 7, 8)
    )
    assert same_bits(first, again)
    assert pose_error(other.cam_from_world, first.cam_from_world) < (0.001, 0.05)


def test_a_camera_given_for_twice_the_size_gives_the_same_pose(
    localizer: Localizer, query: Query
) -> None:
    photo = read_photo(query.image)
    exact = localized(localizer.localize(photo, query.camera, OPTIONS))
    doubled = query.camera.scaled(2 * query.camera.width, 2 * query.camera.height)
    scaled = localized(localizer.localize(photo, doubled, OPTIONS))
    assert scaled.evidence.camera_source is CameraSource.GIVEN_SCALED
    assert scaled.evidence.camera == query.camera
    assert same_bits(scaled, exact)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_stored_turned_has_the_pose_of_the_turned_camera(
    localizer: Localizer, query: Query, orientation: int
) -> None:
    straight = localized(localizer.localize(read_photo(query.image), query.camera, OPTIONS))
    pixels = turned_pixels(read_photo(query.image).rgb, orientation)
    camera = turned_camera(query.camera, orientation)
    photo = read_photo(png(pixels, orientation))
    assert photo.exif_orientation == orientation

    # Features are those of the photo that was not turned, and so is all that follows.
    answer = localized(localizer.localize(photo, camera, OPTIONS))
    assert answer.evidence.read_as is ReadAs.UPRIGHT
    assert answer.evidence.camera == camera
    assert answer.evidence.num_inliers == straight.evidence.num_inliers
    expected = turned_pose(straight.cam_from_world, orientation)
    assert pose_error(answer.cam_from_world, expected) < (1e-5, 1e-3)
    assert answer.position_std == pytest.approx(straight.position_std, rel=1e-2)
    # Keypoints and pose are those of the stored pixels.
    fx, fy, cx, cy = camera.params
    x, y, z = answer.cam_from_world.apply(answer.inlier_points).T
    seen = np.column_stack([fx * x / z + cx, fy * y / z + cy])
    assert np.median(np.linalg.norm(seen - answer.inlier_keypoints, axis=1)) < 0.5

    # Read as stored, SIFT, which is rotation-invariant, gives nearly that.
    as_stored = localized(localizer.localize(photo, camera, STORED))
    assert as_stored.evidence.read_as is ReadAs.STORED
    truth = turned_pose(query.cam_from_world, orientation)
    assert pose_error(as_stored.cam_from_world, truth) < (0.005, 0.15)


def test_a_refusal_of_a_photo_that_was_read_on_its_side_says_so(
    localizer: Localizer, query: Query
) -> None:
    photo = read_photo(png(turned_pixels(read_photo(query.image).rgb, 6), 6))
    camera = turned_camera(query.camera, 6)
    for limits in ({"min_inliers": 5000}, {"min_inliers": 700}, {"min_inlier_ratio": 0.99}):
        options = LocalizeOptions(**limits)  # type: ignore[arg-type]
        as_stored = replace(options, read_as=ReadAs.STORED)
        message = refused(localizer.localize(photo, camera, as_stored)).message
        assert "stored rotated (EXIF orientation 6)" in message
        assert "read_as=upright" in message
        assert "read_as" not in refused(localizer.localize(photo, camera, options)).message
        straight = read_photo(query.image)
        assert (
            "read_as" not in refused(localizer.localize(straight, query.camera, as_stored)).message
        )


@pytest.mark.parametrize(
    "variant",
    [
        lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY),
        lambda rgb: np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)]),
        lambda rgb: np.dstack([rgb, np.full(rgb.shape[:2], 10, np.uint8)]),
        lambda rgb: rgb.astype(np.uint16) * 257,
    ],
    ids=["grey", "RGBA", "RGBA, nearly transparent", "16-bit"],
)
def test_other_kinds_of_photos_are_localized_nearly_the_same(
    localizer: Localizer, query: Query, variant: Callable[[NDArray[np.uint8]], NDArray[np.integer]]
) -> None:
    photo = read_photo(query.image)
    expected = localized(localizer.localize(photo, query.camera, OPTIONS))
    other = read_photo(png(variant(photo.rgb)))
    found = localized(localizer.localize(other, query.camera, OPTIONS))
    assert pose_error(found.cam_from_world, expected.cam_from_world) < (0.001, 0.05)


def refused(answer: Answer) -> NotLocalized:
    assert isinstance(answer, NotLocalized), answer
    assert answer.message
    assert answer.evidence.seconds
    return answer


def noise(height: int, width: int) -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def checkerboard(height: int, width: int) -> NDArray[np.uint8]:
    rows, columns = np.indices((height, width)) // 16
    return np.repeat(((rows + columns) % 2 * 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize(
    ("rgb", "stage", "reason"),
    [
        (np.full((192, 256, 3), 128, np.uint8), "features", Reason.NO_KEYPOINTS),
        (np.zeros((1, 1, 3), np.uint8), "features", Reason.NO_KEYPOINTS),
        (noise(16, 16), "features", Reason.NO_KEYPOINTS),
        (noise(192, 256), "gate", Reason.TOO_FEW_INLIERS),
        (checkerboard(192, 256), "matching", Reason.TOO_FEW_MATCHES),
    ],
    ids=["blank", "one pixel", "tiny", "noise", "checkerboard"],
)
def test_a_photo_that_shows_no_place_is_refused_with_stage_and_reason(
    localizer: Localizer, rgb: NDArray[np.uint8], stage: str, reason: Reason
) -> None:
    answer = refused(localizer.localize(Photo(rgb), None, OPTIONS))
    assert (answer.stage, answer.reason) == (stage, reason)
    of_its_size = rgb.shape[:2] == (192, 256)  # as the map's photos, which tell no more either
    assert answer.evidence.camera_source is (
        CameraSource.MAP if of_its_size else CameraSource.GUESS
    )


def test_a_tiny_copy_of_a_query_is_refused(localizer: Localizer, query: Query) -> None:
    tiny = cv2.resize(read_photo(query.image).rgb, (16, 12), interpolation=cv2.INTER_AREA)
    answer = refused(localizer.localize(Photo(tiny.astype(np.uint8)), query.camera, OPTIONS))
    assert answer.stage in ("features", "matching")
    assert answer.reason in (Reason.NO_KEYPOINTS, Reason.TOO_FEW_MATCHES)


def test_photos_of_another_place_are_refused_with_stage_and_reason(
    localizer: Localizer, query: Query, photos_of_another_room: list[Path]
) -> None:
    for path in photos_of_another_room:
        photo = read_photo(path.read_bytes())
        answer = refused(localizer.localize(photo, query.camera, OPTIONS))
        assert (answer.stage, answer.reason) == ("gate", Reason.TOO_FEW_INLIERS)
        # Right poses of this map have more than 300 inliers, the gate asks for 30.
        assert answer.evidence.num_inliers < 15
        config1 = LocalizeOptions(preset="config1")
        assert refused(localizer.localize(photo, query.camera, config1)).stage == "gate"


def test_the_gate_says_which_threshold_was_missed(localizer: Localizer, query: Query) -> None:
    photo = read_photo(query.image)
    many = refused(localizer.localize(photo, query.camera, LocalizeOptions(min_inliers=700)))
    assert (many.stage, many.reason) == ("gate", Reason.TOO_FEW_INLIERS)
    assert "700" in many.message
    ratio = refused(localizer.localize(photo, query.camera, LocalizeOptions(min_inlier_ratio=0.99)))
    assert (ratio.stage, ratio.reason) == ("gate", Reason.LOW_INLIER_RATIO)
    assert "99.0%" in ratio.message
    matches = refused(localizer.localize(photo, query.camera, LocalizeOptions(min_inliers=5000)))
    assert (matches.stage, matches.reason) == ("matching", Reason.TOO_FEW_MATCHES)


class Other:
    """An extractor that says of itself that it is another."""

    descriptor_dim = 128

    def __init__(self, fingerprint: Fingerprint) -> None:
        self.fingerprint = fingerprint

    def extract(self, rgb: NDArray[np.uint8], *, max_keypoints: int) -> LocalFeatures:
        raise AssertionError(rgb.shape, max_keypoints)


@pytest.mark.parametrize(
    ("change", "field", "expected", "got"),
    [
        (
            {"weights_sha256": "ab" * 32},
            "weights_dir",
            "weights_sha256 None",
            f"weights_sha256 {'ab' * 32}",
        ),
        ({"revision": 99}, "map", "revision 1", "revision 99"),
        ({"name": "xfeat"}, "map", "name sift", "name xfeat"),
        (
            {"parameters": {**SiftExtractor.fingerprint.parameters, "sigma": 1.7, "new": 1}},
            "map",
            "sigma 1.6, new None",
            "sigma 1.7, new 1",
        ),
    ],
)
def test_a_map_of_other_features_is_refused_with_the_difference(
    localizer: Localizer,
    extractor: LocalFeatureExtractor,
    change: dict[str, object],
    field: str,
    expected: str,
    got: str,
) -> None:
    other = replace(extractor.fingerprint, **change)  # type: ignore[arg-type]
    with pytest.raises(Conflict) as caught:
        Localizer(localizer.map, Other(other))
    assert (caught.value.code, caught.value.field) == ("map.features", field)
    assert (caught.value.expected, caught.value.got) == (expected, got)
    assert localizer.map.ref in str(caught.value)


def test_a_camera_of_another_size_is_refused(localizer: Localizer, query: Query) -> None:
    camera = Camera("PINHOLE", 640, 360, (500.0, 500.0, 320.0, 180.0))
    with pytest.raises(InvalidInput, match=r"expected 256 x 192 .* got 640 x 360") as caught:
        localizer.localize(read_photo(query.image), camera, OPTIONS)
    assert (caught.value.code, caught.value.field) == ("camera.size_mismatch", "camera")
    assert "EXIF" not in str(caught.value)


def test_the_upright_camera_of_a_photo_stored_turned_is_refused_with_the_hint(
    localizer: Localizer, query: Query
) -> None:
    photo = read_photo(png(turned_pixels(read_photo(query.image).rgb, 6), 6))
    with pytest.raises(InvalidInput, match=r"EXIF orientation 6.*stored pixels") as caught:
        localizer.localize(photo, query.camera, OPTIONS)
    assert caught.value.code == "camera.size_mismatch"


def test_without_a_camera_exif_is_used_and_else_a_stated_guess() -> None:
    rgb = np.zeros((192, 256, 3), np.uint8)
    camera, source = resolve_camera(Photo(rgb, 1, 300.0), None)
    assert (camera.params, source) == ((300.0, 128.0, 96.0), CameraSource.EXIF)
    camera, source = resolve_camera(Photo(rgb), None)
    assert (camera.params, source) == ((1.2 * 256, 128.0, 96.0), CameraSource.GUESS)
    given = Camera("PINHOLE", 256, 192, (250.0, 251.0, 128.0, 96.0))
    assert resolve_camera(Photo(rgb, 1, 300.0), given) == (given, CameraSource.GIVEN)


def test_photo_without_a_camera_is_answered_with_that_of_the_map(
    localizer: Localizer, query: Query
) -> None:
    answer = localized(localizer.localize(read_photo(query.image), None, OPTIONS))
    assert answer.evidence.camera_source is CameraSource.MAP
    assert pose_error(answer.cam_from_world, query.cam_from_world)[0] < 0.02


def test_photo_that_the_cameras_of_the_map_did_not_take_is_answered_without_them(
    localizer: Localizer, query: Query
) -> None:
    rgb = read_photo(query.image).rgb
    height, width = rgb.shape[:2]
    middle = rgb[height // 5 : -height // 5, width // 5 : -width // 5]
    zoomed = Photo(cv2.resize(middle, (width, height), interpolation=cv2.INTER_CUBIC))
    answer = localized(localizer.localize(zoomed, None, OPTIONS))
    assert answer.evidence.camera_source is CameraSource.ESTIMATED
    assert answer.evidence.camera.focal_length == pytest.approx(
        query.camera.focal_length / 0.6, rel=0.02
    )


@pytest.mark.parametrize("zoom", [0.98, 1.02])
def test_given_focal_length_that_is_off_is_corrected(
    localizer: Localizer, query: Query, zoom: float
) -> None:
    fx, fy, cx, cy = query.camera.params
    sent = replace(query.camera, params=(zoom * fx, zoom * fy, cx, cy))
    answer = localized(localizer.localize(read_photo(query.image), sent, OPTIONS))
    assert answer.evidence.camera_source is CameraSource.GIVEN
    assert answer.evidence.camera.focal_length == pytest.approx(fx, rel=0.005)
    assert pose_error(answer.cam_from_world, query.cam_from_world)[0] < 0.02


# Features instead of a photo


@pytest.fixture(scope="module")
def ready_made(localizer: Localizer) -> Localizer:
    """The same map, as if its SIFT and DenseVLAD had come from elsewhere."""
    opened = localizer.map
    manifest = opened.manifest
    local = manifest.local_features
    densevlad, localvlad = manifest.global_features
    renamed = {
        "local_features": local.model_copy(
            update={"fingerprint": local.fingerprint.model_copy(update={"name": "kapture:SIFT"})}
        ),
        "global_features": (
            densevlad.model_copy(
                update={
                    "fingerprint": densevlad.fingerprint.model_copy(update={"name": "kapture:DV"})
                }
            ),
            localvlad,
        ),
    }
    vectors, models = opened.global_descriptors, opened.global_models
    return Localizer(
        replace(
            opened,
            manifest=manifest.model_copy(update=renamed),
            global_descriptors={
                "kapture:DV": vectors["densevlad"],
                "localvlad": vectors["localvlad"],
            },
            global_models={"kapture:DV": {}, "localvlad": models["localvlad"]},
        ),
        None,
    )


@pytest.fixture(scope="module")
def features(query: Query, localizer: Localizer) -> QueryFeatures:
    """What a robot with our extractors sends."""
    rgb = read_photo(query.image).rgb
    local = make_local_features("sift").extract(rgb, max_keypoints=5000)
    densevlad = make_global_descriptor("densevlad")
    vector = densevlad.describe(rgb, local, localizer.map.global_models["densevlad"])
    return QueryFeatures("sift", local.keypoints, local.descriptors, {"densevlad": vector})


def as_ready_made(features: QueryFeatures) -> QueryFeatures:
    return replace(
        features,
        kind="kapture:SIFT",
        global_descriptors={"kapture:DV": features.global_descriptors["densevlad"]},
    )


def test_features_are_localized_as_the_photo_that_they_are_of(
    localizer: Localizer, ready_made: Localizer, query: Query, features: QueryFeatures
) -> None:
    expected = localized(localizer.localize(read_photo(query.image), query.camera, OPTIONS))

    found = localized(localizer.localize_features(features, query.camera, OPTIONS))
    renamed = localized(
        ready_made.localize_features(as_ready_made(features), query.camera, OPTIONS)
    )

    assert same_bits(found, renamed)
    # Normalized once more, descriptors differ in their last bits.
    assert pose_error(found.cam_from_world, expected.cam_from_world) < (1e-5, 1e-3)
    evidence = found.evidence
    assert evidence.num_keypoints == expected.evidence.num_keypoints
    assert [r.name for r in evidence.retrieved] == [r.name for r in expected.evidence.retrieved]
    assert list(evidence.retrieved[0].similarities) == ["densevlad", "localvlad"]
    assert list(evidence.seconds) == list(expected.evidence.seconds)
    assert (evidence.camera, evidence.camera_source) == (query.camera, CameraSource.GIVEN)
    assert (evidence.exif_orientation, evidence.read_as) == (1, ReadAs.STORED)


def test_a_descriptor_made_of_local_features_may_be_sent_or_left_out(
    localizer: Localizer, query: Query, features: QueryFeatures
) -> None:
    opened = localizer.map
    local = LocalFeatures(
        features.keypoints, features.descriptors, *2 * (np.ones(len(features.keypoints)),)
    )
    vector = make_global_descriptor("localvlad").describe(
        np.empty((0, 0, 3), np.uint8), local, opened.global_models["localvlad"]
    )
    sent = replace(
        features, global_descriptors={**features.global_descriptors, "localvlad": vector}
    )

    left_out = localized(localizer.localize_features(features, query.camera, OPTIONS))
    given = localized(localizer.localize_features(sent, query.camera, OPTIONS))

    assert pose_error(given.cam_from_world, left_out.cam_from_world) < (1e-5, 1e-3)


@pytest.mark.parametrize("dtype", [np.float16, np.uint8, np.int8])
def test_descriptors_of_few_bits_and_any_length_are_localized(
    dtype: type[np.generic], localizer: Localizer, query: Query, features: QueryFeatures
) -> None:
    largest = features.descriptors.max()  # SIFT's are not negative
    small = (features.descriptors * (120.0 / largest)).astype(dtype)
    answer = localizer.localize_features(
        replace(features, descriptors=small), query.camera, OPTIONS
    )
    position_m, orientation_deg = pose_error(localized(answer).cam_from_world, query.cam_from_world)
    assert position_m < 0.004
    assert orientation_deg < 0.1


def test_a_photo_without_keypoints_is_an_answer(
    localizer: Localizer, query: Query, features: QueryFeatures
) -> None:
    blank = QueryFeatures(
        "sift",
        features.keypoints[:0],
        features.descriptors[:0],
        {"densevlad": np.zeros_like(features.global_descriptors["densevlad"])},
    )
    answer = refused(localizer.localize_features(blank, query.camera, OPTIONS))
    assert (answer.stage, answer.reason) == ("features", Reason.NO_KEYPOINTS)


def test_features_of_another_place_are_refused(
    localizer: Localizer, query: Query, features: QueryFeatures
) -> None:
    shuffled = np.random.default_rng(0).permutation(features.keypoints)
    answer = localizer.localize_features(
        replace(features, keypoints=shuffled), query.camera, OPTIONS
    )
    assert refused(answer).reason is Reason.TOO_FEW_INLIERS


def test_a_photo_is_refused_by_a_map_of_ready_made_features(
    ready_made: Localizer, query: Query
) -> None:
    with pytest.raises(InvalidInput) as caught:
        ready_made.localize(read_photo(query.image), query.camera, OPTIONS)
    assert (caught.value.code, caught.value.field) == ("features.required", "image")
    assert caught.value.expected == "features of kind kapture:SIFT, with kapture:DV, localvlad"


def test_both_kinds_of_maps_warm_up(localizer: Localizer, ready_made: Localizer) -> None:
    localizer.warm_up()
    ready_made.warm_up()


def changed(rows: NDArray[np.float32], row: int, value: float) -> NDArray[np.float32]:
    rows = rows.copy()
    rows[row] = value
    return rows


@pytest.mark.parametrize(
    ("change", "code", "field", "expected"),
    [
        (lambda _: {"kind": "xfeat"}, "features.kind", "features.kind", "sift"),
        (
            lambda f: {"keypoints": f.keypoints[:, :1]},
            *("features.keypoints", "features.keypoints", "(N, 2): x, y"),
        ),
        (
            lambda f: {"keypoints": changed(f.keypoints, 7, np.nan)},
            *("features.keypoints", "features.keypoints", "0 to 256, 0 to 192"),
        ),
        (
            lambda f: {"keypoints": changed(f.keypoints, 7, 194.0)},
            *("features.keypoints", "features.keypoints", "0 to 256, 0 to 192"),
        ),
        (
            lambda f: {"keypoints": changed(f.keypoints, 7, -1.1)},
            *("features.keypoints", "features.keypoints", "0 to 256, 0 to 192"),
        ),
        (
            lambda f: {"descriptors": f.descriptors[:, :64]},
            *("features.descriptors", "features.descriptors", None),
        ),
        (
            lambda f: {"descriptors": f.descriptors[1:]},
            *("features.descriptors", "features.descriptors", None),
        ),
        (
            lambda f: {"descriptors": changed(f.descriptors, 3, np.inf)},
            *("features.descriptors", "features.descriptors", "finite numbers"),
        ),
        (
            lambda f: {"descriptors": f.descriptors.astype(np.float64) * 1e300},
            *("features.descriptors", "features.descriptors", "finite numbers"),
        ),
        (
            lambda f: {"descriptors": changed(f.descriptors, 3, 0.0)},
            *("features.descriptors", "features.descriptors", "not all zero"),
        ),
        (
            lambda _: {"global_descriptors": {}},
            *("features.global_descriptors", "features.global_descriptors"),
            "densevlad (must be sent), localvlad (may be sent)",
        ),
        (
            lambda f: {"global_descriptors": {**f.global_descriptors, "netvlad": np.ones(9)}},
            *("features.global_descriptors", "features.global_descriptors"),
            "densevlad (must be sent), localvlad (may be sent)",
        ),
        (
            lambda _: {"global_descriptors": {"densevlad": np.ones(3)}},
            *("features.global_descriptors", "features.global_descriptors.densevlad", None),
        ),
        (
            lambda f: {
                "global_descriptors": {
                    "densevlad": changed(f.global_descriptors["densevlad"], 1, np.nan)
                }
            },
            *("features.global_descriptors", "features.global_descriptors.densevlad"),
            "finite numbers",
        ),
    ],
)
def test_features_that_do_not_fit_the_map_or_the_camera_are_refused(
    change: Callable[[QueryFeatures], dict[str, object]],
    code: str,
    field: str,
    expected: str | None,
    localizer: Localizer,
    query: Query,
    features: QueryFeatures,
) -> None:
    bad = replace(features, **change(features))  # type: ignore[arg-type]
    with pytest.raises(InvalidInput) as caught:
        localizer.localize_features(bad, query.camera, OPTIONS)
    assert (caught.value.code, caught.value.field) == (code, field)
    assert expected is None or caught.value.expected == expected


def test_keypoints_a_hair_beyond_the_edge_are_taken(
    localizer: Localizer, query: Query, features: QueryFeatures
) -> None:
    edge = features.keypoints.copy()
    edge[:2] = [[-0.5, -1.0], [257.0, 192.5]]
    localized(localizer.localize_features(replace(features, keypoints=edge), query.camera, OPTIONS))


def test_more_keypoints_than_the_limit_are_refused(
    localizer: Localizer, query: Query, features: QueryFeatures
) -> None:
    most = localizer.map.manifest.local_features.max_keypoints
    assert max_sent_keypoints(localizer.map.manifest) == most
    many = replace(features, keypoints=np.zeros((most + 1, 2), np.uint8))
    with pytest.raises(TooLarge) as caught:
        localizer.localize_features(many, query.camera, OPTIONS)
    error = caught.value
    assert (error.code, error.expected, error.got) == (
        "features.too_many",
        f"at most {most}",
        str(most + 1),
    )


def test_a_map_of_ready_made_features_has_a_limit_of_its_own(ready_made: Localizer) -> None:
    assert max_sent_keypoints(ready_made.map.manifest) == 20_000


def test_a_map_with_few_keypoints_and_a_ready_made_global_descriptor_warms_up(
    ready_made: Localizer, localizer: Localizer
) -> None:
    opened = ready_made.map
    few = localizer.map.manifest.local_features.model_copy(update={"max_keypoints": 100})
    manifest = opened.manifest.model_copy(update={"local_features": few})
    Localizer(replace(opened, manifest=manifest), make_local_features("sift")).warm_up()


def test_features_need_a_camera_and_have_no_orientation_to_be_read_in(
    localizer: Localizer, query: Query, features: QueryFeatures
) -> None:
    with pytest.raises(InvalidInput) as caught:
        localizer.localize_features(features, None, OPTIONS)
    assert (caught.value.code, caught.value.field) == ("camera.required", "camera")
    as_stored = localized(localizer.localize_features(features, query.camera, STORED))
    answer = localized(localizer.localize_features(features, query.camera, OPTIONS))
    assert same_bits(answer, as_stored)
    assert (answer.evidence.exif_orientation, answer.evidence.read_as) == (1, ReadAs.STORED)
