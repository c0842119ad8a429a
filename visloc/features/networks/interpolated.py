"""Heads on the squares of bilinearly enlarged features, without enlarging the features.

A head h gives sum_c h_c x_c^2 for features x of twice the resolution. There x is a weighted sum
of the neighbouring small features a, so that the head is a weighted sum of the products
sum_c h_c a_c b_c of neighbours a, b. They are as few numbers as the result, where x itself
would be 128 times as many. The result is exact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_STRIP_ROWS = 8  # of features multiplied at a time: what fits into a core's cache
# Doubling the resolution puts two pixels between two neighbours, a quarter from either.
_NEAR, _FAR = 0.75, 0.25


def squared_heads(
    features: NDArray[np.float32], weight: NDArray[np.float32], bias: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the heads (K, h, w) on the squares of features (C, h, w); weight (K, C), bias (K,)."""
    channels, height, width = features.shape
    squares = features.reshape(channels, height * width) ** 2
    return (weight @ squares + bias[:, None]).reshape(len(weight), height, width)


def squared_heads_at_double_resolution(
    features: NDArray[np.float32], weight: NDArray[np.float32], bias: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the heads (K, 2h, 2w) on the squares of features (C, h, w) of twice the resolution.

    As of enlarging bilinearly, each pixel's corners on its own (align_corners=False).
    weight: (K, C); bias: (K,).
    """
    _, height, width = features.shape
    heads = len(weight)
    # Products of each small pixel with itself, with its right neighbour, with the one below, and
    # of both diagonals of the square of four, whose weights are always equal.
    own = np.empty((heads, height, width), np.float32)
    right = np.empty((heads, height, width - 1), np.float32)
    below = np.empty((heads, height - 1, width), np.float32)
    diagonals = np.empty((heads, height - 1, width - 1), np.float32)
    for top in range(0, height, _STRIP_ROWS):
        rows = features[:, top : top + _STRIP_ROWS]
        here = slice(top, top + _STRIP_ROWS)
        own[:, here] = _heads(weight, rows * rows)
        right[:, here] = _heads(weight, rows[:, :, :-1] * rows[:, :, 1:])
        lower = features[:, top + 1 : top + _STRIP_ROWS + 1]
        upper = rows[:, : lower.shape[1]]
        below[:, here] = _heads(weight, upper * lower)
        falling = upper[:, :, :-1] * lower[:, :, 1:]
        falling += upper[:, :, 1:] * lower[:, :, :-1]
        diagonals[:, here] = _heads(weight, falling)
    # From rows to rows of twice the resolution, then the same from columns to columns.
    own_tall = _doubled(own, 2 * below, axis=1)
    right_tall = _doubled(right, diagonals, axis=1)
    # A step to the right and back is two products with the right neighbour.
    logits = _doubled(own_tall, 2 * right_tall, axis=2)
    logits += bias[:, None, None]
    return logits


def _heads(weight: NDArray[np.float32], products: NDArray[np.float32]) -> NDArray[np.float32]:
    channels, height, width = products.shape
    flat = weight @ products.reshape(channels, height * width)
    return flat.reshape(len(weight), height, width)


def _doubled(
    own: NDArray[np.float32], between: NDArray[np.float32], axis: int
) -> NDArray[np.float32]:
    """Return quadratic forms of interpolated values, from those of n values: 2n along the axis.

    With a form q of values a, b of neighbours, and the sum of its mixed terms ``between`` them:
    q(f a + n b) = f^2 q(a) + n^2 q(b) + f n between. Beyond the ends, values repeat.
    """
    shape = list(own.shape)
    shape[axis] *= 2
    doubled = np.empty(shape, np.float32)
    # Views with the axis first; the memory stays in its order.
    target, own, between = (np.moveaxis(each, axis, 0) for each in (doubled, own, between))
    target[0], target[-1] = own[0], own[-1]
    mixed = np.float32(_NEAR * _FAR) * between
    near, far = np.float32(_NEAR**2) * own, np.float32(_FAR**2) * own
    np.add(near[:-1] + mixed, far[1:], out=target[1:-1:2])
    np.add(far[:-1] + mixed, near[1:], out=target[2:-1:2])
    return doubled
