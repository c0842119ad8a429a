"""A small folder in the layout of 7-Scenes."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from visloc.errors import Conflict, DatasetError, InvalidInput
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc_extensions.research.datasets import write_parts

TRUTH = Pose.from_quaternion((0.9, 0.1, -0.3, 0.2), (1.0, -2.0, 0.5))  # world_from_depth


def matrix_text(pose: Pose) -> str:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation
    # As published: tabs, and seven digits.
    return "".join("\t ".join(f"{value:.7e}" for value in row) + "\t \n" for row in matrix)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "chess"
    folder.mkdir()
    (folder / "TrainSplit.txt").write_text("sequence1\r\nsequence2\r\n")
    (folder / "TestSplit.txt").write_text("sequence10\n")
    for sequence, frames in (("seq-01", 2), ("seq-02", 1), ("seq-10", 1)):
        (folder / sequence).mkdir()
        for number in range(frames):
            stem = folder / sequence / f"frame-{number:06}"
            Image.new("RGB", (640, 480)).save(f"{stem}.color.png")
            depth = np.full((480, 640), 2000, np.uint16)
            depth[:, :100] = 65535
            Image.fromarray(depth).save(f"{stem}.depth.png")
            Path(f"{stem}.pose.txt").write_text(matrix_text(TRUTH))
        (folder / sequence / "Thumbs.db").write_bytes(b"")
    return folder


def test_the_split_is_the_authors_and_photos_are_links(scene: Path, tmp_path: Path) -> None:
    parts = write_parts("7scenes", scene, tmp_path / "out")
    assert {part: len(made.images) for part, made in parts.items()} == {"mapping": 3, "query": 1}

    mapping, query = (read_dataset(tmp_path / "out" / name) for name in ("mapping", "query"))
    assert [record.path for record in mapping.images] == [
        *("seq-01/frame-000000.color.png", "seq-01/frame-000001.color.png"),
        "seq-02/frame-000000.color.png",
    ]
    assert [record.path for record in query.images] == ["seq-10/frame-000000.color.png"]
    for dataset in (mapping, query):
        assert all(dataset.has_file(record) for record in (*dataset.images, *dataset.depth_maps))
        assert (dataset.root / "sensors" / "records_data").is_symlink()
    (record,) = query.depth_maps
    depth_from_world = query.pose(record)
    assert depth_from_world is not None
    np.testing.assert_allclose(depth_from_world.center, TRUTH.translation, atol=1e-6)
    np.testing.assert_allclose(depth_from_world.rotation, TRUTH.rotation.T, atol=1e-6)
    colour = query.pose(query.images[0])
    assert colour is not None
    # The colour camera of a Kinect sits 2.6 cm to the right of the depth camera.
    offset = depth_from_world.apply(colour.center)
    assert offset == pytest.approx([0.0256, 0, 0], abs=0.003)


def test_real_frames_get_the_poses_of_the_published_copy(shared_data: Path, tmp_path: Path) -> None:
    """Six frames of red kitchen, as a recorder wrote them, in the archive's layout."""
    recorded = read_dataset(shared_data / "import_samples" / "rgbd_png")
    folder = tmp_path / "redkitchen"
    (folder / "seq-01").mkdir(parents=True)
    (folder / "TrainSplit.txt").write_text("sequence1\n")
    (folder / "TestSplit.txt").write_text("sequence1\n")
    for record, depth in zip(recorded.images, recorded.depth_maps, strict=True):
        stem = folder / record.path.removesuffix(".color.jpg")
        Image.open(recorded.path_of(record)).save(f"{stem}.color.png")
        shutil.copy(recorded.path_of(depth), f"{stem}.depth.png")
        world_from_depth = recorded.trajectories[record.timestamp, "kinect"].inverse()
        Path(f"{stem}.pose.txt").write_text(matrix_text(world_from_depth))

    made = write_parts("7scenes", folder, tmp_path / "out")["mapping"]

    assert made.sensors["kinect_rgb"].camera == recorded.sensors["kinect_rgb"].camera
    assert made.sensors["kinect_depth"].camera == recorded.sensors["kinect_depth"].camera
    for ours, theirs in zip(made.images, recorded.images, strict=True):
        found, published = made.pose(ours), recorded.pose(theirs)
        assert found is not None
        assert published is not None
        np.testing.assert_allclose(found.rotation, published.rotation, atol=1e-6)
        np.testing.assert_allclose(found.translation, published.translation, atol=1e-6)


def test_existing_output_stays(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(Conflict):
        write_parts("7scenes", scene, tmp_path / "out")


def test_other_sets_are_refused_by_name(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput) as caught:
        write_parts("8scenes", scene, tmp_path / "out")
    assert (caught.value.code, caught.value.got) == ("archive.unknown", "8scenes")


def test_inloc_is_refused_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="kapture's copy of InLoc") as caught:
        write_parts("inloc", tmp_path, tmp_path / "out")
    assert caught.value.code == "archive.unknown"


def remove(name: str) -> Callable[[Path], None]:
    return lambda scene: (scene / name).unlink()


def write(name: str, text: str) -> Callable[[Path], None]:
    def change(scene: Path) -> None:
        (scene / name).write_text(text)

    return change


def zipped(scene: Path) -> None:
    (scene / "seq-10").rename(scene / "elsewhere")
    (scene / "seq-10.zip").write_bytes(b"PK")


POSE = "seq-01/frame-000001.pose.txt"


@pytest.mark.parametrize(
    ("damage", "code", "file"),
    [
        (remove("TestSplit.txt"), "archive.missing", "TestSplit.txt"),
        (write("TestSplit.txt", ""), "archive.content", "TestSplit.txt"),
        (write("TestSplit.txt", "seq-10\n"), "archive.content", "TestSplit.txt"),
        (write("TestSplit.txt", "sequence4\n"), "archive.missing", "seq-04"),
        (zipped, "archive.missing", "seq-10"),
        (remove(POSE), "archive.missing", POSE),
        (remove("seq-02/frame-000000.depth.png"), "archive.missing", "frame-000000.depth.png"),
        (remove("seq-02/frame-000000.color.png"), "archive.missing", "seq-02"),
        (write(POSE, "1 0 0 0\n"), "archive.content", POSE),
        (write(POSE, matrix_text(TRUTH).replace("e", "x")), "archive.content", POSE),
        (write(POSE, "nan 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"), "archive.content", POSE),
        (write(POSE, "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"), "archive.content", POSE),
        (write(POSE, "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"), "archive.content", POSE),
        (write(POSE, "1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1"), "archive.content", POSE),
    ],
)
def test_a_bad_archive_is_refused_with_the_file(
    scene: Path, tmp_path: Path, damage: Callable[[Path], None], code: str, file: str
) -> None:
    damage(scene)
    with pytest.raises(DatasetError) as caught:
        write_parts("7scenes", scene, tmp_path / "out")
    assert caught.value.code == code
    assert (caught.value.field or "").endswith(file)
    assert not (tmp_path / "out").exists()
