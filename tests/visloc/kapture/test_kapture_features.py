from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from visloc.errors import Conflict, DatasetError, InvalidInput
from visloc.kapture import write_global_features, write_local_features

# The first row has the bytes that a published sample has.
KEYPOINTS = np.array(
    [[866.0223388671875, 340.1762084960938, 76.1092529296875], [1.5, 2.5, 32.0]], dtype=np.float32
)
DESCRIPTORS = np.eye(2, 4, dtype=np.float32)


def test_local_features_lie_where_other_tools_look(tmp_path: Path) -> None:
    write_local_features(tmp_path, "r2d2_500", "a/b.jpg", KEYPOINTS, DESCRIPTORS, name="r2d2")
    folder = tmp_path / "reconstruction"
    assert sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()) == [
        "descriptors/r2d2_500/a/b.jpg.desc",
        "descriptors/r2d2_500/descriptors.txt",
        "keypoints/r2d2_500/a/b.jpg.kpt",
        "keypoints/r2d2_500/keypoints.txt",
    ]
    keypoints = (folder / "keypoints/r2d2_500/a/b.jpg.kpt").read_bytes()
    assert keypoints[:12] == bytes.fromhex("6e815844 8e16aa43 f0379842")
    assert len(keypoints) == 24
    assert (folder / "descriptors/r2d2_500/a/b.jpg.desc").read_bytes() == DESCRIPTORS.tobytes()
    assert (folder / "keypoints/r2d2_500/keypoints.txt").read_text() == (
        "# kapture format: 1.1\n# name, dtype, dsize\nr2d2, float32, 3\n"
    )
    assert (folder / "descriptors/r2d2_500/descriptors.txt").read_text().splitlines()[1:] == [
        "# name, dtype, dsize, keypoints_type, metric_type",
        "r2d2, float32, 4, r2d2_500, L2",
    ]


def test_global_features_are_one_row(tmp_path: Path) -> None:
    vector = np.arange(5, dtype=np.float32)
    write_global_features(tmp_path, "vlad", "b.jpg", vector, name="vlad")
    folder = tmp_path / "reconstruction" / "global_features" / "vlad"
    assert (folder / "b.jpg.gfeat").read_bytes() == vector.tobytes()
    assert (folder / "global_features.txt").read_text().splitlines()[1:] == [
        "# name, dtype, dsize, metric_type",
        "vlad, float32, 5, L2",
    ]


def test_numbers_are_little_endian_whatever_they_were(tmp_path: Path) -> None:
    vector = np.array([1.0, 2.0], dtype=">f8")
    write_global_features(tmp_path, "t", "b.jpg", vector, name="n")
    path = tmp_path / "reconstruction" / "global_features" / "t" / "b.jpg.gfeat"
    assert np.fromfile(path, dtype="<f8").tolist() == [1.0, 2.0]


def test_an_image_without_keypoints_has_empty_files(tmp_path: Path) -> None:
    write_local_features(tmp_path, "t", "b.jpg", KEYPOINTS[:0], DESCRIPTORS[:0], name="n")
    folder = tmp_path / "reconstruction"
    assert (folder / "keypoints/t/b.jpg.kpt").read_bytes() == b""
    assert (folder / "descriptors/t/b.jpg.desc").read_bytes() == b""


def test_writing_again_replaces_the_image_and_keeps_the_declaration(tmp_path: Path) -> None:
    for count in (2, 1):
        write_local_features(
            tmp_path, "t", "b.jpg", KEYPOINTS[:count], DESCRIPTORS[:count], name="n"
        )
    folder = tmp_path / "reconstruction" / "keypoints" / "t"
    assert sorted(path.name for path in folder.iterdir()) == ["b.jpg.kpt", "keypoints.txt"]
    assert (folder / "b.jpg.kpt").stat().st_size == 12


def test_features_of_another_kind_are_refused(tmp_path: Path) -> None:
    write_local_features(tmp_path, "t", "a.jpg", KEYPOINTS, DESCRIPTORS, name="n")
    for keypoints, descriptors, name in (
        (KEYPOINTS[:, :2], DESCRIPTORS, "n"),
        (KEYPOINTS, DESCRIPTORS.astype(np.uint8), "n"),
        (KEYPOINTS, DESCRIPTORS, "other"),
    ):
        with pytest.raises(Conflict) as caught:
            write_local_features(tmp_path, "t", "b.jpg", keypoints, descriptors, name=name)
        assert caught.value.code == "kapture.feature_type"
        assert caught.value.field is not None
        assert caught.value.field.endswith(".txt")
    assert not list(tmp_path.rglob("b.jpg.desc"))


@pytest.mark.parametrize(
    ("keypoints", "descriptors"),
    [
        (KEYPOINTS, DESCRIPTORS[:1]),
        (KEYPOINTS[:, :1], DESCRIPTORS),
        (KEYPOINTS[0], DESCRIPTORS[0]),
        (KEYPOINTS, DESCRIPTORS[:, :0]),
        (KEYPOINTS, DESCRIPTORS.astype(np.float16)),
        (KEYPOINTS, DESCRIPTORS.astype(object)),
    ],
)
def test_arrays_that_kapture_cannot_hold_are_refused(
    tmp_path: Path, keypoints: np.ndarray, descriptors: np.ndarray
) -> None:
    with pytest.raises(InvalidInput) as caught:
        write_local_features(tmp_path, "t", "a.jpg", keypoints, descriptors, name="n")
    assert caught.value.code == "kapture.features"


@pytest.mark.parametrize("path", ["../a.jpg", "/a.jpg", ""])
def test_images_outside_the_dataset_are_refused(tmp_path: Path, path: str) -> None:
    with pytest.raises(DatasetError) as caught:
        write_global_features(tmp_path, "t", path, np.ones(2), name="n")
    assert caught.value.code == "kapture.path"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("feature_type", "name"),
    [("..", "n"), ("a/b", "n"), ("", "n"), ("a,b", "n"), ("t", "a,b"), ("t", ""), ("t", "#")],
)
def test_names_that_kapture_cannot_hold_are_refused(
    tmp_path: Path, feature_type: str, name: str
) -> None:
    with pytest.raises(DatasetError) as caught:
        write_global_features(tmp_path, feature_type, "a.jpg", np.ones(2), name=name)
    assert caught.value.code == "kapture.field"
