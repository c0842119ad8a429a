"""The words of ``densevlad`` with torch, for GPUs; ``densevlad`` says what they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from visloc.features.descriptors.vlad import (
    CELL_PX,
    CELLS_PER_SIDE,
    MIN_CONTRAST,
    ORIENTATIONS,
    tent,
)


@torch.inference_mode()
def sums_of_words(
    device: torch.device,
    gradients: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]],
    centres: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Sum the words of a photo up by the nearest of the centres (K, 128).

    Args:
        gradients: of the photo at each scale, to the right and down, each (H, W).

    Returns:
        Sums (K, 128) and counts (K,).
    """
    own = torch.tensor(centres, device=device)
    sums, counts = torch.zeros_like(own), torch.zeros(len(own), device=device)
    for right, down in gradients:
        cells = _cells(_orientation_channels(torch.tensor(np.stack([right, down]), device=device)))
        if min(cells.shape[1:]) < CELLS_PER_SIDE:
            continue
        patches = cells.unfold(1, CELLS_PER_SIDE, 1).unfold(2, CELLS_PER_SIDE, 1)
        words = patches.permute(1, 2, 3, 4, 0).reshape(-1, CELLS_PER_SIDE**2 * ORIENTATIONS)
        total = words.sum(dim=1, keepdim=True)
        contrasty = total[:, 0] >= MIN_CONTRAST * CELLS_PER_SIDE**2
        words = (words / total).nan_to_num(0.0).sqrt()
        nearest = (words @ own.T - 0.5 * own.square().sum(dim=1)).argmax(dim=1)
        # A product instead of adding rows up: the order of its additions is always the same.
        membership = F.one_hot(nearest, len(own)).to(words.dtype) * contrasty[:, None]
        sums += membership.T @ words
        counts += membership.sum(dim=0)
    return sums.cpu().numpy(), counts.cpu().numpy()


def _orientation_channels(gradient: Tensor) -> Tensor:
    """Spread a gradient (2, H, W) over channels (8, H, W) by its orientation."""
    right, down = gradient
    length = torch.hypot(right, down)
    position = torch.atan2(down, right).remainder(2 * np.pi) * (ORIENTATIONS / (2 * np.pi))
    floor = position.floor()
    lower, above = floor.long(), length * (position - floor)
    channels = torch.zeros((ORIENTATIONS, *length.shape), device=gradient.device)
    channels.scatter_(0, (lower % ORIENTATIONS)[None], (length - above)[None])
    return channels.scatter_(0, ((lower + 1) % ORIENTATIONS)[None], above[None])


def _cells(channels: Tensor) -> Tensor:
    """Average channels (8, H, W) in the cells of a grid: (8, H // 4, W // 4)."""
    if min(channels.shape[1:]) < CELL_PX:
        return channels[:, :0, :0]
    weights = torch.tensor(tent(), device=channels.device)
    kernel = (weights[:, None] * weights)[None, None]
    # The middle of the kernel lies on the third pixel of a cell.
    before = len(weights) // 2 - CELL_PX // 2
    after = len(weights) - CELL_PX - before
    padded = F.pad(channels[:, None], (before, after, before, after))
    with torch.backends.cudnn.flags(allow_tf32=False):
        return F.conv2d(padded, kernel, stride=CELL_PX)[:, 0]
