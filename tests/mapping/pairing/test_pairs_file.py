from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapping.pairing import Pairs, Scene, read_pairs, write_pairs
from visloc.errors import DatasetError

Make = Callable[..., Scene]
NAMES = ["left/1.jpg", "left/2.jpg", "right 1.jpg", "größe.jpg"]


@pytest.fixture
def scene(make_scene: Make) -> Scene:
    return make_scene(names=NAMES)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "pairs.txt"


def test_pairs_come_back_as_written(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "pairs.txt"
    pairs = Pairs(np.array([[0, 1], [0, 3], [2, 3]]), np.array([0.1 + 0.2, -1e-17, 1.0]))

    write_pairs(path, scene, pairs)

    read = read_pairs(path, scene)
    assert read.rows.tolist() == pairs.rows.tolist()
    assert read.scores.tolist() == pairs.scores.tolist()
    assert [file.name for file in path.parent.iterdir()] == ["pairs.txt"]


def test_a_name_with_a_comma_is_not_written(make_scene: Make, path: Path) -> None:
    scene = make_scene(names=["a,b.jpg", "c.jpg"])
    with pytest.raises(DatasetError) as caught:
        write_pairs(path, scene, Pairs(np.array([[0, 1]]), np.array([0.5])))
    assert caught.value.code == "kapture.field"
    assert not path.exists()


def test_files_are_written_as_kapture_does(scene: Scene, path: Path) -> None:
    write_pairs(path, scene, Pairs(np.array([[0, 2]]), np.array([0.5])))

    assert path.read_bytes() == b"# query_image, map_image, score\nleft/1.jpg, right 1.jpg, 0.5\n"


def test_no_pairs_are_legal(scene: Scene, path: Path) -> None:
    write_pairs(path, scene, Pairs(np.empty((0, 2), dtype=np.int64), np.empty(0)))

    read = read_pairs(path, scene)
    assert len(read) == 0
    assert read.rows.shape == (0, 2)


def test_other_peoples_files_are_read(scene: Scene, path: Path) -> None:
    path.write_bytes(
        "\ufeff# query_image, map_image, score\r\n"
        "\r\n"
        "left/2.jpg,left/1.jpg\r\n"
        "  # a comment\r\n"
        "größe.jpg ,  right 1.jpg, 2e-1\r\n"
        "left\\1.jpg, ./größe.jpg, 3".encode()
    )

    pairs = read_pairs(path, scene)

    assert pairs.rows.tolist() == [[0, 1], [0, 3], [2, 3]]
    assert pairs.scores.tolist() == [1.0, 3.0, 0.2]


def test_hlocs_files_are_read(scene: Scene, path: Path) -> None:
    path.write_text("left/1.jpg left/2.jpg\nleft/2.jpg\tgröße.jpg 0.25\n")

    pairs = read_pairs(path, scene)

    assert pairs.rows.tolist() == [[0, 1], [1, 3]]
    assert pairs.scores.tolist() == [1.0, 0.25]


def test_a_pair_given_again_in_either_order_keeps_its_best_score(scene: Scene, path: Path) -> None:
    path.write_text(
        "left/1.jpg, left/2.jpg, 0.3\nleft/2.jpg, left/1.jpg, 0.7\nleft/1.jpg, left/2.jpg, 0.5\n"
    )

    pairs = read_pairs(path, scene)

    assert pairs.rows.tolist() == [[0, 1]]
    assert pairs.scores.tolist() == [0.7]


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("left/1.jpg, left/3.jpg, 1", "pairs.unknown_photo"),
        ("LEFT/1.jpg, left/2.jpg, 1", "pairs.unknown_photo"),
        (", left/2.jpg, 1", "pairs.unknown_photo"),
        ("/etc/passwd, left/2.jpg, 1", "pairs.unknown_photo"),
        ("../left/1.jpg, left/2.jpg, 1", "pairs.unknown_photo"),
        ("left/1.jpg", "pairs.column_count"),
        ("left/1.jpg left/2.jpg 0.5 1", "pairs.column_count"),
        ("left/1.jpg left/2.jpg x", "kapture.number"),
        ("left/1.jpg left/9.jpg", "pairs.unknown_photo"),
        ("left/1.jpg, left/2.jpg, 1, 2", "pairs.column_count"),
        ("left/1.jpg, left/1.jpg, 1", "pairs.same_photo"),
        ("left/1.jpg, left/./1.jpg, 1", "pairs.same_photo"),
        ("left/1.jpg, left/2.jpg, nan", "kapture.number"),
        ("left/1.jpg, left/2.jpg, inf", "kapture.number"),
        ("left/1.jpg, left/2.jpg, good", "kapture.number"),
        ("left/1.jpg, left/2.jpg,", "kapture.number"),
    ],
)
def test_bad_lines_are_refused_with_file_and_line(
    scene: Scene, path: Path, line: str, code: str
) -> None:
    path.write_text(f"# pairs\nleft/1.jpg, left/2.jpg, 1\n{line}\n")

    with pytest.raises(DatasetError) as caught:
        read_pairs(path, scene)

    assert caught.value.code == code
    assert caught.value.field == f"{path}:3"


def test_files_that_cannot_be_read_are_named(scene: Scene, path: Path) -> None:
    with pytest.raises(DatasetError, match=r"pairs\.txt") as missing:
        read_pairs(path, scene)
    path.mkdir()
    with pytest.raises(DatasetError, match=r"pairs\.txt") as folder:
        read_pairs(path, scene)

    assert {missing.value.code, folder.value.code} == {"kapture.unreadable"}


def test_files_that_are_no_text_are_refused(scene: Scene, path: Path) -> None:
    path.write_bytes(b"left/1.jpg, left/2.jpg, 1\n\xff\xfe\x00")

    with pytest.raises(DatasetError) as caught:
        read_pairs(path, scene)

    assert caught.value.code == "kapture.encoding"
