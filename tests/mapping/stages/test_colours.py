from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from mapping.cli.main import app
from mapping.cluster.workers import Workers
from mapping.maps.export import export_map
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.stages.colours import landmark_colours
from mapping.stages.context import BuildContext
from mapping.stages.local_features import ExtractedFeatures
from mapping.stages.networks import Networks
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import WorkFolder
from visloc.archive import Landmarks, Map, MapStore, sha256_of, verify_map
from visloc.errors import DatasetError
from visloc.geometry import Camera, Pose
from visloc.kapture import FileRecord, read_dataset
from visloc.options import Inference
from visloc.photos.reading import read_photo_file

Build = Callable[..., Map]
RED, GREEN, BLUE, GREY = (250, 10, 20), (0, 200, 100), (30, 40, 255), (77, 77, 77)


NO_NETWORKS = Networks(None, Inference.AUTO)
NO_FEATURES = cast("ExtractedFeatures", None)  # colours are those of photos


def quiet(*_: object) -> None:
    pass


@pytest.fixture(scope="module")
def coloured(build_sample: Build) -> Map:
    """The map ``room`` with colours; only to be read."""
    return build_sample(keep_colours=True)


@pytest.fixture(scope="module")
def coloured_walk(walk: Path, tmp_path_factory: pytest.TempPathFactory, build_walk: Build) -> Map:
    """The map by matches with colours; only to be read."""
    return build_walk(walk / "mapping", tmp_path_factory.mktemp("walk"), keep_colours=True)


def mean_of_pixels(opened: Map, dataset: Path) -> NDArray[np.float64]:
    """The mean colour (P, 3) under the observations that the map stores, photo by photo."""
    records = read_dataset(dataset)
    path_of = {record.path: records.path_of(record) for record in records.images}
    seen: list[list[NDArray[np.uint8]]] = [[] for _ in opened.landmarks]
    offsets = opened.observation_offsets
    step = opened.manifest.local_features.keypoint_step_px
    assert step is not None
    for row, image in enumerate(opened.images):
        rgb = read_photo_file(path_of[image.name]).rgb
        own = slice(offsets[row], offsets[row + 1])
        for landmark, (x, y) in zip(
            opened.observation_landmarks[own],
            opened.observation_keypoints[own] * step,
            strict=True,
        ):
            seen[landmark].append(rgb[int(y), int(x)])
    return np.array([np.mean(pixels, axis=0) for pixels in seen])


@pytest.mark.parametrize("method", ["rgbd", "sfm"])
def test_landmarks_have_the_mean_colour_of_the_pixels_where_photos_see_them(
    request: pytest.FixtureRequest, sample: Path, walk: Path, method: str
) -> None:
    opened: Map = request.getfixturevalue("coloured" if method == "rgbd" else "coloured_walk")
    dataset = (sample if method == "rgbd" else walk) / "mapping"
    assert opened.manifest.method.name == method
    assert opened.colors is not None
    off_by = np.abs(opened.colors - mean_of_pixels(opened, dataset)).max(axis=1)
    # The map rounds pixels to 1/64 or so, over the edge of a few.
    assert np.mean(off_by <= 0.5) > 0.95
    assert len(np.unique(opened.colors, axis=0)) > 100
    verify_map(opened.path)


def test_a_map_keeps_no_colours_unless_asked_and_is_the_same_otherwise(
    built_maps: Path, coloured: Map
) -> None:
    plain = MapStore(built_maps).open("room")
    assert plain.colors is None
    assert not (plain.path / "landmark_rgb.npy").exists()
    with_colours = dict(coloured.manifest.files)
    del with_colours["landmark_rgb.npy"]
    assert with_colours == plain.manifest.files
    assert coloured.manifest.content_hash != plain.manifest.content_hash


def test_equal_builds_keep_equal_colours_with_any_number_of_workers(
    coloured: Map, sample: Path, tmp_path: Path
) -> None:
    settings = BuildSettings(
        *(sample / "mapping", "room", tmp_path),
        local_features="sift",
        keep_colours=True,
        workers=2,
    )
    build_map(settings, quiet)
    again = MapStore(tmp_path).open("room")
    assert again.manifest.content_hash == coloured.manifest.content_hash


