"""Which pixels ask for their match, and among which others it has to be found.

Revaud et al. 2019, section 3.2 and 4.1: queries at random; the right answer is the most alike of
the pixels within 3 px of the true match; wrong ones are those from 5 to 7 px from it, and random
pixels of every image of the batch.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from visloc_extensions.training.interpolation import neighbours
from visloc_extensions.training.losses import quantized_average_precision
from visloc_extensions.training.network import Maps

RIGHT_WITHIN_PX = 3
WRONG_FROM_PX = 5
WRONG_WITHIN_PX = 7
_LEAST = 1e-12


class Sampled(NamedTuple):
    """What N queries of each of B pairs found.

    Attributes:
        precision: (B, N) average precision.
        reliability: (B, N) mean of what both images say at the query and at the right answer.
        asked: (B, N) bool, whether the query's match is inside the second image; the rest of a
            query that is not means nothing.
    """

    precision: Tensor
    reliability: Tensor
    asked: Tensor


@cache
def offsets(lowest_px: int, highest_px: int) -> tuple[tuple[int, int], ...]:
    """Return all whole (x, y) whose length is in lowest_px to highest_px."""
    reach = range(-highest_px, highest_px + 1)
    return tuple(
        (x, y) for y in reach for x in reach if lowest_px**2 <= x * x + y * y <= highest_px**2
    )


@cache
def _offsets_on(device: torch.device, lowest_px: int, highest_px: int) -> Tensor:
    return torch.tensor(offsets(lowest_px, highest_px), device=device)


def random_pixels(
    rng: np.random.Generator, images: int, per_image: int, size_px: int, border_px: int
) -> NDArray[np.int64]:
    """Return (images, per_image, 2) pixels (x, y), none within the border."""
    return rng.integers(border_px, size_px - border_px, (images, per_image, 2))


def sample(
    first: Maps, second: Maps, flow: Tensor, queries: Tensor, distractors: Tensor
) -> Sampled:
    """Let pixels of the first images look for their match in the second ones.

    Args:
        second: of as many.
        flow: (B, H, W, 2).
        queries: (B, N, 2) int64 pixels (x, y) of the first images.
        distractors: (B, K, 2) int64 pixels of the second ones.
    """
    images, height, width = second.reliability.shape
    pair = torch.arange(images, device=flow.device)[:, None]
    match = flow[pair, queries[..., 1], queries[..., 0]]
    # A comparison with NaN is false.
    asked = (match >= 0).all(dim=-1) & (match[..., 0] < width) & (match[..., 1] < height)
    match = match.masked_fill(~asked[..., None], 0).floor().long()

    wanted = _descriptors(first, queries)
    products = wanted @ second.features.flatten(1, 2).transpose(1, 2)  # (B, N, h * w)
    lengths = second.squared_length.flatten(1).clamp_min(_LEAST).sqrt()

    def near(lowest_px: int, highest_px: int) -> tuple[Tensor, Tensor]:
        """Return pixels (B, N, M) at these distances from the match, and their cosines."""
        steps = _offsets_on(flow.device, lowest_px, highest_px)
        x = (match[..., None, 0] + steps[:, 0]).clamp(0, width - 1)
        y = (match[..., None, 1] + steps[:, 1]).clamp(0, height - 1)
        places, weights = neighbours(x, y, second.size, second.stride)
        taken = products.gather(2, places.flatten(2)).view_as(weights)
        pixels = y * width + x
        length = lengths.gather(1, pixels.flatten(1)).view_as(pixels)
        return pixels, (taken * weights).sum(dim=-1) / length

    pixels, cosines = near(0, RIGHT_WITHIN_PX)
    positive, best = cosines.max(dim=2, keepdim=True)
    _, near_misses = near(WRONG_FROM_PX, WRONG_WITHIN_PX)

    others = _descriptors(second, distractors)
    far = wanted.flatten(0, 1) @ others.flatten(0, 1).T
    far = far.view(images, queries.shape[1], images, -1)
    gap = (distractors[:, None] - match[:, :, None]).square().sum(dim=-1)  # (B, N, K)
    same_pair = torch.eye(images, dtype=torch.bool, device=flow.device)[:, None, :, None]
    far = far.masked_fill(same_pair & (gap < WRONG_FROM_PX**2)[:, :, None], 0).flatten(2)

    negatives = torch.cat([near_misses, far], dim=2)
    precision = quantized_average_precision(positive[..., 0].flatten(), negatives.flatten(0, 1))
    answer = pixels.gather(2, best)[..., 0]
    said = first.reliability[pair, queries[..., 1], queries[..., 0]]
    said = said + second.reliability.flatten(1).gather(1, answer)
    return Sampled(precision.view_as(said), said / 2, asked)


def _descriptors(maps: Maps, pixels: Tensor) -> Tensor:
    """Return unit vectors (B, N, C) at pixels (x, y) (B, N, 2)."""
    places, weights = neighbours(pixels[..., 0], pixels[..., 1], maps.size, maps.stride)
    features = maps.features.flatten(1, 2)
    begins = torch.arange(len(pixels), device=pixels.device)[:, None, None] * features.shape[1]
    # On a GPU the gradient of this is a sum, that of indexing twice would sort first.
    taken = features.flatten(0, 1).index_select(0, (begins + places).flatten())
    taken = taken.view(*places.shape, -1)
    return F.normalize((taken * weights[..., None]).sum(dim=2), dim=-1)
