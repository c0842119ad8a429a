"""The database of an exported model: as COLMAP reads it, and as its image_registrator goes on."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap
import pycolmap
import pytest

from mapping.maps.colmap_database import matches_of_tracks
from mapping.maps.export import Queries, export_map
from visloc.archive import Map
from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.pose.reprojection import pose_from_colmap


def test_photos_that_see_a_point_match_there() -> None:
    observations = np.array([[0, 0, 5], [0, 2, 6], [0, 2, 7], [1, 1, 0], [1, 0, 1], [2, 1, 3]])
    matches = matches_of_tracks(observations)
    assert {pair: rows.tolist() for pair, rows in matches.items()} == {
        (0, 1): [[1, 0]],
        (0, 2): [[5, 6], [5, 7]],
    }


@pytest.fixture(scope="module")
def exported(sfm_walk: Map, walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("colmap") / "model"
    localizer = Localizer(sfm_walk, make_local_features("sift"))
    notes = export_map(sfm_walk, folder, "colmap", Queries(read_dataset(walk / "query"), localizer))
    assert notes == ()
    return folder


def test_pycolmap_reads_what_the_model_has(exported: Path, tmp_path: Path) -> None:
    copy = tmp_path / "database.db"  # pycolmap migrates it in place
    shutil.copy(exported / "database.db", copy)
    model = pycolmap.Reconstruction(exported)
    with pycolmap.Database.open(copy) as database:
        images = {image.image_id: image for image in database.read_all_images()}
        assert len(images) == 16 + 5
        for number, image in model.images.items():
            assert images[number].name == image.name
            assert images[number].camera_id == image.camera_id
            found = np.array(database.read_keypoints(number))[:, :2]
            np.testing.assert_allclose(found, [p.xy for p in image.points2D], atol=1e-3)
            described = database.read_descriptors(number).data
            assert described.shape == (len(found), 128)
            assert np.linalg.norm(described[0].astype(float)) == pytest.approx(512, rel=0.1)
        for number, camera in model.cameras.items():
            np.testing.assert_array_equal(database.read_camera(number).params, camera.params)
        # Every verified match of two mapping photos is one point of the model.
        geometry = database.read_two_view_geometry(1, 2)
        assert len(geometry.inlier_matches) > 20
        for i, j in geometry.inlier_matches:
            seen = [model.images[n].points2D[k].point3D_id for n, k in ((1, i), (2, j))]
            assert seen[0] == seen[1]
        relative = pose_from_colmap(geometry.cam2_from_cam1)
        truth = pose_from_colmap(
            model.images[2].cam_from_world() * model.images[1].cam_from_world().inverse()
        )
        np.testing.assert_allclose(relative.rotation, truth.rotation, atol=1e-9)
        np.testing.assert_allclose(relative.translation, truth.translation, atol=1e-9)


def test_the_schema_is_that_of_3_8(exported: Path, tmp_path: Path) -> None:
    if shutil.which("colmap") is None:
        pytest.skip("colmap is not on this machine (apt install colmap)")
    made = tmp_path / "made.db"
    command = ["colmap", "database_creator", "--database_path", str(made)]
    subprocess.run(command, check=True, capture_output=True)
    tables = ["cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries"]
    columns = {}
    for path in (made, exported / "database.db"):
        database = sqlite3.connect(path)
        version = database.execute("PRAGMA user_version").fetchone()
        info = [database.execute(f"PRAGMA table_info({table})").fetchall() for table in tables]
        columns[path] = version, info
        database.close()
    if columns[made][0] != (3800,):
        pytest.skip(f"this is another version of colmap: {columns[made][0]}")
    assert columns[made] == columns[exported / "database.db"]


def test_image_registrator_goes_on_from_the_export(
    exported: Path, walk: Path, tmp_path: Path
) -> None:
    if shutil.which("colmap") is None:
        pytest.skip("colmap is not on this machine (apt install colmap)")
    folder = tmp_path / "registered"
    folder.mkdir()
    command = ["colmap", "image_registrator", "--database_path", exported / "database.db"]
    command += ["--input_path", exported, "--output_path", folder]
    for name in ("focal_length", "principal_point", "extra_params"):
        command += [f"--Mapper.ba_refine_{name}", "0"]
    subprocess.run([str(word) for word in command], check=True, capture_output=True)

    model = pycolmap.Reconstruction(folder)
    poses = {
        image.name: pose_from_colmap(image.cam_from_world()) for image in model.images.values()
    }
    queries = read_dataset(walk / "query")
    for record in queries.images:
        truth = queries.pose(record)
        assert isinstance(truth, Pose)
        assert pose_error(poses[record.path], truth)[0] < 0.05


def test_other_formats_take_no_queries(sfm_walk: Map, walk: Path, tmp_path: Path) -> None:
    queries = Queries(
        read_dataset(walk / "query"), Localizer(sfm_walk, make_local_features("sift"))
    )
    with pytest.raises(InvalidInput) as caught:
        export_map(sfm_walk, tmp_path / "out", "ply", queries)
    assert caught.value.code == "export.queries"
    assert not (tmp_path / "out").exists()


def test_photos_of_the_map_are_no_queries(sfm_walk: Map, walk: Path, tmp_path: Path) -> None:
    queries = Queries(
        read_dataset(walk / "mapping"), Localizer(sfm_walk, make_local_features("sift"))
    )
    with pytest.raises(InvalidInput) as caught:
        export_map(sfm_walk, tmp_path / "out", "colmap", queries)
    assert caught.value.code == "export.no_queries"
    assert not (tmp_path / "out").exists()
