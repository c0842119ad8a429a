"""Peaks of a map of probabilities, placed below the pixel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_OFFSET_PX", "peak_offsets"]

MAX_OFFSET_PX = 0.5  # further away another pixel would be the nearest


def peak_offsets(
    response: NDArray[np.float32],
    x: NDArray[np.intp],
    y: NDArray[np.intp],
    *,
    reach: int,
    log_odds: Callable[[NDArray[np.float32]], NDArray[np.float32]],
) -> NDArray[np.float32]:
    """Return offsets (N, 2), x and y in pixels, of the peaks from the pixels that hold them.

    A quadratic in both coordinates is fitted by least squares to the log odds of the square of
    ``2 reach + 1`` pixels around each peak, and its maximum taken, on each axis at most half a
    pixel away. Log odds because probabilities are flat where they near 0 or 1. There is no
    offset where the quadratic has no maximum, where log odds are not finite, and where the square
    reaches beyond the map.

    Args:
        response: (H, W) of a network.
        x: (N,) columns of the peaks.
        y: (N,) rows of the peaks.
        reach: pixels on either side of a peak that are looked at, 1 or more.
        log_odds: of responses, element by element.
    """
    height, width = response.shape
    offsets = np.zeros((len(x), 2), np.float32)
    inside = (x >= reach) & (x < width - reach) & (y >= reach) & (y < height - reach)
    within = np.flatnonzero(inside)
    steps = np.arange(-reach, reach + 1)
    down, right = (each.ravel() for each in np.meshgrid(steps, steps, indexing="ij"))
    around = (y[within] * width + x[within])[:, None] + (down * width + right)
    heights = log_odds(response.ravel()[around]).astype(np.float64)
    finite = np.isfinite(heights).all(axis=1)
    within, heights = within[finite], heights[finite]
    fit = np.linalg.pinv(_monomials(right.astype(np.float64), down.astype(np.float64)))
    _, x_slope, y_slope, xx, yy, xy = fit @ heights.T
    determinant = xx * yy - xy**2
    # A plateau has curvatures of rounding errors only.
    flat = 1e-9 * np.abs(heights).max(axis=1, initial=1.0)
    has_maximum = (xx < -flat) & (yy < -flat) & (determinant > flat**2)
    maxima = np.stack([xy * y_slope - yy * x_slope, xy * x_slope - xx * y_slope], axis=1)
    maxima = maxima[has_maximum] / determinant[has_maximum, None]
    offsets[within[has_maximum]] = np.clip(maxima, -MAX_OFFSET_PX, MAX_OFFSET_PX)
    return offsets


def _monomials(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return those of a quadratic (n, 6); the factors of the last three are its curvatures."""
    return np.stack([np.ones_like(x), x, y, x**2 / 2, y**2 / 2, x * y], axis=1)
