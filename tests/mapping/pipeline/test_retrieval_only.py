"""Maps without landmarks: queries triangulate the photos around themselves."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from mapping.cli.main import app
from mapping.maps.export import EXPORTERS, export_map
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import Map, verify_map
from visloc.drawing.detail_levels import detail_order, read_landmarks
from visloc.drawing.point_bytes import HEADER_BYTES, read_points
from visloc.errors import Conflict, InvalidInput
from visloc.features import make_local_features
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import MapGeometry
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo, read_photo_file
from visloc.types import Localized, Uncertainty


def quiet(*_: object) -> None:
    pass


@pytest.fixture(scope="module")
def bare(
    walk: Path, build_walk: Callable[..., Map], tmp_path_factory: pytest.TempPathFactory
) -> Map:
    """The walk as a map without landmarks; only to be read."""
    maps = tmp_path_factory.mktemp("bare")
    return build_walk(walk / "mapping", maps, method="retrieval-only", max_keypoints=1000)


def test_a_map_without_landmarks_keeps_all_that_was_found(bare: Map) -> None:
    assert verify_map(bare.path).has_landmarks is False
    counts = bare.manifest.counts
    assert (counts.images, counts.landmarks) == (16, 0)
    assert bare.landmarks.shape == (0, 3)
    assert bare.observation_landmarks.tolist() == list(range(counts.observations))
    # As many as there were: keypoints without a match stay.
    assert np.diff(bare.observation_offsets).min() > 100
    centers = MapGeometry(bare).centers
    extent = bare.manifest.world.extent
    assert np.allclose([extent.min, extent.max], [centers.min(axis=0), centers.max(axis=0)])


def test_queries_are_localized_where_they_were_taken(
    bare: Map,
    walk: Path,
    localization_errors: Callable[[Map, Path], NDArray[np.float64]],
) -> None:
    errors = localization_errors(bare, walk / "query")
    # The photos have 256 x 192 pixels, and the room is 5 m wide.
    assert np.median(errors[:, 0]) < 0.03
    assert errors[:, 0].max() < 0.1
    assert errors[:, 1].max() < 2.0


def test_triangulated_points_lie_where_depth_says(bare: Map, walk: Path) -> None:
    by_depth = _depth_map_points(walk, bare)
    geometry = MapGeometry(bare)
    placed, apart = 0, []
    for row in range(len(bare.images)):
        landmarks, _ = geometry.observed(row)
        points = geometry.points(landmarks)
        assert np.isfinite(points).all()
        placed += len(points)
        apart += np.abs(by_depth(row, bare.keypoints(row), landmarks, points)).tolist()
    assert placed > 0.1 * bare.manifest.counts.observations
    assert np.median(apart) < 0.05


def _depth_map_points(walk: Path, bare: Map) -> Callable[..., NDArray[np.float64]]:
    """How much nearer or farther points are than the surface that a photo shows, metres."""
    dataset = read_dataset(walk / "mapping")
    depth = {record.timestamp: {} for record in dataset.images}  # type: ignore[var-annotated]
    for record in dataset.depth_maps:
        depth[record.timestamp][record.sensor_id.removesuffix("_depth")] = dataset.path_of(record)
    geometry = MapGeometry(bare)

    def apart(
        row: int,
        keypoints: NDArray[np.float32],
        landmarks: NDArray[np.integer],
        points: NDArray[np.float32],
    ) -> NDArray[np.float64]:
        image = bare.images[row]
        camera = bare.cameras[image.camera]
        values = np.fromfile(depth[image.timestamp][image.camera], "<f4")
        surface = values.reshape(camera.height, camera.width)
        rows = landmarks.astype(np.int64) - bare.observation_offsets[row]
        across, down = np.floor(keypoints[rows]).astype(int).T
        in_cam = geometry.viewpoints.pose(row).apply(points.astype(np.float64))
        there = surface[np.clip(down, 0, camera.height - 1), np.clip(across, 0, camera.width - 1)]
        return np.asarray(in_cam[:, 2] - there)[there > 0]

    return apart


def test_the_answer_does_not_depend_on_what_was_asked_before(bare: Map, walk: Path) -> None:
    dataset = read_dataset(walk / "query")
    asked = [
        (read_photo_file(dataset.path_of(record)), dataset.sensors[record.sensor_id].camera)
        for record in dataset.images[:3]
    ]

    def answers(order: list[int]) -> dict[int, NDArray[np.float64]]:
        localizer = Localizer(bare, make_local_features("sift"))
        found = {}
        for number in order:
            answer = localizer.localize(*asked[number], LocalizeOptions())
            assert isinstance(answer, Localized)
            found[number] = answer.cam_from_world.center
        return found

    first, second = answers([0, 1, 2]), answers([2, 1, 0, 0])
    for number in range(3):
        np.testing.assert_array_equal(first[number], second[number])


def test_the_own_test_leaves_photos_out_of_the_triangulation(bare: Map) -> None:
    test = bare.manifest.parts.own_test
    assert test is not None
    assert test.independent
    assert test.localized - test.wrong >= 0.7 * test.tested
    whole = MapGeometry(bare)
    neighbours = whole.nearest_photos(0, 6)[1:]
    less = whole.without(neighbours)
    assert len(less.observed(0)[0]) < len(whole.observed(0)[0])
    assert less.reach == whole.reach


def test_answers_state_the_whole_uncertainty(bare: Map, walk: Path) -> None:
    dataset = read_dataset(walk / "query")
    localizer = Localizer(bare, make_local_features("sift"))
    record = dataset.images[0]
    camera, truth = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
    answer = localizer.localize(read_photo_file(dataset.path_of(record)), camera, LocalizeOptions())
    assert isinstance(answer, Localized)
    assert truth is not None
    assert answer.uncertainty is Uncertainty.WHOLE
    off = np.abs(answer.cam_from_world.center - truth.center)
    assert (off <= 4.0 * answer.position_std).all()


def test_a_photo_of_another_place_is_refused(bare: Map) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (192, 256, 3), dtype=np.uint8)
    localizer = Localizer(bare, make_local_features("sift"))
    assert not isinstance(localizer.localize(Photo(noise), None, LocalizeOptions()), Localized)


@pytest.mark.parametrize("name", EXPORTERS)
def test_exports_are_refused(bare: Map, tmp_path: Path, name: str) -> None:
    with pytest.raises(Conflict, match="has no landmarks"):
        export_map(bare, tmp_path / "out", name)
    assert not (tmp_path / "out").exists()


def test_inspect_tells_that_there_are_no_landmarks(bare: Map) -> None:
    shown = CliRunner().invoke(app, ["inspect", str(bare.path)])
    assert shown.exit_code == 0, shown.output
    assert "none: queries triangulate" in shown.output
    told = json.loads(CliRunner().invoke(app, ["inspect", str(bare.path), "--json"]).output)
    assert told["mean_track_length"] is None


def test_the_page_gets_no_points(bare: Map) -> None:
    landmarks = read_landmarks(bare.path, bare.manifest)
    order = detail_order(landmarks)
    assert len(read_points(bare.path, bare.manifest, order, 0)) == HEADER_BYTES


def test_colours_need_landmarks(walk: Path, tmp_path: Path) -> None:
    settings = BuildSettings(
        walk / "mapping", "bare", tmp_path, method="retrieval-only", keep_colours=True
    )
    with pytest.raises(InvalidInput) as caught:
        build_map(settings, quiet)
    assert caught.value.code == "build.keep_colours"
