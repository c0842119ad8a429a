from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visloc.errors import Conflict, DatasetError, InvalidInput
from visloc.kapture import (
    Reconstruction,
    read_reconstruction,
    write_local_features,
    write_reconstruction,
)

HEAD = "# kapture format: 1.1\n# columns\n"


def example(num_points: int = 5, num_images: int = 3, seed: int = 0) -> Reconstruction:
    rng = np.random.default_rng(seed)
    num_observations = 4 * num_points if num_images else 0
    return Reconstruction(
        points=rng.normal(size=(num_points, 3)) * 10.0 ** rng.integers(-9, 9, (num_points, 1)),
        colors=rng.integers(0, 256, (num_points, 3)).astype(np.uint8),
        keypoints_type="sift",
        images=tuple(f"map ping/{i}.jpg" for i in range(num_images)),
        observations=np.stack(
            [
                rng.integers(0, limit, num_observations)
                for limit in (max(num_points, 1), max(num_images, 1), 1000)
            ],
            axis=1,
        ),
    )


def named(r: Reconstruction) -> list[tuple[int, str, int]]:
    return sorted((p, r.images[i], k) for p, i, k in r.observations.tolist())


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 20), st.integers(0, 4), st.integers(0, 99), st.booleans())
def test_what_was_written_is_read(
    tmp_path_factory: pytest.TempPathFactory,
    num_points: int,
    num_images: int,
    seed: int,
    colored: bool,
) -> None:
    root = tmp_path_factory.mktemp("dataset")
    written = example(num_points, num_images, seed)
    if not colored:
        written = replace(written, colors=None)
    write_reconstruction(root, written)
    back = read_reconstruction(root)
    assert back is not None
    assert np.array_equal(back.points, written.points)
    if colored and num_points:
        assert back.colors is not None
        assert np.array_equal(back.colors, written.colors)
    else:
        assert back.colors is None
    assert named(back) == named(written)
    assert back.observations.dtype == np.int64
    assert back.keypoints_type == ("sift" if len(written.observations) else None)


def test_the_files_are_as_other_tools_write_them(tmp_path: Path) -> None:
    write_reconstruction(
        tmp_path,
        Reconstruction(
            np.array([[1.5, 2.0, -3.25], [0.0, 0.0, 1e-7], [4.0, 5.0, 6.0]]),
            np.array([[1, 2, 3], [0, 0, 255], [9, 9, 9]], dtype=np.uint8),
            "sift",
            ("db/a.jpg", "db/b.jpg"),
            np.array([[2, 0, 7], [0, 1, 4], [2, 0, 8], [2, 1, 0]]),
        ),
    )
    folder = tmp_path / "reconstruction"
    assert sorted(path.name for path in folder.iterdir()) == ["observations.txt", "points3d.txt"]
    assert (folder / "points3d.txt").read_text() == (
        "# kapture format: 1.1\n# X, Y, Z, R, G, B\n"
        "1.5, 2.0, -3.25, 1, 2, 3\n0.0, 0.0, 1e-07, 0, 0, 255\n4.0, 5.0, 6.0, 9, 9, 9\n"
    )
    assert (folder / "observations.txt").read_text() == (
        "# kapture format: 1.1\n# point3d_id, keypoints_type, [image_path, feature_id]*\n"
        "0, sift, db/b.jpg, 4\n2, sift, db/a.jpg, 7, db/a.jpg, 8, db/b.jpg, 0\n"
    )


def test_no_reconstruction_is_overwritten(tmp_path: Path) -> None:
    write_reconstruction(tmp_path, example())
    with pytest.raises(Conflict) as caught:
        write_reconstruction(tmp_path, example(seed=1))
    assert caught.value.code == "kapture.exists"


