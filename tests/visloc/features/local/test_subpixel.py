from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from visloc.features.local.subpixel import MAX_OFFSET_PX, peak_offsets

REACHES = pytest.mark.parametrize("reach", [1, 2, 3])


def _same(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values


def _offset(heights: NDArray[np.float64], x: int, y: int, reach: int) -> NDArray[np.float32]:
    peak = np.array([x]), np.array([y])
    return peak_offsets(heights.astype(np.float32), *peak, reach=reach, log_odds=_same)[0]


def _quadratic(x: float, y: float, curvatures: tuple[float, float, float]) -> NDArray[np.float64]:
    xx, yy, xy = curvatures
    rows, columns = np.mgrid[:20, :30].astype(float)
    dx, dy = columns - x, rows - y
    return xx * dx**2 / 2 + yy * dy**2 / 2 + xy * dx * dy


@REACHES
@pytest.mark.parametrize("height", [0.0, -50.0, 400.0])
@pytest.mark.parametrize("curvatures", [(-1, -1, 0), (-3, -0.4, 0.7), (-0.2, -0.3, -0.2)])
@pytest.mark.parametrize("offset", [(0, 0), (0.3, -0.2), (-0.49, 0.45)])
def test_peak_of_a_quadratic_is_found_exactly(
    offset: tuple[float, float], curvatures: tuple[float, float, float], height: float, reach: int
) -> None:
    heights = _quadratic(13 + offset[0], 8 + offset[1], curvatures) + height
    np.testing.assert_allclose(_offset(heights, 13, 8, reach), offset, atol=2e-3)


def test_peak_of_probabilities_is_found_in_their_log_odds() -> None:
    odds = np.exp(6 + _quadratic(13.3, 7.6, (-1, -2, 0.3)))  # saturated: 0.998 at the peak
    found = peak_offsets(
        (odds / (1 + odds)).astype(np.float32),
        np.array([13]),
        np.array([8]),
        reach=2,
        log_odds=lambda p: np.log(p / (1 - p)),
    )
    np.testing.assert_allclose(found[0], (0.3, -0.4), atol=1e-3)


@REACHES
@pytest.mark.parametrize("height", [0.0, 1e-3, -7.3, 646.0])
def test_plateau_has_no_offset(height: float, reach: int) -> None:
    assert not _offset(np.full((20, 30), height), 13, 8, reach).any()


@REACHES
@pytest.mark.parametrize(
    "curvatures", [(0, 0, 0), (-1, 0, 0), (0, -1, 0), (1, 1, 0), (-1, 1, 0), (-1, -1, 2)]
)
def test_ridges_valleys_and_saddles_have_no_offset(
    curvatures: tuple[float, float, float], reach: int
) -> None:
    assert not _offset(_quadratic(13.2, 8.2, curvatures), 13, 8, reach).any()


def test_offset_is_bounded_on_each_axis() -> None:
    heights = _quadratic(15.0, 8.25, (-1, -1, 0))
    np.testing.assert_allclose(_offset(heights, 13, 8, 2), (MAX_OFFSET_PX, 0.25), atol=1e-5)


@REACHES
def test_peaks_at_the_edge_stay_on_their_pixel(reach: int) -> None:
    heights = _quadratic(13.3, 8.3, (-1, -1, 0.2)).astype(np.float32)
    y, x = (each.ravel() for each in np.indices(heights.shape))
    found = peak_offsets(heights, x, y, reach=reach, log_odds=_same)
    inside = np.zeros(heights.shape, bool)
    inside[reach:-reach, reach:-reach] = True
    np.testing.assert_array_equal(found.any(axis=1), inside.ravel())


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (2, 2), (4, 4)])
def test_maps_smaller_than_the_square_have_no_offsets(shape: tuple[int, int]) -> None:
    y, x = (each.ravel() for each in np.indices(shape))
    heights = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    assert not peak_offsets(heights, x, y, reach=2, log_odds=_same).any()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_peaks_beside_what_is_not_finite_stay_on_their_pixel(wrong: float) -> None:
    heights = _quadratic(13.3, 8.3, (-1, -1, 0))
    heights[9, 14] = wrong
    assert not _offset(heights, 13, 8, 1).any()
    assert _offset(heights, 12, 8, 1).all()


def test_no_peaks_have_no_offsets() -> None:
    none = np.empty(0, np.intp)
    for shape in ((0, 0), (5, 5)):
        found = peak_offsets(np.zeros(shape, np.float32), none, none, reach=2, log_odds=_same)
        assert found.shape == (0, 2)


@given(st.integers(0, 2**32 - 1), st.floats(-30, 30), st.integers(1, 3))
def test_offsets_of_any_map_are_finite_and_bounded(seed: int, exponent: float, reach: int) -> None:
    heights = np.random.default_rng(seed).normal(size=(12, 15)) * 10**exponent
    y, x = (each.ravel() for each in np.indices(heights.shape))
    found = peak_offsets(heights.astype(np.float32), x, y, reach=reach, log_odds=_same)
    assert (np.abs(found) <= MAX_OFFSET_PX).all()
