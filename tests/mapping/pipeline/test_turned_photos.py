"""Maps of photos that are stored rotated (EXIF orientation)."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.stages.photos import read_in_frame
from tests.turning import (
    png,
    store_dataset_turned,
    turned_camera,
    turned_pixels,
    turned_points,
    turned_pose,
)
from visloc.archive import Map, MapStore
from visloc.errors import DatasetError
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.features.resolution import extract_features
from visloc.geometry import Camera, Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions, ReadAs
from visloc.photos.reading import read_photo, read_photo_file, turn_of
from visloc.types import Localized

SIZE = (256, 192)


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


def quiet(*_: object) -> None:
    pass


def build(dataset: Path, maps: Path, **settings: Any) -> Map:
    build_map(BuildSettings(dataset, "turned", maps, local_features="sift", **settings), quiet)
    return MapStore(maps).open("turned")


def apart(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """How far each point of either (N, 3) is from the nearest of the other."""
    return np.concatenate([cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]])


@pytest.fixture(scope="module")
def orientations(turned_sample: Path) -> Mapping[str, int]:
    """The orientation of each mapping photo by name."""
    dataset = read_dataset(turned_sample)
    return {
        record.path: read_photo_file(dataset.path_of(record)).exif_orientation
        for record in dataset.images
    }


@pytest.fixture(scope="module")
def turned_sample(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's mapping dataset as turned cameras would have stored it, each photo otherwise."""
    folder = tmp_path_factory.mktemp("turned sample")
    store_dataset_turned(sample / "mapping", folder)
    return folder


