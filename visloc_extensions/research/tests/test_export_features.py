from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from mapping.cli.main import app
from tests.turning import store_photo_turned, turned_points
from visloc.archive import MapStore
from visloc.errors import Conflict, DatasetError
from visloc.features import make_global_descriptor, make_local_features
from visloc.geometry import PixelOrigin
from visloc.kapture import open_local_features, read_dataset, read_local
from visloc.options import Inference
from visloc.photos.reading import read_photo_file
from visloc_extensions.research.export_features import export_features

SIFT_DIM = 128


def export(dataset: Path, output: Path, **changes: Any) -> list[tuple[str, int, int]]:
    """Export and return what progress was told."""
    steps: list[tuple[str, int, int]] = []
    settings: dict[str, Any] = {
        "local_features": "sift",
        "weights_dir": None,
        "inference": Inference.AUTO,
        "max_keypoints": 5000,
        "global_from": None,
    } | changes
    export_features(dataset, output, progress=lambda *step: steps.append(step), **settings)
    return steps


def files(folder: Path) -> dict[Path, tuple[int, int]]:
    """Identity of every file that is not a link."""
    found = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {path: ((info := path.stat()).st_ino, info.st_mtime_ns) for path in found}


def rows(path: Path, columns: int) -> NDArray[np.float32]:
    return np.fromfile(path, "<f4").reshape(-1, columns)


