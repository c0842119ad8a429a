"""Features of twice the resolution, of which only parts are ever made.

Fast-R2D2 works at half the resolution and enlarges its features x bilinearly, each pixel's corners
on its own (align_corners=False). Kept at full resolution they would be most of a step's memory
traffic. Two facts make that needless, and both are exact: a dot product with an enlarged x is the
enlarged dot product, and a weighted sum of its squares is one of products of neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

# Doubling the resolution puts two pixels between two neighbours, a quarter from either.
_NEAR, _FAR = 0.75, 0.25


def weighted_squares(features: Tensor, weight: Tensor, stride: int) -> Tensor:
    """Return sum_c weight_kc x_c^2 (B, K, H, W) for x, the features enlarged by the stride.

    Args:
        features: (B, h, w, C).
        weight: (K, C).
        stride: 1 or 2; H = stride * h.
    """
    if stride == 1:
        return (features.square() @ weight.T).permute(0, 3, 1, 2)
    own, right, below, diagonals = _neighbour_products(features, weight)
    # From rows to rows of twice the resolution, then the same from columns to columns.
    own_tall = _doubled(own, 2 * below, axis=1)
    right_tall = _doubled(right, diagonals, axis=1)
    # A step to the right and back is two products with the right neighbour.
    return _doubled(own_tall, 2 * right_tall, axis=2).permute(0, 3, 1, 2)


class _NeighbourProducts(torch.autograd.Function):
    """Weighted sums of products of each feature with itself and with three neighbours.

    With features (B, h, w, C) and weight (K, C): of itself (B, h, w, K), with the right one
    (B, h, w - 1, K), with the one below (B, h - 1, w, K), and of both diagonals of each square of
    four (B, h - 1, w - 1, K), whose weights are always equal.

    Autograd would keep each product of C channels and fill as many gradients with zeros; here one
    image at a time goes through the processor's cache, in a quarter of the time.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(features, weight)
        made = [
            [_product(pairs) @ weight.T for pairs in _neighbour_pairs(part)]
            for part in _parts(features)
        ]
        return tuple(torch.cat(each) for each in zip(*made, strict=True))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        features, weight = ctx.saved_tensors
        of_features, of_weight = torch.zeros_like(features), torch.zeros_like(weight)
        split = [_parts(each) for each in (features, of_features, *gradients)]
        for part, of_part, *of_sums in zip(*split, strict=True):
            views = zip(_neighbour_pairs(part), _neighbour_pairs(of_part), of_sums, strict=True)
            for pairs, of_pairs, of_sum in views:
                of_product = of_sum @ weight
                for (here, there), (of_here, of_there) in zip(pairs, of_pairs, strict=True):
                    of_here.addcmul_(of_product, there)
                    of_there.addcmul_(of_product, here)
                product = _product(pairs)
                of_weight += of_sum.flatten(0, 2).T @ product.flatten(0, 2)
        return of_features, of_weight


_neighbour_products: Callable[[Tensor, Tensor], tuple[Tensor, ...]] = _NeighbourProducts.apply


def _parts(batch: Tensor) -> Sequence[Tensor]:
    """Return what is multiplied at a time: a GPU takes all images at once."""
    return (batch,) if batch.is_cuda else torch.split(batch, 1)


def _neighbour_pairs(x: Tensor) -> list[list[tuple[Tensor, Tensor]]]:
    """Return the factors (B, h, w, C) of the four products; those of the last are two terms."""
    above, below, left, right = x[:, :-1], x[:, 1:], x[:, :, :-1], x[:, :, 1:]
    falling = (above[:, :, :-1], below[:, :, 1:])
    rising = (above[:, :, 1:], below[:, :, :-1])
    return [[(x, x)], [(left, right)], [(above, below)], [falling, rising]]


def _product(pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    (here, there), *more = pairs
    product = here * there
    for each in more:
        product.addcmul_(*each)
    return product


def _doubled(own: Tensor, between: Tensor, axis: int) -> Tensor:
    """Return quadratic forms of interpolated values from those of n values: 2n along the axis.

    With a form q of values a, b of neighbours, and the sum of its mixed terms ``between`` them:
    q(f a + n b) = f^2 q(a) + n^2 q(b) + f n between. Beyond the ends, values repeat.
    """
    size = own.shape[axis]
    here, there = own.narrow(axis, 0, size - 1), own.narrow(axis, 1, size - 1)
    mixed = _NEAR * _FAR * between
    after_first = _NEAR**2 * here + _FAR**2 * there + mixed
    before_second = _FAR**2 * here + _NEAR**2 * there + mixed
    first, last = own.narrow(axis, 0, 1), own.narrow(axis, size - 1, 1)
    even = torch.cat([first, before_second], dim=axis)
    odd = torch.cat([after_first, last], dim=axis)
    return torch.stack([even, odd], dim=axis + 1).flatten(axis, axis + 1)


def neighbours(x: Tensor, y: Tensor, size: tuple[int, int], stride: int) -> tuple[Tensor, Tensor]:
    """Return which small features make an enlarged one, and with what weights.

    Args:
        x: (...) int64 columns at full resolution.
        y: (...) int64 rows.
        size: (h, w) of the small features.
        stride: 1 or 2.

    Returns:
        Places y * w + x of small features (..., T) int64, weights (..., T) float32; T is the
        square of the stride.
    """
    height, width = size
    if stride == 1:
        return (y * width + x)[..., None], torch.ones_like(x, dtype=torch.float32)[..., None]
    (left, right, x_weight), (above, below, y_weight) = _between(x, width), _between(y, height)
    places = [above * width + left, above * width + right, below * width + left]
    weights = [(1 - y_weight) * (1 - x_weight), (1 - y_weight) * x_weight]
    weights += [y_weight * (1 - x_weight), y_weight * x_weight]
    return torch.stack([*places, below * width + right], dim=-1), torch.stack(weights, dim=-1)


def _between(index: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return both small neighbours of an index at twice the resolution, the second's weight."""
    first = (index - 1).div(2, rounding_mode="floor")
    # Odd ones lie a quarter after the first, even ones a quarter before the second.
    weight = torch.where(index % 2 == 1, _FAR, _NEAR)
    return first.clamp(0, size - 1), (first + 1).clamp(0, size - 1), weight
