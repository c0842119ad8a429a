from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from visloc.errors import DatasetError
from visloc.geometry import PixelOrigin
from visloc.kapture import open_local_features, read_local, write_local_features

IMAGE = "db/4446.jpg"
SIZE = (1600, 1063)
# One row has the bytes of a published sample, whose config file calls them float32.
AACHEN = np.concatenate(
    [
        np.frombuffer(bytes.fromhex("77be9f1a2fa78e40 83c0caa145f66e40")),
        [12.345678, 1001.9, 700.123, 3.3, 1311.7, 901.57],
    ]
).reshape(4, 2)


def write(root: Path, keypoints: np.ndarray, count: int | None = None) -> Path:
    rows = len(keypoints) if count is None else count
    write_local_features(root, "t", IMAGE, keypoints, np.ones((len(keypoints), 4)), name="n")
    path = root / "reconstruction/descriptors/t" / f"{IMAGE}.desc"
    path.write_bytes(np.ones((rows, 4)).tobytes())
    return root / "reconstruction/keypoints/t" / f"{IMAGE}.kpt"


def read(
    root: Path, size: tuple[int, int] | None = SIZE, origin: PixelOrigin = PixelOrigin.CORNER
) -> tuple[np.ndarray, np.ndarray]:
    return read_local(*open_local_features(root, "t"), IMAGE, size, origin)


@pytest.mark.parametrize(("origin", "shift"), [(PixelOrigin.CORNER, 0), (PixelOrigin.CENTER, 0.5)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32])
def test_keypoints_come_in_our_convention(
    tmp_path: Path, origin: PixelOrigin, shift: float, dtype: type
) -> None:
    rows = np.array([[0, 0, 32], [1599, 1062, 64], [1600, 1063, 1e4]], dtype=dtype)
    write(tmp_path, rows)
    keypoints, descriptors = read(tmp_path, origin=origin)
    assert keypoints.dtype == np.float32
    assert np.array_equal(keypoints, rows[:, :2] + shift)
    assert descriptors.dtype == np.float64
    assert descriptors.shape == (3, 4)


def test_an_image_without_keypoints_has_none(tmp_path: Path) -> None:
    write(tmp_path, np.empty((0, 2)))
    keypoints, descriptors = read(tmp_path)
    assert keypoints.shape == (0, 2)
    assert descriptors.shape == (0, 4)


def test_counts_that_disagree_name_both_files_and_both_counts(tmp_path: Path) -> None:
    path = write(tmp_path, AACHEN, count=3)
    with pytest.raises(DatasetError) as caught:
        read(tmp_path)
    assert caught.value.code == "kapture.feature_count"
    text = str(caught.value)
    for words in (str(path), "descriptors/t/db/4446.jpg.desc", "4 keypoints", "3 descriptors"):
        assert words in text


def declare(root: Path, line: str) -> None:
    (root / "reconstruction/keypoints/t/keypoints.txt").write_text(
        f"# kapture format: 1.1\n# name, dtype, dsize\n{line}\n"
    )


def test_float64_declared_as_float32_disagrees_with_the_descriptors(tmp_path: Path) -> None:
    write(tmp_path, AACHEN)
    declare(tmp_path, "sift, float32, 2")
    with pytest.raises(DatasetError, match=r"8 keypoints.*dtype") as caught:
        read(tmp_path)
    assert caught.value.code == "kapture.feature_count"


@pytest.mark.parametrize("size", [SIZE, None])
def test_float64_declared_as_float32_is_no_pixels(
    tmp_path: Path, size: tuple[int, int] | None
) -> None:
    # the published row alone lies within the photo: 6.6e-23, 4.46 and -1.4e-18, 3.73
    path = write(tmp_path, AACHEN[:1], count=2)
    declare(tmp_path, "sift, float32, 2")
    with pytest.raises(DatasetError, match=r"dtype is not what keypoints\.txt says") as caught:
        read(tmp_path, size)
    assert caught.value.code == "kapture.feature_pixels"
    assert caught.value.field == str(path)


