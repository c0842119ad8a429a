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

    He et al. 2018: similarities are spread over bins with centres c_k from 1 down to 0, each over
    the two next to it. A similarity's share of the first k bins is then
    clip((z - c_k) / width + 1, 0, 1), all of it in the last one, and
    AP = sum_k (recall_k - recall_(k-1)) * precision_k.

    Args:
        positive: (Q,) similarity of the right answer, cosine.
        negatives: (Q, M) similarities of the wrong ones.
        bins: how many.

    Returns:
        (Q,) in 0 to 1.
    """
    width = 1 / (bins - 1)
    right, found = [], []
    for k in range(bins - 1):
        centre = 1 - k * width
        right.append(((positive - centre) / width + 1).clamp(0, 1))
        wrong = ((negatives - centre) / width + 1).clamp(0, 1).sum(dim=1)
        found.append(right[-1] + wrong)
    right.append(torch.ones_like(positive))
    found.append(torch.full_like(positive, 1 + negatives.shape[1]))
    recall, answers = torch.stack(right), torch.stack(found)
    gained = torch.diff(recall, dim=0, prepend=torch.zeros_like(recall[:1]))
    return (gained * recall / (answers + _LEAST)).sum(dim=0)


def reliability_loss(
    precision: Tensor, reliability: Tensor, asked: Tensor, good_precision: float
) -> Tensor:
    """Return 1 - (AP * R + (1 - R) * kappa), averaged: R learns where AP is above kappa.

    Args:
        precision: (...) average precision of each query.
        reliability: (...) what the network says about it, 0 to 1.
        asked: (...) bool, which of them count; without any the loss is 0.
        good_precision: kappa.
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
        patch_px: side of a patch.
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
        patch_px: even.
    """
    smooth = F.avg_pool2d(repeatability[:, None], 3, stride=1, padding=1)
    side, reach = patch_px + 1, patch_px // 2
    # The largest of a square is the largest of its rows' largest.
    largest = F.max_pool2d(smooth, (1, side), stride=1, padding=(0, reach))
    largest = F.max_pool2d(largest, (side, 1), stride=1, padding=(reach, 0))
    mean = F.avg_pool2d(smooth, (1, side), stride=1, padding=(0, reach))
    mean = F.avg_pool2d(mean, (side, 1), stride=1, padding=(reach, 0))
    return 1 - (largest - mean).mean()
