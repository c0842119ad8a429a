"""Base of the global descriptors with published weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visloc.errors import refuse
from visloc.features.backends.torch import computed_with
from visloc.features.descriptors.image_descriptor import ImageDescriptor
from visloc.features.descriptors.whitening import WHITENING_PARAMETERS, unit_rows
from visloc.features.weights.checkpoint import Checkpoint
from visloc.types import Fingerprint

# Of the photos of ImageNet, red, green, blue, in 0 to 1: all these networks began there.
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
# Of a generalized mean; the published ones are near 3. Beyond, powers leave the range of numbers.
MAX_EXPONENT = 100.0


class NetworkDescriptor(ImageDescriptor):
    """A photo's vector by a network; a subclass says how.

    Published weights with a whitening of their own give the final vector at once, and nothing is
    learned on the map; without, whitening is learned on the map as for any other descriptor.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, int | float | str],
        checkpoint: Checkpoint,
        device: torch.device,
        *,
        whitened: bool,
    ) -> None:
        self.device = device
        self.computed_with = computed_with(device)
        self.whitened = whitened
        self.fingerprint = Fingerprint(
            name,
            revision=1,
            parameters=parameters if whitened else {**parameters, **WHITENING_PARAMETERS},
            weights_sha256=checkpoint.sha256,
        )

    def learn_projection(self, pooled: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """Learn nothing if the weights whiten, else ``mean`` (R,) and ``axes`` (R, D)."""
        return {} if self.whitened else super().learn_projection(pooled)

    def project(
        self, pooled: NDArray[np.float32], model: Mapping[str, NDArray[np.float32]]
    ) -> NDArray[np.float32]:
        """Return rows (..., D) of unit length; zero rows stay zero."""
        return unit_rows(pooled) if self.whitened else super().project(pooled, model)


def without_training(checkpoint: Checkpoint, *unused: str) -> Checkpoint:
    """Return the checkpoint with the tensors and names that inference needs.

    Left out are the counters of batch norms, and tensors whose names begin with one of
    ``unused``; training on several GPUs puts ``module.`` into names.
    """
    tensors = {
        name.replace("module.", ""): array
        for name, array in checkpoint.tensors.items()
        if not name.endswith("num_batches_tracked")
    }
    kept = {name: array for name, array in tensors.items() if not name.startswith(unused)}
    return replace(checkpoint, tensors=kept)


def shrunk_size(height: int, width: int, max_long_side_px: int) -> tuple[int, int]:
    """Return (height, width) of a photo shrunk to fit; a smaller one stays as it is."""
    scale = min(1.0, max_long_side_px / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def normalized(rgb: NDArray[np.uint8], size: tuple[int, int], device: torch.device) -> Tensor:
    """Return (1, 3, height, width) of a photo (H, W, 3) resized to ``size``: (x - MEAN) / STD."""
    height, width = size
    pixels = np.ascontiguousarray(rgb)
    if (height, width) != pixels.shape[:2]:
        shrinks = height < pixels.shape[0] or width < pixels.shape[1]
        method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        pixels = cv2.resize(pixels, (width, height), interpolation=method).astype(np.uint8)
    image = torch.tensor(pixels, device=device).permute(2, 0, 1)[None].float() / 255.0
    mean, std = (torch.tensor(each, device=device)[:, None, None] for each in (MEAN, STD))
    return ((image - mean) / std).contiguous(memory_format=torch.channels_last)


def exponent_of(checkpoint: Checkpoint, name: str) -> float:
    """Return the learned exponent of a generalized mean from its tensor (1,)."""
    exponent = float(checkpoint.tensors[name][0])
    if not 0.0 < exponent <= MAX_EXPONENT:
        raise refuse(
            "weights.values",
            f"the tensor {name} is not an exponent of a generalized mean",
            field=str(checkpoint.path),
            expected=f"more than 0, at most {MAX_EXPONENT:g}",
            got=str(exponent),
        )
    return exponent


def linear_layer(
    checkpoint: Checkpoint, name: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return copies of the weight (O, I) and bias (O,) of a fully connected layer."""
    weight, bias = (checkpoint.tensors[f"{name}.{part}"] for part in ("weight", "bias"))
    return np.array(weight, np.float32), np.array(bias, np.float32)