@pytest.mark.parametrize(
    ("stored", "declared"),
    [("<f8", "float32"), ("<f4", "float64"), ("<i4", "float32"), ("<f4", "int32")],
)
def test_any_wrong_type_is_found_whatever_the_count(
    tmp_path: Path, stored: str, declared: str
) -> None:
    rng = np.random.default_rng(0)
    rows = (rng.uniform(0, 1, (50, 2)) * SIZE).astype(stored)
    num_read = rows.nbytes // (2 * np.dtype(declared).itemsize)
    write(tmp_path, rows, count=num_read)
    declare(tmp_path, f"n, {declared}, 2")
    with pytest.raises(DatasetError, match="dtype") as caught:
        read(tmp_path)
    assert caught.value.code in ("kapture.feature_pixels", "kapture.feature_values")


@pytest.mark.parametrize(
    ("point", "good"),
    [
        ((-1, -1), True),
        ((1600, 1063), True),
        ((-1.01, 5), False),
        ((1600.5, 5), False),
        ((5, 1063.5), False),
        ((5, -2), False),
    ],
)
def test_keypoints_lie_in_the_photo(tmp_path: Path, point: tuple[float, float], good: bool) -> None:
    write(tmp_path, np.array([[700.0, 500.0], point]))
    if good:
        assert read(tmp_path)[0][1] == pytest.approx(point)
        return
    with pytest.raises(DatasetError, match="keypoint 1 lies outside") as caught:
        read(tmp_path)
    assert caught.value.code == "kapture.feature_pixels"


def test_normalized_units_are_refused(tmp_path: Path) -> None:
    write(tmp_path, np.array([[0.0175, 0.2304], [-0.45, 0.129]]))
    with pytest.raises(DatasetError, match="normalized units"):
        read(tmp_path)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", ["keypoints", "descriptors"])
def test_numbers_that_are_not_finite_are_refused(tmp_path: Path, kind: str, bad: float) -> None:
    path = write(tmp_path, AACHEN)
    if kind == "descriptors":
        path = tmp_path / "reconstruction/descriptors/t" / f"{IMAGE}.desc"
    rows = np.fromfile(path).reshape(4, -1)
    rows[2, 1] = bad
    path.write_bytes(rows.tobytes())
    with pytest.raises(DatasetError, match="row 2") as caught:
        read(tmp_path)
    assert caught.value.code == "kapture.feature_values"
    assert caught.value.field == str(path)


def test_keypoints_in_normalized_units_of_a_published_sample_are_refused(
    shared_data: Path,
) -> None:
    root = shared_data / "import_samples/kapture_berlin"
    features = open_local_features(root, "HOG")
    assert features[0].type_name == "HessianAffine"
    with pytest.raises(DatasetError, match="normalized units") as caught:
        read_local(*features, "01.jpg", (3264, 2448), PixelOrigin.CORNER)
    assert caught.value.field is not None
    assert caught.value.field.endswith("01.jpg.kpt")


def test_published_features_are_read(shared_data: Path) -> None:
    root = shared_data / "import_samples/kapture_maupertuis"
    features = open_local_features(root, "SIFT")
    keypoints, descriptors = read_local(*features, "00.jpg", (1919, 1079), PixelOrigin.CORNER)
    assert keypoints[0] == pytest.approx([1290.9084, 4.1563606])
    assert (descriptors.dtype, descriptors.shape) == (np.dtype(np.uint8), (6424, 128))
    root = shared_data / "virtual_gallery"
    features = open_local_features(root / "query", "r2d2_500", root)
    image = "testing/gallery_light1_occlusion1/frames/rgb/camera_0/rgb_00267.jpg"
    keypoints, _ = read_local(*features, image, (1920, 1080), PixelOrigin.CENTER)
    assert np.array_equal(keypoints, features[0].read(image)[:, :2] + np.float32(0.5))