def test_stopped_among_the_colours_the_same_build_resumes(
    walk: Path, tmp_path: Path, coloured_walk: Map
) -> None:
    settings = BuildSettings(
        *(walk / "mapping", "walk", tmp_path, "sfm", "sift", ("localvlad",)),
        max_keypoints=500,
        keep_colours=True,
    )
    folder = tmp_path / ".work" / "walk" / "colours"
    found: dict[str, dict[Path, int]] = {}

    def finished() -> dict[Path, int]:
        return {path: path.stat().st_ino for path in folder.iterdir()}

    def stop(stage: str, done: int, _total: int) -> None:
        if (stage, done) == ("colours", 3):
            raise KeyboardInterrupt

    def look(stage: str, done: int, total: int) -> None:
        if stage == "colours" and done in (0, total):
            found["before" if done == 0 else "after"] = finished()

    with pytest.raises(KeyboardInterrupt):
        build_map(settings, stop)
    build_map(settings, look)

    assert len(found["before"]) == 3
    assert len(found["after"]) == 16
    assert found["after"].items() >= found["before"].items()  # nothing finished was done again
    again = MapStore(tmp_path).open("walk")
    assert again.manifest.content_hash == coloured_walk.manifest.content_hash


# Photos of a few pixels, whose landmarks and colours are known exactly.


def photo_of(
    path: Path, rgb: NDArray[np.uint8], size: tuple[int, int] | None = None
) -> MappingPhoto:
    """Write the pixels and say what a build knows of them."""
    assert cv2.imwrite(str(path), rgb[..., ::-1] if rgb.ndim == 3 else rgb)
    width, height = size or (rgb.shape[1], rgb.shape[0])
    camera = Camera("SIMPLE_PINHOLE", width, height, (50.0, width / 2, height / 2))
    record = FileRecord(0, "cam", path.name)
    pose = Pose(np.eye(3), np.zeros(3))
    return MappingPhoto(record, path, sha256_of(path), camera, True, pose, None, None)


def landmarks_of(num: int, seen: list[list[tuple[int, float, float]]]) -> Landmarks:
    """Landmarks of which each photo sees some: rows of landmark, x, y."""
    rows = [row for own in seen for row in own]
    return Landmarks(
        origin=np.zeros(3),
        points=np.zeros((num, 3), np.float32),
        track_lengths=np.zeros(num, np.uint16),
        errors_px=np.zeros(num, np.float32),
        angles_deg=np.zeros(num, np.float32),
        offsets=np.cumsum([0, *map(len, seen)]),
        observed=np.array([row[0] for row in rows], np.uint32),
        keypoints=np.array([row[1:] for row in rows], np.float32).reshape(-1, 2),
    )


def colours_of(
    tmp_path: Path, photos: list[MappingPhoto], landmarks: Landmarks
) -> NDArray[np.uint8]:
    with Workers(1) as workers:
        context = BuildContext(
            WorkFolder(tmp_path / "work"), NO_FEATURES, NO_NETWORKS, workers, quiet
        )
        return landmark_colours(context, photos, landmarks)


def test_the_pixel_is_the_one_that_the_keypoint_lies_in(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (3, 4, 3), np.uint8)
    at = [(0.5, 0.5), (0.0, 0.99), (1.0, 0.5), (3.99, 2.99), (4.0, 3.0), (-0.2, 4.5)]
    pixels = [(0, 0), (0, 0), (0, 1), (2, 3), (2, 3), (2, 0)]
    landmarks = landmarks_of(6, [[(row, *xy) for row, xy in enumerate(at)]])
    found = colours_of(tmp_path, [photo_of(tmp_path / "a.png", rgb)], landmarks)
    assert found.dtype == np.uint8
    assert found.tolist() == [rgb[pixel].tolist() for pixel in pixels]


def test_colours_of_several_photos_are_averaged_and_rounded(tmp_path: Path) -> None:
    photos = [
        photo_of(tmp_path / f"{row}.png", np.full((8, 8, 3), colour, np.uint8))
        for row, colour in enumerate([RED, GREEN, BLUE])
    ]
    seen = [[(0, 1.5, 1.5), (1, 2.5, 2.5)], [(1, 3.5, 3.5)], [(1, 4.5, 4.5), (1, 5.5, 4.5)]]
    found = colours_of(tmp_path, photos, landmarks_of(3, seen))
    # The second is seen by red and green once, by blue twice; the third by nobody.
    assert found.tolist() == [list(RED), [78, 73, 158], [0, 0, 0]]


def test_photos_that_see_nothing_are_fine_and_white_stays_white(tmp_path: Path) -> None:
    photos = [
        photo_of(tmp_path / f"{row}.png", np.full((4, 4, 3), 255, np.uint8)) for row in range(3)
    ]
    found = colours_of(tmp_path, photos, landmarks_of(1, [[(0, 1, 1)], [], [(0, 2, 2)]]))
    assert found.tolist() == [[255, 255, 255]]