@pytest.mark.parametrize(
    "change",
    [
        {"points": np.zeros((5, 2))},
        {"points": np.zeros((5, 3), dtype=np.float32)},
        {"points": np.full((5, 3), np.nan)},
        {"colors": np.zeros((4, 3), dtype=np.uint8)},
        {"colors": np.zeros((5, 3))},
        {"observations": np.array([[5, 0, 0]])},
        {"observations": np.array([[0, 3, 0]])},
        {"observations": np.array([[0, 0, -1]])},
        {"observations": np.array([[0.0, 0.0, 1.0]])},
        {"observations": np.zeros((0,), dtype=np.int64)},
        {"keypoints_type": None},
        {"images": ("a.jpg", "a.jpg", "b.jpg")},
    ],
)
def test_arrays_that_do_not_fit_are_not_written(tmp_path: Path, change: dict[str, object]) -> None:
    with pytest.raises(InvalidInput) as caught:
        write_reconstruction(tmp_path, replace(example(), **change))  # type: ignore[arg-type]
    assert caught.value.code == "kapture.reconstruction"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "change",
    [
        {"images": ("a,b.jpg", "b", "c")},
        {"images": ("../a.jpg", "b", "c")},
        {"images": ("a//a.jpg", "b", "c")},
        {"images": ("a\n.jpg", "b", "c")},
        {"keypoints_type": "a,b"},
        {"keypoints_type": ""},
    ],
)
def test_names_that_kapture_cannot_hold_are_not_written(
    tmp_path: Path, change: dict[str, object]
) -> None:
    with pytest.raises(DatasetError) as caught:
        write_reconstruction(tmp_path, replace(example(), **change))  # type: ignore[arg-type]
    assert caught.value.code == "kapture.field"
    assert list(tmp_path.iterdir()) == []


def write_text(root: Path, points: str, observations: str | None = None) -> None:
    folder = root / "reconstruction"
    folder.mkdir(exist_ok=True)
    (folder / "points3d.txt").write_text(HEAD + points)
    if observations is not None:
        (folder / "observations.txt").write_text(HEAD + observations)


def test_a_dataset_without_points_has_none(tmp_path: Path) -> None:
    assert read_reconstruction(tmp_path) is None


def test_observations_of_missing_points_are_refused(tmp_path: Path) -> None:
    write_text(tmp_path, "0,0,1\n", "0, sift, a.jpg, 0\n")
    (tmp_path / "reconstruction/points3d.txt").unlink()
    with pytest.raises(DatasetError, match="observed points are missing"):
        read_reconstruction(tmp_path)


def test_an_image_can_see_a_point_several_times_and_its_path_is_normalized(tmp_path: Path) -> None:
    write_text(
        tmp_path, "0,0,1\n", "0, sift, db/1.jpg, 0, ./db//1.jpg, 1, db/2.jpg, 0, db/1.jpg, 2\n"
    )
    read = read_reconstruction(tmp_path)
    assert read is not None
    assert read.images == ("db/1.jpg", "db/2.jpg")
    assert read.observations.tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 0, 2]]


def test_one_of_several_types_must_be_named(tmp_path: Path) -> None:
    write_text(tmp_path, "0,0,1\n", "0, sift, a.jpg, 3\n0, r2d2, a.jpg, 4\n")
    with pytest.raises(DatasetError, match=r"observations\.txt:4.*sift or r2d2") as caught:
        read_reconstruction(tmp_path)
    assert caught.value.code == "kapture.keypoints_type"
    read = read_reconstruction(tmp_path, "r2d2")
    assert read is not None
    assert read.keypoints_type == "r2d2"
    assert read.observations.tolist() == [[0, 0, 4]]
    with pytest.raises(DatasetError, match="sift or r2d2"):
        read_reconstruction(tmp_path, "xfeat")