@pytest.fixture(scope="module")
def exported(sample: Path, built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The query photos with the features of the map ``room``; only to be read."""
    output = tmp_path_factory.mktemp("export") / "kapture"
    opened = MapStore(built_maps).open("room")
    assert export(sample / "query", output, global_from=opened)[-1] == ("features", 3, 3)
    return output


def test_an_export_is_a_kapture_of_the_same_photos(sample: Path, exported: Path) -> None:
    original, copy = read_dataset(sample / "query"), read_dataset(exported)
    assert not copy.notes
    assert copy.images == original.images
    assert {s: sensor.camera for s, sensor in copy.sensors.items()} == {
        s: sensor.camera for s, sensor in original.sensors.items()
    }
    for record in original.images:
        assert copy.path_of(record).read_bytes() == original.path_of(record).read_bytes()
        pose, truth = copy.pose(record), original.pose(record)
        assert pose is not None
        assert truth is not None
        assert pose.rotation == pytest.approx(truth.rotation, abs=1e-15)
        assert pose.translation == pytest.approx(truth.translation, abs=1e-15)


def test_every_photo_has_its_features_in_kapture_s_layout(exported: Path) -> None:
    extractor = make_local_features("sift")
    dataset = read_dataset(exported)
    keypoints_dir = exported / "reconstruction" / "keypoints" / "sift"
    descriptors_dir = exported / "reconstruction" / "descriptors" / "sift"
    for record in dataset.images:
        local = extractor.extract(read_photo_file(dataset.path_of(record)).rgb, max_keypoints=5000)
        keypoints = rows(keypoints_dir / f"{record.path}.kpt", 3)
        descriptors = rows(descriptors_dir / f"{record.path}.desc", SIFT_DIM)
        assert len(keypoints) == len(descriptors) == len(local) > 500
        assert np.array_equal(keypoints, np.column_stack([local.keypoints, local.scales]))
        assert np.array_equal(descriptors, local.descriptors)
        assert np.linalg.norm(descriptors, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert (keypoints_dir / "keypoints.txt").read_text().splitlines()[-1] == "sift, float32, 3"
    assert (descriptors_dir / "descriptors.txt").read_text().splitlines()[-1] == (
        "sift, float32, 128, sift, L2"
    )


def test_the_global_descriptors_are_those_that_the_map_compares(
    exported: Path, built_maps: Path
) -> None:
    opened = MapStore(built_maps).open("room")
    dataset, extractor = read_dataset(exported), make_local_features("sift")
    for name, mapped in opened.global_descriptors.items():
        folder = exported / "reconstruction" / "global_features" / name
        descriptor = make_global_descriptor(name)
        for record in dataset.images:
            vector = rows(folder / f"{record.path}.gfeat", mapped.values.shape[1])[0]
            assert np.linalg.norm(vector) == pytest.approx(1.0, abs=1e-5)
            rgb = read_photo_file(dataset.path_of(record)).rgb
            local = extractor.extract(rgb, max_keypoints=5000)
            expected = descriptor.describe(rgb, local, opened.global_models[name])
            assert np.array_equal(vector, expected)


def test_the_mapping_photos_get_what_the_map_holds_of_them(
    sample: Path, built_maps: Path, tmp_path: Path
) -> None:
    opened = MapStore(built_maps).open("room")
    export(sample / "mapping", tmp_path, global_from=opened)
    for name, mapped in opened.global_descriptors.items():
        folder = tmp_path / "reconstruction" / "global_features" / name
        for row, image in enumerate(opened.images):
            vector = rows(folder / f"{image.name}.gfeat", mapped.values.shape[1])[0]
            assert vector == pytest.approx(mapped[row], abs=5e-3)  # the map has 8 bits of them


def test_a_second_run_does_nothing(sample: Path, exported: Path, built_maps: Path) -> None:
    before = files(exported)
    opened = MapStore(built_maps).open("room")
    assert export(sample / "query", exported, global_from=opened)[-1] == ("features", 3, 3)
    assert files(exported) == before


@pytest.mark.parametrize("kind", ["descriptors/sift", "global_features/localvlad"])
def test_only_what_is_missing_is_done_again(
    sample: Path, tmp_path: Path, built_maps: Path, kind: str
) -> None:
    opened = MapStore(built_maps).open("room")
    export(sample / "query", tmp_path, global_from=opened)
    before = files(tmp_path)
    missing = next((tmp_path / "reconstruction" / kind).rglob("right/*"))
    content = missing.read_bytes()
    missing.unlink()

    export(sample / "query", tmp_path, global_from=opened)
    assert missing.read_bytes() == content
    changed = {path for path, identity in files(tmp_path).items() if before[path] != identity}
    assert missing in changed
    assert all("right/0001.jpg" in str(path) for path in changed)


@pytest.mark.parametrize("changes", [{"max_keypoints": 400}, {"global_from": None}])
def test_a_folder_with_features_of_other_settings_is_refused_and_left_alone(
    sample: Path, exported: Path, changes: dict[str, object]
) -> None:
    before = files(exported)
    with pytest.raises(Conflict) as caught:
        export(sample / "query", exported, **changes)
    assert caught.value.code == "export.other_settings"
    assert str(exported) in str(caught.value)
    assert files(exported) == before


def test_a_folder_with_another_dataset_is_refused_and_left_alone(
    sample: Path, exported: Path
) -> None:
    before = files(exported)
    with pytest.raises(Conflict) as caught:
        export(sample / "mapping", exported)
    assert (caught.value.code, caught.value.field) == ("export.other_dataset", str(exported))
    assert files(exported) == before


@pytest.mark.parametrize("changes", [{"local_features": "xfeat"}, {"max_keypoints": 400}])
def test_a_map_of_other_local_features_is_refused(
    sample: Path, built_maps: Path, tmp_path: Path, changes: dict[str, object]
) -> None:
    opened = MapStore(built_maps).open("room")
    with pytest.raises(Conflict, match=r"got sift, at most 5000 per photo") as caught:
        export(sample / "query", tmp_path, global_from=opened, **changes)
    assert caught.value.code == "map.features"
    assert not list(tmp_path.iterdir())


def test_photos_that_are_absent_are_told_and_passed_over(sample: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(sample / "query", tmp_path / "query"))
    (dataset / "sensors" / "records_data" / "query" / "left" / "0002.jpg").unlink()
    steps: list[tuple[str, int, int]] = []
    absent = export_features(
        dataset,
        tmp_path / "out",
        local_features="sift",
        weights_dir=None,
        inference=Inference.AUTO,
        max_keypoints=400,
        global_from=None,
        progress=lambda *step: steps.append(step),
    )
    assert absent == ["query/left/0002.jpg"]
    assert steps[-1] == ("features", 3, 3)
    assert len(list((tmp_path / "out" / "reconstruction").rglob("*.desc"))) == 2


def test_features_of_turned_photos_are_in_stored_pixels(sample: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(sample / "mapping", tmp_path / "dataset"))
    photo = dataset / "sensors" / "records_data" / "mapping" / "left" / "0001.jpg"
    store_photo_turned(photo, 3)  # of the same size
    size, keypoints = (256, 192), []
    for name, source in (("turned", dataset), ("straight", sample / "mapping")):
        export(source, tmp_path / name, max_keypoints=500)
        sets = open_local_features(tmp_path / name, "sift", None)
        rows = read_local(*sets, "mapping/left/0001.jpg", size, PixelOrigin.CORNER)
        keypoints.append(rows[0])
    np.testing.assert_allclose(keypoints[0], turned_points(keypoints[1], size, 3), atol=1e-3)


def test_the_command_refuses_what_is_no_dataset() -> None:
    done = CliRunner().invoke(app, ["export-features", "nowhere", "--output", "out"])
    assert isinstance(done.exception, DatasetError)
    assert done.exception.code == "kapture.no_dataset"