def test_grey_photos_give_grey(tmp_path: Path) -> None:
    photos = [photo_of(tmp_path / "grey.png", np.full((4, 4), GREY[0], np.uint8))]
    assert colours_of(tmp_path, photos, landmarks_of(1, [[(0, 1.5, 1.5)]])).tolist() == [list(GREY)]


def test_a_photo_of_another_size_than_its_camera_is_refused(tmp_path: Path) -> None:
    photo = photo_of(tmp_path / "a.png", np.zeros((4, 8, 3), np.uint8), size=(4, 4))
    with pytest.raises(DatasetError) as caught:
        colours_of(tmp_path, [photo], landmarks_of(1, [[(0, 1, 1)]]))
    assert (caught.value.code, caught.value.got) == ("dataset.photo_size", "8 x 4")
    assert str(photo.path) in str(caught.value)


@pytest.fixture(scope="module")
def exported(sfm_walk: Map, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The walk as a dataset of points and features, without photos; only to be read."""
    output = tmp_path_factory.mktemp("exported") / "dataset"
    export_map(sfm_walk, output, "kapture")
    return output


READY_MADE = {"local_features": "kapture:sift", "method": "model", "metric": True}


def test_ready_made_features_without_photos_are_refused(
    exported: Path, tmp_path: Path, build_walk: Build
) -> None:
    with pytest.raises(DatasetError, match="the file is absent") as caught:
        build_walk(exported, tmp_path, **READY_MADE, keep_colours=True)
    assert caught.value.code == "dataset.no_photos"


def test_a_model_without_colours_gets_those_of_the_photos(
    exported: Path, walk: Path, tmp_path: Path, build_walk: Build, coloured_walk: Map
) -> None:
    dataset = tmp_path / "dataset"
    link_photos(exported, walk, dataset)
    built = build_walk(dataset, tmp_path / "maps", **READY_MADE, keep_colours=True)
    assert built.colors is not None
    assert coloured_walk.colors is not None
    # The keypoints were rounded on their way.
    off_by = np.abs(built.colors.astype(int) - coloured_walk.colors).max(axis=1)
    assert np.mean(off_by <= 1) > 0.9


def test_colours_that_a_model_brings_along_stay(
    walk: Path, tmp_path: Path, build_walk: Build, coloured_walk: Map
) -> None:
    painted = np.array(coloured_walk.colors)[:, ::-1] // 2
    exported = tmp_path / "exported"
    export_map(replace(coloured_walk, colors=painted), exported, "kapture")
    dataset = tmp_path / "dataset"
    link_photos(exported, walk, dataset)
    for keep in (False, True):
        built = build_walk(dataset, tmp_path / "maps", **READY_MADE, keep_colours=keep)
        assert built.colors is not None
        assert np.array_equal(built.colors, painted)


def link_photos(exported: Path, walk: Path, dataset: Path) -> None:
    """Make a dataset of exported points and features and of the photos of the walk."""
    (dataset / "sensors").mkdir(parents=True)
    (dataset / "reconstruction").symlink_to(exported / "reconstruction")
    for path in (exported / "sensors").glob("*.txt"):
        (dataset / "sensors" / path.name).symlink_to(path)
    (dataset / "sensors" / "records_data").symlink_to(walk / "mapping" / "sensors" / "records_data")


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Run the command in a wide window and return what it prints."""
    monkeypatch.setattr("rich.console.Console.width", 200)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words]).stdout


def test_inspect_says_what_a_map_keeps(
    run: Callable[..., str], coloured: Map, built_maps: Path
) -> None:
    assert re.search(r"keeps +colours *\n", run("inspect", coloured.path))
    plain = MapStore(built_maps).open("room").path
    assert re.search(r"keeps +neither photos nor colours *\n", run("inspect", plain))
    assert '"keeps": []' in run("inspect", plain, "--json")


def test_build_takes_the_option(
    run: Callable[..., str], sample: Path, tmp_path: Path, coloured: Map
) -> None:
    out = run(
        *("build", sample / "mapping", "--map", "room", "--maps-dir", tmp_path),
        *("--local-features", "sift", "--keep-colours", "--keep-photos", "--workers", 1),
    )
    assert re.search(r"keeps +photos, colours *\n", out)
    built = MapStore(tmp_path).open("room")
    assert built.colors is not None
    assert np.array_equal(built.colors, np.array(coloured.colors))