@pytest.mark.parametrize(
    ("points", "where", "code"),
    [
        ("0, 0\n", "points3d.txt:3", "kapture.column_count"),
        ("0, 0, 1\n0, 0, 1, 2, 3, 4\n", "points3d.txt:4", "kapture.column_count"),
        ("0, 0, nan\n", "points3d.txt:3", "kapture.number"),
        ("0, 0, 1_0\n", "points3d.txt:3", "kapture.number"),
        ("0, 0, x\n", "points3d.txt:3", "kapture.number"),
        ("0, 0, 1, 0, 0, 256\n", "points3d.txt:3", "kapture.color"),
        ("0, 0, 1, -1, 0, 0\n", "points3d.txt:3", "kapture.color"),
    ],
)
def test_points_that_cannot_be_are_refused_with_their_line(
    tmp_path: Path, points: str, where: str, code: str
) -> None:
    write_text(tmp_path, points)
    with pytest.raises(DatasetError) as caught:
        read_reconstruction(tmp_path)
    assert (caught.value.field, caught.value.code) == (f"reconstruction/{where}", code)


@pytest.mark.parametrize(
    ("observations", "code"),
    [
        ("1, sift, a.jpg, 0\n", "kapture.index"),
        ("-1, sift, a.jpg, 0\n", "kapture.index"),
        ("x, sift, a.jpg, 0\n", "kapture.index"),
        ("0, sift, a.jpg, -1\n", "kapture.index"),
        ("0, sift, a.jpg, 1.5\n", "kapture.index"),
        ("0, sift, a.jpg, \n", "kapture.index"),
        ("0, sift, a.jpg, 1_0\n", "kapture.index"),
        ("0, sift, a.jpg, ٣\n", "kapture.index"),
        ("0, sift, a.jpg, " + "9" * 10_000 + "\n", "kapture.index"),
        ("0, sift, a.jpg, 2147483648\n", "kapture.index"),
        ("0, a.jpg, 0\n", "kapture.column_count"),
        ("0\n", "kapture.column_count"),
        ("0, sift, ../a.jpg, 0\n", "kapture.path"),
        ("0, sift, , 0\n", "kapture.path"),
        ("0, sift, a.jpg, 0\n0, sift, b.jpg, 0\n", "kapture.duplicate"),
    ],
)
def test_observations_that_cannot_be_are_refused_with_their_line(
    tmp_path: Path, observations: str, code: str
) -> None:
    write_text(tmp_path, "0, 0, 1\n", observations)
    with pytest.raises(DatasetError) as caught:
        read_reconstruction(tmp_path)
    line = 2 + observations.count("\n")
    assert caught.value.code == code
    assert caught.value.field == f"reconstruction/observations.txt:{line}"


def test_keypoints_that_an_image_lacks_are_refused(tmp_path: Path) -> None:
    write_local_features(tmp_path, "sift", "a.jpg", np.ones((3, 2)), np.ones((3, 4)), name="sift")
    write_text(tmp_path, "0, 0, 1\n0, 1, 1\n", "0, sift, a.jpg, 2, other.jpg, 9\n")
    read = read_reconstruction(tmp_path)
    assert read is not None
    assert len(read.observations) == 2
    write_text(tmp_path, "0, 0, 1\n0, 1, 1\n", "0, sift, a.jpg, 2\n1, sift, a.jpg, 3\n")
    with pytest.raises(DatasetError, match=r"observations\.txt:4: a\.jpg has no such keypoint"):
        read_reconstruction(tmp_path)


def test_published_reconstructions_are_read(shared_data: Path) -> None:
    samples = shared_data / "import_samples"
    maupertuis = read_reconstruction(samples / "kapture_maupertuis")
    assert maupertuis is not None
    assert maupertuis.points.shape == (1039, 3)
    assert maupertuis.colors is not None
    assert maupertuis.colors[0].tolist() == [57, 57, 49]
    assert maupertuis.keypoints_type == "SIFT"
    assert named(maupertuis)[:2] == [(0, "00.jpg", 4975), (0, "01.jpg", 4561)]
    berlin = read_reconstruction(samples / "kapture_berlin")
    assert berlin is not None
    assert (len(berlin.points), len(berlin.observations)) == (1702, 0)
