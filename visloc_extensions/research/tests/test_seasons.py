"""Small folders in the layouts of Aachen Day-Night, Extended CMU Seasons and RobotCar Seasons."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from visloc.errors import DatasetError, InvalidInput
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, read_dataset
from visloc_extensions.research.datasets import write_parts

DAY, NIGHT = "query/day/milestone/a.jpg", "query/night/nexus5x/b.jpg"
DATABASE = ("db/1.jpg", "db/2.jpg")
CMU_DATABASE = ("img_00122_c0_1303398475046031us.jpg", "img_00123_c1_1303398475046031us.jpg")
CMU_QUERIES = ("img_00001_c1_1283347879534213us.jpg", "img_00002_c0_1283347879600000us.jpg")
ROBOTCAR = ("overcast-reference/rear/1417178853389469.jpg", "night/left/1418236300000000.jpg")


def pose(seed: int) -> tuple[np.ndarray, Rotation]:
    """Centre and rotation of cam_from_world."""
    rng = np.random.default_rng(seed)
    return rng.normal(scale=20, size=3), Rotation.random(random_state=rng)


def posed(seed: int) -> str:
    """Quaternion, scalar first, and centre."""
    center, rotation = pose(seed)
    x, y, z, w = rotation.as_quat()
    return " ".join(f"{float(value):.9f}" for value in (w, x, y, z, *center))


def check_pose(found: Pose | None, seed: int) -> None:
    center, rotation = pose(seed)
    assert found is not None
    np.testing.assert_allclose(found.center, center, atol=1e-6)
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-6)


def write_photos(root: Path, names: tuple[str, ...], size: tuple[int, int]) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size).save(root / name)


def write(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines))


def radial(name: str, focal: float) -> str:
    return f"{name} SIMPLE_RADIAL 160 120 {focal} 80 60 -0.01"


def nvm(*names: str) -> tuple[str, ...]:
    cameras = [f"{name} 999 {posed(seed)} -0.05 0" for seed, name in enumerate(names)]
    return "NVM_V3", "", str(len(names)), *cameras, "", "1", "1 2 3 9 9 9 1 0 0 1.5 2.5", "", "0"


def made(name: str, folder: Path, output: Path) -> tuple[Dataset, Dataset]:
    write_parts(name, folder, output)
    mapping, query = (read_dataset(output / part) for part in ("mapping", "query"))
    for dataset in (mapping, query):
        assert all(dataset.has_file(record) for record in dataset.images)
    return mapping, query


def cameras(dataset: Dataset) -> list[Camera | None]:
    return [dataset.sensors[record.sensor_id].camera for record in dataset.images]


@pytest.fixture
def aachen(tmp_path: Path) -> Path:
    folder = tmp_path / "aachen"
    write_photos(folder / "images_upright", (*DATABASE, DAY, NIGHT), (160, 120))
    write(folder / "3D-models/aachen_cvpr2018_db.nvm", *nvm(*DATABASE))
    lines = [radial(name, 100 + n) for n, name in enumerate(DATABASE)]
    write(folder / "3D-models/database_intrinsics.txt", *lines)
    write(folder / "queries/day_time_queries_with_intrinsics.txt", radial(DAY, 200))
    write(folder / "queries/night_time_queries_with_intrinsics.txt", radial(NIGHT, 300))
    return folder


@pytest.fixture
def aachen_v1_1(aachen: Path) -> Path:
    folder = aachen / "3D-models" / "aachen_v_1_1"
    for file in (aachen / "3D-models").iterdir():
        file.unlink()
    folder.mkdir()
    model = pycolmap.Reconstruction()
    for n, name in enumerate(DATABASE):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=n + 1,
                model="SIMPLE_RADIAL",
                width=160,
                height=120,
                params=[100.0 + n, 80, 60, -0.01],
            )
        )
        center, rotation = pose(n)
        rigid = pycolmap.Rigid3d(
            pycolmap.Rotation3d(rotation.as_quat()), -rotation.as_matrix() @ center
        )
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=name, camera_id=n + 1, image_id=n + 1), rigid
        )
    model.write_binary(folder)
    return aachen


@pytest.mark.parametrize("name", ["aachen", "aachen-v1.1"])
def test_aachen_has_the_cameras_of_its_lists_and_the_poses_of_its_model(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    folder = request.getfixturevalue(name.replace("-", "_").replace(".", "_"))

    mapping, query = made(name, folder, tmp_path / "out")

    assert [record.path for record in mapping.images] == list(DATABASE)
    for seed, record in enumerate(mapping.images):
        check_pose(mapping.pose(record), seed)
    assert cameras(mapping) == [
        Camera("SIMPLE_RADIAL", 160, 120, (100.0 + n, 80.0, 60.0, -0.01)) for n in range(2)
    ]
    assert {record.path for record in query.images} == {DAY, NIGHT}
    by_name = dict(zip([r.path for r in query.images], cameras(query), strict=True))
    assert by_name[DAY] == Camera("SIMPLE_RADIAL", 160, 120, (200.0, 80.0, 60.0, -0.01))
    assert by_name[NIGHT] == Camera("SIMPLE_RADIAL", 160, 120, (300.0, 80.0, 60.0, -0.01))
    assert not query.trajectories


def test_photos_of_aachen_may_lie_where_hloc_unpacks_them(aachen: Path, tmp_path: Path) -> None:
    (aachen / "images").mkdir()
    (aachen / "images_upright").rename(aachen / "images" / "images_upright")
    mapping, _ = made("aachen", aachen, tmp_path / "out")
    assert [record.path for record in mapping.images] == list(DATABASE)


@pytest.fixture
def cmu(tmp_path: Path) -> Path:
    folder = tmp_path / "extended_cmu" / "slice7"
    write_photos(folder / "database", CMU_DATABASE, (102, 76))
    write_photos(folder / "query", CMU_QUERIES, (102, 76))
    params = "1024 768 868.99 866.06 525.94 420.04 -0.4 0.2 0.0 0.0"
    lines = [f"{camera} OPENCV {params}" for camera in ("c0", "c1")]
    write(folder.parent / "intrinsics.txt", "# id model", *lines)
    lines = [f"{name} {posed(seed)}" for seed, name in enumerate(CMU_DATABASE)]
    write(folder / "ground-truth-database-images-slice7.txt", *lines)
    write(folder / "test-images-slice7.txt", *CMU_QUERIES)
    write(folder / "camera-poses" / "slice-7-run-1.txt", f"{CMU_QUERIES[0]} {posed(5)}")
    return folder


def test_cmu_has_two_cameras_and_the_poses_that_are_published(cmu: Path, tmp_path: Path) -> None:
    mapping, query = made("cmu", cmu, tmp_path / "out")

    assert [record.path for record in mapping.images] == list(CMU_DATABASE)
    for seed, record in enumerate(mapping.images):
        check_pose(mapping.pose(record), seed)
        assert record.timestamp == 1303398475046031
        assert record.sensor_id == f"c{seed}"
    camera = Camera("OPENCV", 1024, 768, (868.99, 866.06, 525.94, 420.04, -0.4, 0.2, 0.0, 0.0))
    assert cameras(mapping) == [camera, camera]
    poses = {record.path: query.pose(record) for record in query.images}
    check_pose(poses[CMU_QUERIES[0]], 5)
    assert poses[CMU_QUERIES[1]] is None


@pytest.fixture
def robotcar(tmp_path: Path) -> Path:
    folder = tmp_path / "robotcar"
    write_photos(folder / "images", ROBOTCAR, (102, 102))
    for name in ("left", "rear", "right"):
        write(folder / f"intrinsics/{name}_intrinsics.txt", "fx 400", "fy 400", "cx 500", "cy 510")
    png = ROBOTCAR[0].replace("jpg", "png")
    write(folder / "3D-models/all-merged/all.nvm", *nvm(f"./{png}"))
    return folder


def test_robotcar_maps_the_reference_and_asks_the_rest(robotcar: Path, tmp_path: Path) -> None:
    mapping, query = made("robotcar", robotcar, tmp_path / "out")

    (record,) = mapping.images
    assert (record.path, record.sensor_id) == (ROBOTCAR[0], "rear")
    assert record.timestamp == 1417178853389469
    check_pose(mapping.pose(record), 0)
    assert [r.path for r in query.images] == [ROBOTCAR[1]]
    assert cameras(query) == [Camera("PINHOLE", 1024, 1024, (400.0, 400.0, 500.0, 510.0))]


def gone(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def other(name: str, *lines: str) -> Callable[[Path], None]:
    return lambda folder: write(folder / name, *lines)


AACHEN_NIGHT = "queries/night_time_queries_with_intrinsics.txt"
MODEL, INTRINSICS = "3D-models/aachen_cvpr2018_db.nvm", "3D-models/database_intrinsics.txt"
NO_NUMBER, TOO_FEW = (
    f"{NIGHT} SIMPLE_RADIAL 160 120 x 80 60 0",
    f"{NIGHT} SIMPLE_RADIAL 160 120 100",
)
OUTSIDE, TWICE = radial("../../etc/passwd", 100), (radial(NIGHT, 1), radial(NIGHT, 2))
TRUTH = "ground-truth-database-images-slice7.txt"
LEFT = "intrinsics/left_intrinsics.txt"


@pytest.mark.parametrize(
    ("name", "change", "code", "named"),
    [
        ("aachen", gone(AACHEN_NIGHT), "archive.missing", AACHEN_NIGHT),
        ("aachen", gone(f"images_upright/{NIGHT}"), "archive.missing", NIGHT),
        ("aachen", gone(MODEL), "archive.missing", "db.nvm"),
        ("aachen", other(MODEL, "BMV"), "import.line", "db.nvm"),
        ("aachen", other(MODEL, "NVM_V3", "3"), "import.*", "db.nvm"),
        ("aachen", other(INTRINSICS, radial(DATABASE[0], 1)), "archive.content", INTRINSICS),
        ("aachen", other(AACHEN_NIGHT, NO_NUMBER), "camera.syntax", NIGHT),
        ("aachen", other(AACHEN_NIGHT, TOO_FEW), "camera.param_count", NIGHT),
        ("aachen", other(AACHEN_NIGHT, OUTSIDE), "archive.content", AACHEN_NIGHT),
        ("aachen", other(AACHEN_NIGHT, *TWICE), "archive.content", AACHEN_NIGHT),
        ("cmu", gone(TRUTH), "archive.missing", TRUTH),
        ("cmu", gone("../intrinsics.txt"), "archive.missing", "intrinsics.txt"),
        ("cmu", gone(f"query/{CMU_QUERIES[0]}"), "archive.missing", CMU_QUERIES[0]),
        ("cmu", other(TRUTH, f"{CMU_DATABASE[0]} 1 0 0 0 1 2"), "archive.content", TRUTH),
        ("cmu", other(TRUTH, f"{CMU_DATABASE[0]} 0 0 0 0 1 2 3"), "archive.content", TRUTH),
        ("cmu", other(TRUTH, f"{CMU_DATABASE[0]} 1 0 0 0 1 2 nan"), "archive.content", TRUTH),
        ("cmu", other("test-images-slice7.txt", "img_1_c7_12us.jpg"), "archive.content", "test-"),
        ("robotcar", gone(LEFT), "archive.missing", LEFT),
        ("robotcar", other(LEFT, "fx 400", "fy 400", "cx"), "archive.content", LEFT),
        ("robotcar", other(LEFT, "fx 400", "fy 400", "cx 3"), "camera.param_count", LEFT),
        ("robotcar", gone(f"images/{ROBOTCAR[0]}"), "archive.missing", ROBOTCAR[0]),
        ("robotcar", gone(f"images/{ROBOTCAR[1]}"), "archive.missing", "images"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(
    name: str,
    change: Callable[[Path], None],
    code: str,
    named: str,
    request: pytest.FixtureRequest,
    tmp_path: Path,
) -> None:
    folder = request.getfixturevalue(name)
    change(folder)

    with pytest.raises((DatasetError, InvalidInput)) as caught:
        write_parts(name, folder, tmp_path / "out")

    assert caught.value.code.startswith(code.removesuffix("*"))
    assert named in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_aachen_v1_1_without_its_model_is_named(aachen: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="aachen_v_1_1"):
        write_parts("aachen-v1.1", aachen, tmp_path / "out")
