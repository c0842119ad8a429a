from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from clients.evaluation.queries import read_queries
from visloc.errors import DatasetError, InvalidInput
from visloc.geometry import Camera


@pytest.fixture
def write_list(tmp_path: Path) -> Callable[[str | bytes], Path]:
    def write(text: str | bytes) -> Path:
        path = tmp_path / "photos.txt"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_a_list_gives_names_paths_and_cameras_in_its_order(
    write_list: Callable[[str], Path],
) -> None:
    path = write_list(
        "\ufeff# photos\r\n"
        "b/2.jpg PINHOLE 640 480 525 525.5 320 240\n"
        "\n"
        "  a/1.jpg\n"
        "c.jpg UNKNOWN_CAMERA 640 480\n"
    )

    queries = read_queries(path).photos

    assert [query.name for query in queries] == ["b/2.jpg", "a/1.jpg", "c.jpg"]
    assert queries[0].path == path.parent / "b/2.jpg"
    assert queries[0].camera == Camera("PINHOLE", 640, 480, (525.0, 525.5, 320.0, 240.0))
    assert queries[1].camera is None
    assert queries[2].camera is None
    assert all(query.truth is None for query in queries)


def test_lists_of_a_pattern_are_one_with_names_below_the_image_root(tmp_path: Path) -> None:
    (tmp_path / "queries").mkdir()
    for name, line in (
        ("night", "query/n.jpg PINHOLE 640 480 5 5 3 2\n"),
        ("day", "query/d.jpg\n"),
    ):
        (tmp_path / "queries" / f"{name}_with_intrinsics.txt").write_text(line)
    (tmp_path / "queries" / "other.txt").write_text("not a list\n")
    root = tmp_path / "images_upright"
    with pytest.raises(DatasetError, match="images_upright") as caught:
        read_queries(tmp_path / "queries" / "*_with_intrinsics.txt", image_root=root)
    assert caught.value.code == "queries.missing"
    root.mkdir()

    queries = read_queries(tmp_path / "queries" / "*_with_intrinsics.txt", image_root=root)

    assert [photo.name for photo in queries.photos] == ["query/d.jpg", "query/n.jpg"]
    assert [photo.path for photo in queries.photos] == [root / "query/d.jpg", root / "query/n.jpg"]
    (tmp_path / "queries" / "z_with_intrinsics.txt").write_text("query/d.jpg\n")
    with pytest.raises(DatasetError) as caught:
        read_queries(tmp_path / "queries" / "*_with_intrinsics.txt")
    assert caught.value.code == "list.duplicate"


def test_a_kapture_folder_has_no_image_root(make_dataset: Callable[..., Path]) -> None:
    with pytest.raises(InvalidInput) as caught:
        read_queries(make_dataset({"a.jpg": b""}), image_root=Path())
    assert caught.value.code == "queries.image_root"


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("b.jpg PINHOLE 640 480 525", "camera.param_count"),
        ("b.jpg PINHOLE 640 480 nan 525 320 240", "camera.param_value"),
        ("b.jpg PINHOLE 640 480 -1 525 320 240", "camera.param_value"),
        ("b.jpg PINHOLE wide 480 525 525 320 240", "camera.syntax"),
        ("b.jpg PINHOLE 0 480 525 525 320 240", "camera.size"),
        ("b.jpg FISHEYE9 640 480", "camera.model"),
        ("my photo.jpg", "camera.syntax"),
        ("b.jpg UNKNOWN_CAMERA 640", "camera.param_count"),
        ("../b.jpg", "list.path"),
        ("/etc/passwd", "list.path"),
        ("a\x00.jpg", "list.path"),
        ("./a.jpg", "list.duplicate"),
    ],
)
def test_a_bad_line_is_named_by_file_and_line(
    line: str, code: str, write_list: Callable[[str], Path]
) -> None:
    path = write_list(f"a.jpg\n# comment\n{line}\n")
    with pytest.raises(DatasetError) as caught:
        read_queries(path)
    assert caught.value.code == code
    assert caught.value.field == f"{path}:3"


def test_a_photo_given_as_a_list_is_refused(write_list: Callable[[bytes], Path]) -> None:
    with pytest.raises(DatasetError) as caught:
        read_queries(write_list(b"\xff\xd8\xff\xe0\x00\x10JFIF"))
    assert caught.value.code == "list.unreadable"


def test_a_list_without_photos_is_refused(write_list: Callable[[str], Path]) -> None:
    with pytest.raises(DatasetError) as caught:
        read_queries(write_list("# nothing\n"))
    assert caught.value.code == "queries.empty"


def test_nothing_at_the_path_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        read_queries(tmp_path / "none")
    assert caught.value.code == "queries.missing"


def test_a_folder_that_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        read_queries(tmp_path)
    assert caught.value.code == "kapture.no_dataset"


def test_a_dataset_without_photos_is_refused(make_dataset: Callable[..., Path]) -> None:
    with pytest.raises(DatasetError) as caught:
        read_queries(make_dataset({}))
    assert caught.value.code == "queries.empty"


def test_a_dataset_gives_cameras_and_true_poses(make_dataset: Callable[..., Path]) -> None:
    root = make_dataset({"seq 1/ä.jpg": b"photo"})
    (query,) = read_queries(root).photos
    assert query.name == "seq 1/ä.jpg"
    assert query.path.read_bytes() == b"photo"
    assert query.camera == Camera("SIMPLE_PINHOLE", 64, 48, (60.0, 32.0, 24.0))
    assert query.truth is not None
    assert query.truth.translation[0] == 0.24164110554685916


def test_an_unknown_camera_is_not_sent(make_dataset: Callable[..., Path]) -> None:
    (query,) = read_queries(make_dataset({"a.jpg": b""}, camera="UNKNOWN_CAMERA, 64, 48")).photos
    assert query.camera is None


def test_a_rig_gives_the_pose_of_its_camera(shared_data: Path) -> None:
    queries = read_queries(shared_data / "redkitchen" / "query").photos
    assert len(queries) == 39
    # The camera sits 2.6 cm beside the rig's origin, turned by under a degree (rigs.txt).
    first = queries[0].truth
    assert first is not None
    np.testing.assert_allclose(first.translation, [0.2155, 0.3504, -0.9345], atol=0.02)
