"""VLAD of RootSIFT on a dense grid at several scales: sees walls where keypoints see nothing.

After Torii et al., "24/7 place recognition by view synthesis" (CVPR 2015): it lives through
changes of light better than descriptors at keypoints. RootSIFT: Arandjelovic and Zisserman, "Three
things everyone should know to improve object retrieval" (CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from visloc.features.base import Fingerprint, GlobalDescriptor
from visloc.features.descriptors.vlad import (
    CELL_PX,
    CELLS_PER_SIDE,
    MIN_CONTRAST,
    ORIENTATIONS,
    VLAD_PARAMETERS,
    VladDescriptor,
    tent,
    vlad_of_sums,
)
from visloc.options import Inference
from visloc.runtime.device import has_cuda, torch_device
from visloc.types import LocalFeatures

if TYPE_CHECKING:
    import torch

# Width of a cell in pixels of the photo at its working size. Coarser ones than the 4 to 10 px of
# the paper found more of the nearest views in three places, with a quarter of the words.
CELL_SIZES_PX = (8, 12, 16)
WORKING_SIZE_PX = 640
SMOOTHING_SIGMA_PX = 0.7


def load_densevlad(
    _weights_dir: Path | None = None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> GlobalDescriptor:
    """Make the descriptor, which needs no weights; a CUDA GPU computes it where there is one."""
    return DenseVlad(torch_device() if has_cuda() else None)


class DenseVlad(VladDescriptor):
    """A photo's words are RootSIFT descriptors (128) of overlapping patches all over it.

    Args:
        device: of torch, which sums words up; None for NumPy, which is the reference.
    """

    fingerprint = Fingerprint(
        "densevlad",
        revision=1,
        parameters={
            "cell_sizes_px": ",".join(map(str, CELL_SIZES_PX)),
            "working_size_px": WORKING_SIZE_PX,
            "cell_px": CELL_PX,
            "smoothing_sigma_px": SMOOTHING_SIGMA_PX,
            "min_contrast": MIN_CONTRAST,
            **VLAD_PARAMETERS,
        },
    )
    needs_image = True  # words lie on a grid, not at keypoints
    needs_local_features = False

    def __init__(self, device: torch.device | None = None) -> None:
        self._device = device
        if device is not None:
            from visloc.features.backends.torch import computed_with

            self.computed_with = computed_with(device)

    def pool(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,
        vocabulary: Mapping[str, NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        """Aggregate one photo; see ``VladDescriptor.pool``."""
        centres = vocabulary["vocabulary"]
        if self._device is None or len(centres) == 0:
            return super().pool(rgb, local, vocabulary)
        from visloc.features.descriptors.densevlad_torch import sums_of_words

        shrunk = [gradient(grey) for grey in shrunk_greys(rgb)]
        return vlad_of_sums(*sums_of_words(self._device, shrunk, centres), centres)

    def words(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,  # noqa: ARG002 - words are taken everywhere, not at keypoints
    ) -> NDArray[np.float32]:
        """Return RootSIFT (n, 128) of the photo's patches that have contrast."""
        return dense_root_sift(rgb)


def dense_root_sift(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Describe a photo (H, W, 3) by RootSIFT rows (n, 128) of unit length.

    The photo is shrunk to 640 px on its longer side (never enlarged), then, for each cell size,
    further until a cell has 4 px. A patch has 4 x 4 cells and starts at every cell. Patches
    without contrast are left out; a photo smaller than the smallest patch has none.

    Columns: cell row, cell column, orientation of the gradient (0 to the right, then clockwise
    in steps of 45 degrees, as y points down).
    """
    cells = [_cells(orientation_channels(grey)) for grey in shrunk_greys(rgb)]
    patches = [_patches(each) for each in cells if min(each.shape[:2]) >= CELLS_PER_SIDE]
    counts = [each.shape[0] * each.shape[1] for each in patches]
    words = np.empty((sum(counts), CELLS_PER_SIDE**2 * ORIENTATIONS), np.float32)
    for rows, each in zip(np.split(words, np.cumsum(counts)), patches, strict=False):
        rows.reshape(each.shape)[...] = each
    # Summed over orientations, a cell is the mean length of its gradients.
    total = words.sum(axis=1)
    contrasty = total >= MIN_CONTRAST * CELLS_PER_SIDE**2
    kept: NDArray[np.float32] = words[contrasty]
    kept /= total[contrasty, None]
    return np.sqrt(kept, out=kept)


def shrunk_greys(rgb: NDArray[np.uint8]) -> list[NDArray[np.float32]]:
    """Return a photo (H, W, 3) in grey for each cell size; none of one too small for a patch."""
    height, width = rgb.shape[:2]
    if min(height, width) < min(CELL_SIZES_PX) * CELLS_PER_SIDE:
        return []
    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY).astype(np.float32)
    working_scale = min(1.0, WORKING_SIZE_PX / max(height, width))
    return [_shrunk(grey, working_scale * CELL_PX / size) for size in CELL_SIZES_PX]


def _shrunk(grey: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    height, width = (max(1, round(side * scale)) for side in grey.shape)
    shrunk = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    return shrunk.astype(np.float32, copy=False)


def _patches(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return views of the patch that starts at each cell of (h, w, 8): (h - 3, w - 3, 4, 4, 8)."""
    windows = sliding_window_view(cells, (CELLS_PER_SIDE, CELLS_PER_SIDE), axis=(0, 1))
    return windows.transpose(0, 1, 3, 4, 2)


def orientation_channels(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """Spread the gradient of a grey image (H, W) over channels (H, W, 8) by its orientation.

    The length of the gradient, as the difference of the neighbours on either side, is divided
    linearly between the two nearest of the orientations 0, 45, ..., 315 degrees.
    """
    length, angle = (
        part.astype(np.float32, copy=False).ravel() for part in cv2.cartToPolar(*gradient(grey))
    )
    position = angle * np.float32(ORIENTATIONS / (2 * np.pi))
    lower = position.astype(np.int32)  # rounds down: no angle is negative
    above = length * (position - lower.astype(np.float32))
    # One index into a long row takes half the time of two, and so does a mask beside a remainder.
    first = np.arange(0, grey.size * ORIENTATIONS, ORIENTATIONS, dtype=np.int32)
    channels = np.zeros(grey.size * ORIENTATIONS, np.float32)
    channels[first + (lower & (ORIENTATIONS - 1))] = length - above
    channels[first + ((lower + 1) & (ORIENTATIONS - 1))] = above
    return channels.reshape(*grey.shape, ORIENTATIONS)


def gradient(grey: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return how a grey image (H, W), smoothed, changes to the right and down, each (H, W)."""
    smooth = cv2.GaussianBlur(grey, (0, 0), SMOOTHING_SIGMA_PX)
    right = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1)
    return np.asarray(right, np.float32), np.asarray(down, np.float32)


def _cells(channels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Average channels (H, W, 8) in the cells of a grid: (H // 4, W // 4, 8).

    A tent twice as wide as a cell: a pixel counts for the cells on both sides, by its distance
    to their centres, so that a small shift changes little.
    """
    weights = tent()
    averaged = cv2.sepFilter2D(
        channels, cv2.CV_32F, weights, weights, borderType=cv2.BORDER_CONSTANT
    )
    height, width = (side // CELL_PX * CELL_PX for side in channels.shape[:2])
    centre = CELL_PX // 2
    return averaged[centre:height:CELL_PX, centre:width:CELL_PX].astype(np.float32, copy=False)
