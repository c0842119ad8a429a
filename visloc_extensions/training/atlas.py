"""Photos of all sizes in one strip of pixels, so that one operation looks at many of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visloc_extensions.training.homographies import (
    Matrices,
    applied,
    pixel_centres,
    scaled_and_moved,
    scales,
)
from visloc_extensions.training.photos import Photo


@dataclass(frozen=True, slots=True, eq=False)
class Atlas:
    """Photos, each with halves of itself.

    Attributes:
        pixels: (N, 3) uint8 RGB: every level of every photo, row by row.
        begins: (photos, levels) the first pixel of each level.
        sizes: (photos, levels, 2) its height and width.
        levels: (photos,) how many a photo has.
    """

    pixels: Tensor
    begins: NDArray[np.int64]
    sizes: NDArray[np.int64]
    levels: NDArray[np.int64]


def make_atlas(photos: Sequence[Photo], device: torch.device) -> Atlas:
    """Put photos into one strip on the device."""
    levels = np.array([len(photo.levels) for photo in photos])
    shape = (len(photos), int(levels.max()))
    begins, sizes = np.zeros(shape, np.int64), np.ones((*shape, 2), np.int64)
    strips, count = [], 0
    for number, photo in enumerate(photos):
        for level, picture in enumerate(photo.levels):
            begins[number, level] = count
            sizes[number, level] = picture.shape[1:]
            strips.append(picture.permute(1, 2, 0).reshape(-1, 3))
            count += len(strips[-1])
    return Atlas(torch.cat(strips).to(device), begins, sizes, levels)


def levels_to_look_at(
    atlas: Atlas, photos: NDArray[np.int64], photo_from_crop: Matrices, crop_px: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Matrices]:
    """Choose for each look (n,) the level whose pixels are about as large as the crop's.

    Returns:
        First pixels (n,) of the levels, their sizes (n, 2), and level_from_crop (n, 3, 3).
    """
    halvings = np.rint(np.log2(scales(photo_from_crop, crop_px))).astype(np.int64)
    level = np.clip(halvings, 0, atlas.levels[photos] - 1)
    sizes = atlas.sizes[photos, level]
    shrunk = (sizes / atlas.sizes[photos, 0])[:, ::-1]
    level_from_photo = scaled_and_moved(shrunk, np.zeros_like(shrunk))
    return atlas.begins[photos, level], sizes, level_from_photo @ photo_from_crop


def look(
    pixels: Tensor, begins: Tensor, sizes: Tensor, level_from_crop: Tensor, crop_px: int
) -> Tensor:
    """Return what cameras see, (n, 3, H, W) float32 in 0 to 1; photos are mirrored beyond edges.

    Args:
        pixels: of an atlas.
        begins: (n,) int64.
        sizes: (n, 2) int64.
        level_from_crop: (n, 3, 3) float64.
    """
    places = applied(level_from_crop, pixel_centres(crop_px, pixels.device)) - 0.5
    corner = places.floor()
    right, below = (places - corner).float()[..., None].unbind(dim=3)
    column, row = corner.long().unbind(dim=-1)
    height, width = sizes[:, 0, None, None], sizes[:, 1, None, None]

    def at(x: Tensor, y: Tensor) -> Tensor:
        inside = _mirrored(y, height) * width + _mirrored(x, width)
        return pixels[begins[:, None, None] + inside].float()

    above = at(column, row) * (1 - right) + at(column + 1, row) * right
    under = at(column, row + 1) * (1 - right) + at(column + 1, row + 1) * right
    return ((above * (1 - below) + under * below) / 255).permute(0, 3, 1, 2).contiguous()


def _mirrored(index: Tensor, size: Tensor) -> Tensor:
    index = index % (2 * size)
    return torch.minimum(index, 2 * size - 1 - index)
