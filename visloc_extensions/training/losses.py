"""What the network should minimize (Revaud et al. 2019, section 3)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

AP_BINS = 20
_LEAST = 1e-16
_MIN_VALID_SHARE = 0.5  # of a patch, for the patch to count


def quantized_average_precision(positive: Tensor, negatives: Tensor, bins: int = AP_BINS) -> Tensor:
    """Return a differentiable average precision of queries with one right answer each.

    He et al. 2018: a similarity is spread over the two of the bins, with centres from 1 down to 0,
    that it lies between; the last bin takes everything below 0, too. Down to and with the bin of
    centre c there is clip((z - c) / width + 1, 0, 1) of it, and
    AP = sum_k (recall_k - recall_(k-1)) * precision_k. With one right answer, recall grows in its
    own two bins only: no other needs to be looked at.

    Args:
        positive: (Q,) similarity of the right answer, cosine.
        negatives: (Q, M) similarities of the wrong ones.
        bins: how many.

    Returns:
        (Q,) in 0 to 1.
    """
    wrong = negatives.clamp_min(0) * (bins - 1)
    place = (1 - positive.clamp(0, 1)) * (bins - 1)  # counts bins, from the first centre
    upper = place.detach().floor().clamp_max(bins - 2)
    in_lower = place - upper
    in_upper = 1 - in_lower

    def found(number: Tensor) -> Tensor:
        """Return how many wrong answers there are down to and with a bin (Q,)."""
        centre = bins - 1 - number
        return (wrong - centre[:, None] + 1).clamp(0, 1).sum(dim=1)

    of_upper = in_upper / (in_upper + found(upper) + _LEAST)
    of_lower = 1 / (1 + found(upper + 1))
    return in_upper * of_upper + in_lower * of_lower


def reliability_loss(
    precision: Tensor, reliability: Tensor, asked: Tensor, good_precision: float
) -> Tensor:
    """Return 1 - (AP * R + (1 - R) * kappa), averaged: R learns where AP is above kappa.

    Args:
        reliability: (...) what the network says about it, 0 to 1.
        asked: (...) bool, which of them count; without any the loss is 0.
    """
    loss = 1 - (precision * reliability + (1 - reliability) * good_precision)
    return loss.masked_fill(~asked, 0).sum() / asked.sum().clamp_min(1)


def similarity_loss(
    first: Tensor, second_seen_from_first: Tensor, valid: Tensor, patch_px: int
) -> Tensor:
    """Return 1 - the mean cosine of patches of two repeatability maps, half a patch apart.

    Pixels without a match are left out of both maps, and patches with less than half of their
    pixels matched are left out altogether.

    Args:
        first: (B, H, W).
        second_seen_from_first: (B, H, W), the second map at the flow.
        valid: (B, H, W) bool, where the flow leads to.
    """
    share = valid.to(first.dtype)
    first, second = first * share, second_seen_from_first * share
    maps = torch.stack([first * second, first * first, second * second, share], dim=1)
    # The same factor 1 / patch_px^2 above and below the fraction.
    product, square_1, square_2, counted = F.avg_pool2d(
        maps, patch_px, stride=patch_px // 2
    ).unbind(dim=1)
    cosine = product / (square_1 * square_2).clamp_min(1e-12).sqrt()
    counts = (counted >= _MIN_VALID_SHARE).to(first.dtype)
    return 1 - (cosine * counts).sum() / counts.sum().clamp_min(1)


def peakiness_loss(repeatability: Tensor, patch_px: int) -> Tensor:
    """Return 1 - the mean of (largest - mean) in squares of patch_px + 1 about every pixel.

    The map is averaged over 3 x 3 pixels before. Zeros beyond the border count in the means.

    Args:
        repeatability: (B, H, W).
    """
    smooth = F.avg_pool2d(repeatability[:, None], 3, stride=1, padding=1)
    side, reach = patch_px + 1, patch_px // 2
    # The largest of a square is the largest of its rows' largest.
    largest = F.max_pool2d(smooth, (1, side), stride=1, padding=(0, reach))
    largest = F.max_pool2d(largest, (side, 1), stride=1, padding=(reach, 0))
    mean = F.avg_pool2d(smooth, (1, side), stride=1, padding=(0, reach))
    mean = F.avg_pool2d(mean, (side, 1), stride=1, padding=(reach, 0))
    return 1 - (largest - mean).mean()
