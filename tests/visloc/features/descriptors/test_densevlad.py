from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from visloc.features.base import GlobalDescriptor
from visloc.features.descriptors.densevlad import DenseVlad, dense_root_sift, orientation_channels
from visloc.types import LocalFeatures

NO_FEATURES = LocalFeatures(
    keypoints=np.zeros((0, 2), np.float32),
    descriptors=np.zeros((0, 64), np.float32),
    scores=np.zeros(0, np.float32),
    scales=np.zeros(0, np.float32),
)


def texture(seed: int, height: int = 240, width: int = 320) -> NDArray[np.uint8]:
    """Patches of random grey, blurred: a place of its own for every seed."""
    noise = np.random.default_rng(seed).uniform(0, 255, (height // 10, width // 10, 3))
    enlarged = cv2.resize(noise, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.GaussianBlur(enlarged, (0, 0), 1.0)).astype(np.uint8)


def ramp(direction_deg: float, size: int = 64) -> NDArray[np.float32]:
    """Two grey levels per pixel brighter in a direction (0: right, 90: down)."""
    y, x = np.mgrid[:size, :size]
    angle = np.radians(direction_deg)
    return np.asarray(2 * (x * np.cos(angle) + y * np.sin(angle)), np.float32)


def edge(columns: slice, rows: slice) -> NDArray[np.uint8]:
    """White where the slices say, black elsewhere."""
    rgb = np.zeros((128, 128, 3), np.uint8)
    rgb[rows, columns] = 255
    return rgb


@pytest.fixture(scope="module")
def model() -> dict[str, NDArray[np.float32]]:
    densevlad = DenseVlad()
    photos = [texture(seed) for seed in range(8)]
    words = [densevlad.training_words(photo, NO_FEATURES, 0) for photo in photos]
    vocabulary = densevlad.learn_vocabulary(np.concatenate(words), 0)
    pooled = np.stack([densevlad.pool(photo, NO_FEATURES, vocabulary) for photo in photos])
    return {**vocabulary, **densevlad.learn_projection(pooled)}


def test_satisfies_the_protocol() -> None:
    descriptor: GlobalDescriptor = DenseVlad()
    assert descriptor.fingerprint.name == "densevlad"
    assert descriptor.fingerprint == DenseVlad().fingerprint


@pytest.mark.parametrize("channel", range(8))
def test_a_gradient_along_an_orientation_fills_its_channel_alone(channel: int) -> None:
    channels = orientation_channels(ramp(45.0 * channel))
    inside = channels[4:-4, 4:-4]
    # Two grey levels per pixel: the neighbours on either side differ by four.
    assert_allclose(inside[..., channel], 4.0, rtol=1e-2)
    assert_allclose(np.delete(inside, channel, axis=-1), 0.0, atol=4e-2)


def test_a_gradient_between_two_orientations_is_shared_linearly() -> None:
    channels = orientation_channels(ramp(45.0 * 2 + 45.0 / 4))[4:-4, 4:-4]
    assert_allclose(channels[..., 2], 3.0, rtol=2e-2)
    assert_allclose(channels[..., 3], 1.0, rtol=2e-2)


@pytest.mark.parametrize(
    ("rgb", "channel"),
    [
        (edge(slice(64, None), slice(None)), 0),  # brighter to the right
        (edge(slice(None), slice(64, None)), 2),  # brighter below
        (edge(slice(None, 64), slice(None)), 4),
        (edge(slice(None), slice(None, 64)), 6),
    ],
)
def test_a_straight_edge_lands_in_one_orientation_of_every_word(
    rgb: NDArray[np.uint8], channel: int
) -> None:
    words = dense_root_sift(rgb)
    assert len(words) > 10
    by_orientation = np.square(words).reshape(len(words), 16, 8).sum(axis=1)
    assert_allclose(by_orientation[:, channel], 1.0, atol=1e-3)


def test_an_edge_lands_in_the_cells_that_it_crosses() -> None:
    # Cells of 8 px; the edge at x = 64 lies between the cells that start at 56 and at 64. The
    # patch that starts at 48 has it between its second and third column.
    words = dense_root_sift(edge(slice(64, None), slice(None)))
    by_column = np.square(words).reshape(len(words), 4, 4, 8).sum(axis=(1, 3))
    halves = by_column[np.argmax(by_column[:, 1] + by_column[:, 2])]
    assert halves[1] + halves[2] > 0.85
    assert halves[1] == pytest.approx(halves[2], abs=0.3)


def test_words_are_of_unit_length_and_never_negative() -> None:
    words = dense_root_sift(texture(0))
    # 320x240 in cells of 8, 12 and 16 px: 40x30, 26x20 and 20x15 cells, patches of 4x4 of them.
    assert words.shape == (37 * 27 + 23 * 17 + 17 * 12, 128)
    assert words.dtype == np.float32
    assert words.min() >= 0
    assert_allclose(np.linalg.norm(words, axis=1), 1.0, atol=1e-5)


def test_brightness_and_contrast_leave_words_as_they_are() -> None:
    rgb = texture(0)
    dimmed = (rgb // 4 * 2 + 40).astype(np.uint8)
    words, dim_words = dense_root_sift(rgb // 4 * 4), dense_root_sift(dimmed)
    assert words.shape == dim_words.shape
    assert (words * dim_words).sum(axis=1).mean() > 0.995


def test_a_photo_without_contrast_has_no_words() -> None:
    assert dense_root_sift(np.full((240, 320, 3), 128, np.uint8)).shape == (0, 128)
    noise = np.random.default_rng(0).integers(127, 129, (240, 320, 1)).repeat(3, axis=2)
    faint = cv2.GaussianBlur(noise.astype(np.uint8), (0, 0), 2.0)
    assert dense_root_sift(np.asarray(faint, np.uint8)).shape == (0, 128)


def test_only_the_half_with_contrast_gives_words() -> None:
    rgb = texture(0)
    every_word = len(dense_root_sift(rgb))
    rgb[:, :160] = 128
    assert 0.4 * every_word < len(dense_root_sift(rgb)) < 0.65 * every_word


def test_a_photo_and_its_grey_version_give_the_same_words() -> None:
    grey = cv2.cvtColor(texture(0), cv2.COLOR_RGB2GRAY)
    grey_rgb = np.repeat(np.asarray(grey, np.uint8)[..., None], 3, axis=2)
    assert_allclose(dense_root_sift(grey_rgb), dense_root_sift(texture(0)), atol=1e-3)


def test_views_that_are_not_contiguous_are_read_as_they_look() -> None:
    rgb = texture(0)
    assert_array_equal(
        dense_root_sift(rgb[:, ::-1]), dense_root_sift(np.ascontiguousarray(rgb[:, ::-1]))
    )


@given(st.integers(1, 200), st.integers(1, 200))
@settings(max_examples=60, deadline=None)
def test_any_size_gives_finite_unit_words(height: int, width: int) -> None:
    rgb = np.random.default_rng(height * 1000 + width).integers(
        0, 256, (height, width, 3), dtype=np.uint8
    )
    words = dense_root_sift(rgb)
    assert words.shape[1] == 128
    assert np.isfinite(words).all()
    assert_allclose(np.linalg.norm(words, axis=1), 1.0, atol=1e-5)
    if min(height, width) < 32:
        assert len(words) == 0
    if min(height, width) >= 36:
        assert len(words) > 0


@pytest.mark.parametrize("shape", [(1, 5000), (5000, 1), (40, 9000), (1, 1)])
def test_extreme_shapes_give_no_words_or_few(shape: tuple[int, int]) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    assert dense_root_sift(rgb).shape == (0, 128)


def test_a_large_photo_is_described_at_the_working_size() -> None:
    rgb = texture(0, 480, 640)
    enlarged = cv2.resize(rgb, None, fx=3, fy=3, interpolation=cv2.INTER_LINEAR)
    words, large_words = dense_root_sift(rgb), dense_root_sift(np.asarray(enlarged, np.uint8))
    assert words.shape == large_words.shape
    assert (words * large_words).sum(axis=1).mean() > 0.98


def test_a_shifted_or_dimmed_photo_stays_closest_to_its_own_place(
    model: dict[str, NDArray[np.float32]],
) -> None:
    densevlad = DenseVlad()
    rows = np.stack([densevlad.describe(texture(seed), NO_FEATURES, model) for seed in range(8)])
    assert_allclose(np.linalg.norm(rows, axis=1), 1.0, atol=1e-5)
    dimmed = (texture(2) * 0.6 + 20).astype(np.uint8)
    for changed in (np.roll(texture(2), (5, 11), axis=(0, 1)), dimmed):
        similarities = rows @ densevlad.describe(changed, NO_FEATURES, model)
        assert similarities.argmax() == 2
        assert similarities[2] > 0.5 + np.delete(similarities, 2).max()


def test_blank_and_tiny_photos_get_the_zero_vector(model: dict[str, NDArray[np.float32]]) -> None:
    for rgb in (np.full((240, 320, 3), 255, np.uint8), texture(0)[:20, :20]):
        assert_array_equal(DenseVlad().describe(rgb, NO_FEATURES, model), np.zeros(7))


def test_threads_get_the_same_bits(model: dict[str, NDArray[np.float32]]) -> None:
    densevlad = DenseVlad()
    photos = [texture(seed) for seed in range(4)] * 3
    alone = [densevlad.describe(photo, NO_FEATURES, model) for photo in photos]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda rgb: densevlad.describe(rgb, NO_FEATURES, model), photos))
    assert_array_equal(together, alone)


def test_training_words_are_bounded_and_seeded() -> None:
    first = DenseVlad().training_words(texture(0), NO_FEATURES, 5)
    assert first.shape == (1000, 128)
    assert_array_equal(first, DenseVlad().training_words(texture(0), NO_FEATURES, 5))
    assert not np.array_equal(first, DenseVlad().training_words(texture(0), NO_FEATURES, 6))


def test_photos_of_a_real_place_find_their_neighbours(shared_data: Path) -> None:
    # Frames of one hand-held video: each query lies between two mapping frames of its time.
    folder = shared_data / "kitti_curve"
    mapping = sorted((folder / "mapping/sensors/records_data/left").glob("*.png"))[:10]
    queries = sorted((folder / "query/sensors/records_data/left").glob("*.png"))[:9]
    densevlad = DenseVlad()
    photos = [np.asarray(cv2.imread(str(path)), np.uint8) for path in mapping]
    words = [densevlad.training_words(photo, NO_FEATURES, 0) for photo in photos]
    vocabulary = densevlad.learn_vocabulary(np.concatenate(words), 0)
    pooled = np.stack([densevlad.pool(photo, NO_FEATURES, vocabulary) for photo in photos])
    model = {**vocabulary, **densevlad.learn_projection(pooled)}
    rows = densevlad.project(pooled, model)
    for i, path in enumerate(queries):
        query = np.asarray(cv2.imread(str(path)), np.uint8)
        best = (rows @ densevlad.describe(query, NO_FEATURES, model)).argsort()[::-1]
        assert best[0] in (i, i + 1), path.name