@pytest.fixture(scope="module")
def turned_map(turned_sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Map:
    """The map of that; only to be read."""
    return build(turned_sample, tmp_path_factory.mktemp("maps"), keep_colours=True)


@pytest.fixture(scope="module")
def straight_map(build_sample: Callable[..., Map]) -> Map:
    """The map of the sample as it is; only to be read."""
    return build_sample(keep_colours=True)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_features_of_a_turned_photo_are_those_of_the_other_in_stored_pixels(
    query: Query, orientation: int
) -> None:
    straight = read_photo(query.image)
    stored = read_photo(png(turned_pixels(straight.rgb, orientation), orientation))
    extractor = make_local_features("sift")
    expected, picture = extract_features(straight, extractor, max_keypoints=1000)
    found, seen = extract_features(stored, extractor, max_keypoints=1000)

    np.testing.assert_array_equal(seen, picture)
    np.testing.assert_allclose(
        found.keypoints, turned_points(expected.keypoints, SIZE, orientation), atol=1e-4
    )
    np.testing.assert_array_equal(found.descriptors, expected.descriptors)
    _, as_stored = extract_features(stored, extractor, max_keypoints=1000, read_as=ReadAs.STORED)
    np.testing.assert_array_equal(as_stored, stored.rgb)


def test_photos_in_all_orientations_give_the_map_of_those_that_are_upright(
    turned_map: Map, straight_map: Map, orientations: Mapping[str, int]
) -> None:
    assert sorted(orientations.values()) == list(range(1, 9))
    counts, expected = turned_map.manifest.counts, straight_map.manifest.counts
    assert counts.landmarks == pytest.approx(expected.landmarks, rel=2e-3)
    assert counts.observations == pytest.approx(expected.observations, rel=2e-3)
    # Equal, except where rounding decides which keypoints share a voxel.
    distances = apart(turned_map.landmarks, straight_map.landmarks)
    assert np.quantile(distances, 0.9) < 1e-4
    assert np.quantile(distances, 0.99) < 0.005
    row_of = {image.name: row for row, image in enumerate(straight_map.images)}
    for row, image in enumerate(turned_map.images):
        orientation, other = orientations[image.name], row_of[image.name]
        assert image.turn == turn_of(orientation)
        # In the stored pixels: camera, pose and keypoints.
        assert turned_map.cameras[image.camera] == turned_camera(
            straight_map.cameras[straight_map.images[other].camera], orientation
        )
        keypoints = turned_points(straight_map.keypoints(other), SIZE, orientation)
        assert np.median(cKDTree(keypoints).query(turned_map.keypoints(row))[0]) < 0.01
        for name, rows in turned_map.global_descriptors.items():
            assert rows[row] @ straight_map.global_descriptors[name][other] > 0.999


def test_colours_are_taken_where_the_stored_pixels_have_them(
    turned_map: Map, straight_map: Map
) -> None:
    assert turned_map.colors is not None
    assert straight_map.colors is not None
    nearest = cKDTree(straight_map.landmarks).query(turned_map.landmarks)[1]
    off_by = np.abs(turned_map.colors.astype(int) - straight_map.colors[nearest])
    assert np.mean(off_by.max(axis=1) <= 1) > 0.9


@pytest.mark.parametrize("orientation", [1, 2, 3, 5, 6, 8])
def test_queries_in_any_orientation_are_localized_in_it(
    turned_map: Map, straight_map: Map, query: Query, orientation: int
) -> None:
    extractor, options = make_local_features("sift"), LocalizeOptions()
    straight = Localizer(straight_map, extractor).localize(
        read_photo(query.image), query.camera, options
    )
    pixels = turned_pixels(read_photo(query.image).rgb, orientation)
    answer = Localizer(turned_map, extractor).localize(
        read_photo(png(pixels, orientation)), turned_camera(query.camera, orientation), options
    )

    assert isinstance(straight, Localized)
    assert isinstance(answer, Localized)
    assert answer.evidence.num_inliers == pytest.approx(straight.evidence.num_inliers, rel=0.02)
    truth = turned_pose(query.cam_from_world, orientation)
    assert pose_error(answer.cam_from_world, truth) < (0.003, 0.1)


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_a_dataset_whose_cameras_are_upright_is_read_upright(
    sample: Path, straight_map: Map, tmp_path: Path, orientation: int
) -> None:
    dataset = Path(shutil.copytree(sample / "mapping", tmp_path / "dataset"))
    for photo in dataset.rglob("*.jpg"):
        pixels = read_photo_file(photo).rgb
        if orientation in (5, 7):  # whoever made such a dataset mirrored the pixels as well
            pixels = pixels[:, ::-1]
        photo.write_bytes(png(turned_pixels(pixels, orientation), orientation))
    opened = build(dataset, tmp_path / "maps", keep_colours=True, keep_photos=True)

    assert opened.cameras == straight_map.cameras
    assert {image.turn for image in opened.images} == {1}
    np.testing.assert_array_equal(opened.landmarks, straight_map.landmarks)
    np.testing.assert_array_equal(opened.observation_keypoints, straight_map.observation_keypoints)
    assert opened.colors is not None
    np.testing.assert_array_equal(opened.colors, straight_map.colors)
    for name, rows in opened.global_descriptors.items():
        np.testing.assert_array_equal(rows, straight_map.global_descriptors[name])
    kept = opened.photo(0)
    assert kept is not None
    assert read_photo(kept).rgb.shape == (192, 256, 3)


@pytest.mark.parametrize(
    ("orientation", "size", "read"),
    [
        (6, (192, 256), "stored"),
        (6, (256, 192), "upright"),
        (1, (256, 192), None),  # nothing says that it was turned
        (3, (256, 192), None),
        (6, (512, 384), None),
    ],
)
def test_the_size_of_the_camera_tells_whose_frame_a_photo_is_read_in(
    sample: Path, tmp_path: Path, orientation: int, size: tuple[int, int], read: str | None
) -> None:
    upright = read_photo_file(next((sample / "mapping").rglob("*.jpg"))).rgb
    path = tmp_path / "photo.png"
    path.write_bytes(png(np.ascontiguousarray(np.rot90(upright)), orientation))

    if read is None:
        with pytest.raises(DatasetError) as caught:
            read_in_frame(path, size, "cam")
        assert (caught.value.code, caught.value.got) == ("dataset.photo_size", "192 x 256")
        return
    photo = read_in_frame(path, size, "cam")
    assert (photo.width, photo.height) == size
    assert photo.exif_orientation == (6 if read == "stored" else 1)
    expected = upright if read == "upright" else np.rot90(upright)
    np.testing.assert_array_equal(photo.rgb, expected)
