"""A small folder in the layout of Cambridge Landmarks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from visloc.errors import DatasetError
from visloc.geometry import Camera
from visloc.kapture import read_dataset
from visloc_extensions.research.datasets import write_parts

HEADING = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
PHOTOS = ("seq1/frame00001.png", "seq1/frame00002.png", "seq3/frame00001.png")
FOCAL_LENGTHS = (1670.5, 1668.25, 1700.0)


def pose(seed: int) -> tuple[np.ndarray, Rotation]:
    rng = np.random.default_rng(seed)
    return rng.normal(scale=20, size=3), Rotation.random(random_state=rng)


def line(name: str, seed: int) -> str:
    center, rotation = pose(seed)
    x, y, z, w = rotation.as_quat()
    return " ".join([name, *(f"{float(value):.6f}" for value in (*center, w, x, y, z))]) + "\n"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "KingsCollege"
    for name in PHOTOS:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (192, 108)).save(folder / name)
    (folder / "dataset_train.txt").write_text(HEADING + line(PHOTOS[0], 0) + line(PHOTOS[1], 1))
    (folder / "dataset_test.txt").write_text(HEADING + line(PHOTOS[2], 2))
    cameras = "".join(
        f"{name.replace('.png', '.jpg')}\t{focal} 1 0 0 0 0 0 0 -0.05 0 \n"
        for name, focal in zip(PHOTOS, FOCAL_LENGTHS, strict=True)
    )
    (folder / "reconstruction.nvm").write_text(f"NVM_V3 \n\n3\n{cameras}\n\n0\n")
    return folder


def test_lists_and_focal_lengths_become_datasets(scene: Path, tmp_path: Path) -> None:
    write_parts("cambridge", scene, tmp_path / "out")

    mapping, query = (read_dataset(tmp_path / "out" / name) for name in ("mapping", "query"))
    found = [(dataset, record) for dataset in (mapping, query) for record in dataset.images]
    assert [record.path for _, record in found] == list(PHOTOS)
    for seed, (dataset, record) in enumerate(found):
        assert dataset.has_file(record)
        camera = dataset.sensors[record.sensor_id].camera
        assert camera == Camera("SIMPLE_PINHOLE", 192, 108, (FOCAL_LENGTHS[seed], 96.0, 54.0))
        center, rotation = pose(seed)
        cam_from_world = dataset.pose(record)
        assert cam_from_world is not None
        np.testing.assert_allclose(cam_from_world.center, center, atol=1e-4)
        np.testing.assert_allclose(cam_from_world.rotation, rotation.as_matrix(), atol=1e-5)


def test_poses_beyond_the_scene_are_left_out_and_told(scene: Path, tmp_path: Path) -> None:
    with (scene / "dataset_train.txt").open("a") as file:
        file.write("seq9/lost.png 1e6 0 0 1 0 0 0\n")
    made = write_parts("cambridge", scene, tmp_path / "out")["mapping"]
    assert len(made.images) == 2
    assert made.notes[0].startswith("1 photos beyond")


def append(name: str, text: str) -> Callable[[Path], None]:
    def change(scene: Path) -> None:
        with (scene / name).open("a") as file:
            file.write(text)

    return change


def remove(name: str) -> Callable[[Path], None]:
    return lambda scene: (scene / name).unlink()


def write(name: str, text: str) -> Callable[[Path], None]:
    return lambda scene: (scene / name).write_text(text) and None


@pytest.mark.parametrize(
    ("damage", "code", "named"),
    [
        (remove("dataset_test.txt"), "archive.missing", "dataset_test.txt"),
        (remove("reconstruction.nvm"), "archive.missing", "reconstruction.nvm"),
        (remove(PHOTOS[0]), "archive.missing", PHOTOS[0]),
        (write(PHOTOS[0], "no picture"), "archive.content", PHOTOS[0]),
        (write("dataset_test.txt", HEADING), "archive.content", "dataset_test.txt"),
        (write("reconstruction.nvm", "BUNDLE\n3\n"), "archive.content", "reconstruction.nvm"),
        (write("reconstruction.nvm", "NVM_V3\nx\n"), "archive.content", "reconstruction.nvm"),
        (append("dataset_test.txt", "a.png 1 2 3 1 0 0\n"), "archive.content", "a.png"),
        (append("dataset_test.txt", "a.png 1 2 nan 1 0 0 0\n"), "archive.content", "a.png"),
        (append("dataset_test.txt", "a.png 1 2 3 0 0 0 0\n"), "archive.content", "a.png"),
        (append("dataset_test.txt", "a.png 1 2 3 1 0 0 x\n"), "archive.content", "a.png"),
        (append("dataset_test.txt", "a.png 1 2 3 1 0 0 0\n"), "archive.missing", ".nvm"),
        (append("dataset_train.txt", f"{PHOTOS[0]} 1 2 3 1 0 0 0\n"), "archive.content", PHOTOS[0]),
    ],
)
def test_a_bad_archive_is_refused_with_the_file(
    scene: Path, tmp_path: Path, damage: Callable[[Path], None], code: str, named: str
) -> None:
    damage(scene)
    with pytest.raises(DatasetError) as caught:
        write_parts("cambridge", scene, tmp_path / "out")
    assert caught.value.code == code
    assert (caught.value.field or "").endswith(named)
    assert not (tmp_path / "out").exists()
