"""R2D2 and Fast-R2D2 in torch, as ``architecture`` says what they are.

This is the network of CUDA GPUs, the one that training makes, and the one of which graphs for
OpenVINO are made.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from visloc.features.backends.torch import computed_with, for_inference, load_strictly, shapes_of
from visloc.features.networks.r2d2.architecture import (
    ARCHITECTURES,
    DESCRIPTOR_DIM,
    MEAN,
    STD,
    Architecture,
)
from visloc.features.networks.r2d2.extractor import Seen
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.runtime.device import torch_device

_BASE_WIDTH, _MAX_BASE_WIDTH = 32, 1024
_STRIP_ROWS = 32  # rows of x that the heads see at a time: bounds their memory


class R2D2Network(nn.Module):
    """R2D2 or Fast-R2D2 with batch norms without gain and shift, after every convolution but one.

    ``convolutions.N`` and ``batch_norms.N`` count the layers from 0; ``heads`` goes from x^2 to
    the logits of reliability and repeatability. Softmax over two logits, as the paper has it,
    knows only their difference: one logit and a sigmoid are the same.
    """

    def __init__(self, architecture: Architecture, base_width: int = _BASE_WIDTH) -> None:
        super().__init__()
        self.architecture = architecture
        convolutions, batch_norms = [], []
        inputs = 3
        for layer in architecture.layers:
            outputs = layer.width * base_width or DESCRIPTOR_DIM
            convolutions.append(
                nn.Conv2d(
                    inputs, outputs, layer.kernel, dilation=layer.dilation, padding=layer.padding
                )
            )
            if layer.normalized:
                batch_norms.append(nn.BatchNorm2d(outputs, affine=False))
            inputs = outputs
        self.convolutions = nn.ModuleList(convolutions)
        self.batch_norms = nn.ModuleList(batch_norms)
        self.heads = nn.Conv2d(DESCRIPTOR_DIM, 2, 1)

    def fuse(self) -> R2D2Network:
        """Put the batch norms into the convolutions."""
        self.eval()
        for number, batch_norm in enumerate(self.batch_norms):
            convolution = self.convolutions[number]
            assert isinstance(convolution, nn.Conv2d)
            assert isinstance(batch_norm, nn.BatchNorm2d)
            self.convolutions[number] = fuse_conv_bn_eval(convolution, batch_norm)
            self.batch_norms[number] = nn.Identity()
        return self

    def features(self, x: Tensor) -> Tensor:
        """Return x, (B, 128, H // stride, W // stride), for normalized images (B, 3, H, W)."""
        for number, layer in enumerate(self.architecture.layers):
            x = self.convolutions[number](x)
            if layer.normalized:
                x = self.batch_norms[number](x)
            if layer.relu:
                x = F.relu(x)
            if number + 1 == self.architecture.pool_after:
                x = F.max_pool2d(x, 2)
        return x

    def logits(self, features: Tensor) -> Tensor:
        """Return (2, H, W) logits of reliability and repeatability, at full resolution."""
        rows, stride = features.shape[2], self.architecture.stride
        strips = []
        for top in range(0, rows, _STRIP_ROWS):
            bottom = min(top + _STRIP_ROWS, rows)
            if stride == 1:
                strip = features[:, :, top:bottom]
            else:  # one row more on either side makes the strips' seams exact
                first = max(top - 1, 0)
                strip = F.interpolate(
                    features[:, :, first : bottom + 1],
                    scale_factor=stride,
                    mode="bilinear",
                    align_corners=False,
                )
                strip = strip[:, :, stride * (top - first) : stride * (bottom - first)]
            strips.append(self.heads(strip.square()))
        return torch.cat(strips, dim=2)[0]

    def descriptors(self, features: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Return unit rows (N, 128) for pixels (x, y) of the full-resolution maps."""
        grid, stride = features[0].permute(1, 2, 0), self.architecture.stride
        if stride == 1:
            return F.normalize(grid[y, x], dim=1)
        left, right, x_weight = _neighbours(x, stride, grid.shape[1])
        above, below, y_weight = _neighbours(y, stride, grid.shape[0])
        upper = torch.lerp(grid[above, left], grid[above, right], x_weight)
        lower = torch.lerp(grid[below, left], grid[below, right], x_weight)
        return F.normalize(torch.lerp(upper, lower, y_weight), dim=1)


def normalized(pixels: Tensor) -> Tensor:
    """Return images (B, 3, H, W) as the network sees them, of RGB (B, H, W, 3) in 0 to 255."""
    mean, std = (torch.tensor(each, device=pixels.device)[:, None, None] for each in (MEAN, STD))
    return (pixels.permute(0, 3, 1, 2) - mean) / std


def _neighbours(index: Tensor, stride: int, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return both neighbours at low resolution and the second one's weight, (N,), (N,), (N, 1)."""
    position = ((index + 0.5) / stride - 0.5).clamp(0, size - 1)
    lower = position.floor()
    upper = (lower + 1).clamp(max=size - 1)
    return lower.long(), upper.long(), (position - lower)[:, None]


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, network: R2D2Network) -> None:
        self._device = torch_device()
        self._network = network.to(self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, image: NDArray[np.float32]) -> contextlib.AbstractContextManager[Seen]:
        """Look at RGB (H, W, 3) in 0 to 255."""
        pixels = torch.tensor(image, device=self._device)[None]
        half = torch.autocast("cuda") if self._device.type == "cuda" else contextlib.nullcontext()
        with half:
            features = self._network.features(
                normalized(pixels).contiguous(memory_format=torch.channels_last)
            )
        # The heads square x: that is beyond the range of half precision.
        features = features.float()
        # One map after the other, as looking for peaks reads them.
        logits = self._network.logits(features).contiguous()

        @torch.inference_mode()
        def descriptors(x: NDArray[np.intp], y: NDArray[np.intp]) -> NDArray[np.float32]:
            columns, rows = (torch.from_numpy(each).to(self._device) for each in (x, y))
            found: NDArray[np.float32] = (
                self._network.descriptors(features, columns, rows).cpu().numpy()
            )
            return found

        return contextlib.nullcontext(Seen(logits.cpu().numpy(), descriptors))


def read_network(
    architecture: Architecture, path: Path, *, sha256: str | None = None
) -> tuple[R2D2Network, str]:
    """Return the network for inference and its file's sha256: of a file of our own, or published.

    Args:
        sha256: of the only file that will do.
    """
    checkpoint = read_checkpoint(path, sha256=sha256)
    is_own = path.suffix == ".safetensors"
    named = _own_names(architecture, checkpoint) if is_own else _published(architecture, checkpoint)
    held = "another network" if is_own else _held(checkpoint)
    network = _empty(architecture, named)
    if is_own:
        network.fuse()
    load_strictly(network, named, network_name=architecture.published.network, held=held)
    return for_inference(network if is_own else network.fuse()), checkpoint.sha256


def pack(network: R2D2Network) -> dict[str, NDArray[Any]]:
    """Return the tensors of a file of our own: weights in 16 bits, biases in 32.

    ``NAME.convolutions.N.weight`` and ``.bias`` count from 0; ``NAME.heads.weight`` is (2, 128).
    """
    arrays = {name: tensor.cpu().numpy() for name, tensor in network.state_dict().items()}
    arrays["heads.weight"] = arrays["heads.weight"][:, :, 0, 0]
    return {
        f"{network.architecture.name}.{name}": np.ascontiguousarray(
            array, np.float16 if name.endswith(".weight") else np.float32
        )
        for name, array in arrays.items()
    }


def _own_names(architecture: Architecture, checkpoint: Checkpoint) -> Checkpoint:
    """Return the checkpoint with the names and shapes of ``R2D2Network``."""
    named = checkpoint.renamed(lambda name: name.removeprefix(f"{architecture.name}."))
    heads = named.tensors.get("heads.weight")
    if heads is None or heads.ndim != 2:
        return named
    return replace(named, tensors={**named.tensors, "heads.weight": heads[:, :, None, None]})


def _empty(architecture: Architecture, checkpoint: Checkpoint) -> R2D2Network:
    """Return a network without values, as wide as the checkpoint's."""
    first = checkpoint.tensors.get("convolutions.0.weight")
    width = _BASE_WIDTH if first is None or not first.ndim else len(first)
    with torch.device("meta"):
        # A file may declare more than it has.
        return R2D2Network(architecture, min(width, _MAX_BASE_WIDTH))


def _published(architecture: Architecture, checkpoint: Checkpoint) -> Checkpoint:
    """Return a published checkpoint with the names of ``R2D2Network``; other names stay."""
    ours = {published: name for name, published in _published_names(architecture).items()}

    def name_of(name: str) -> str:
        # Training on several GPUs puts "module." before every name.
        module, _, part = name.removeprefix("module.").rpartition(".")
        return f"{ours.get(module, module)}.{part}" if module else name

    tensors = dict(checkpoint.renamed(name_of).tensors)
    for part in ("weight", "bias"):
        clf, sal = (tensors.get(f"{head}.{part}") for head in ("clf", "sal"))
        if clf is not None and sal is not None and len(clf) == 2 and clf[:1].shape == sal.shape:
            del tensors[f"clf.{part}"], tensors[f"sal.{part}"]
            clf, sal = clf.astype(np.float64), sal.astype(np.float64)
            tensors[f"heads.{part}"] = np.concatenate([clf[1:] - clf[:1], sal])
    return replace(checkpoint, tensors=tensors)


def _published_names(architecture: Architecture) -> dict[str, str]:
    """Return the published name of each module but the heads."""
    names, step = {}, 0
    for number, layer in enumerate(architecture.layers):
        names[f"convolutions.{number}"] = f"ops.{step}"
        if layer.normalized:
            names[f"batch_norms.{number}"] = f"ops.{step + 1}"
        step += 1 + layer.normalized + layer.relu + (number + 1 == architecture.pool_after)
    return names


def _held(checkpoint: Checkpoint) -> str:
    """Return the network whose published names a checkpoint has."""
    for each in ARCHITECTURES.values():
        named = _published(each, checkpoint)
        if set(named.tensors) == set(shapes_of(_empty(each, named))):
            return each.published.network
    return "another network"
