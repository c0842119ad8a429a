"""The hardware's limit: the best rates that this machine gives in each precision.

Networks and matching are products and little else. What they need of those, divided by the rate
measured here, is the least time that they could take on this machine.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from visloc.features.backends.openvino import import_openvino

# What each rate is of, in the order of the table.
RATES: Mapping[str, str] = {
    "product_fp32": "product of matrices, fp32, NumPy: 2048 x 2048 x 2048",
    "product_int8": "product of matrices, int8, `torch._int_mm`: blocks of 512 x 4000 x 128",
    "convolution_fp32": "convolution, fp32, OpenVINO",
    "convolution_bf16": "convolution, bf16, OpenVINO",
    "convolution_int8": "convolution, int8, OpenVINO",
    "copy": "copy of 256 MiB, bytes read and written",
}
_SECONDS_EACH = 2.0  # how long each rate is measured; the best run of them counts
_CHAIN = 4  # convolutions in a row: what enters and leaves costs little beside them


@dataclass(frozen=True, slots=True)
class Network:
    """What a local feature's network costs, and a layer that is typical of it.

    Attributes:
        gflop_per_megapixel: two operations for each product and sum.
        channels, height, width, dilation: of a 3 x 3 convolution within, for 640 x 480 photos.
        patch_px: what a descriptor of scale 1 describes, where photos are looked at at several
            scales; None where at one.
    """

    gflop_per_megapixel: float
    channels: int
    height: int
    width: int
    dilation: int
    patch_px: float | None

    @property
    def layer(self) -> str:
        """The typical layer in words."""
        return f"3 x 3, {self.channels} channels, {self.width} x {self.height}"


# R2D2's were counted from the layers' sizes; XFeat's too: 4267.5 products per pixel.
NETWORKS: Mapping[str, Network] = {
    "r2d2": Network(967.0, 128, 480, 640, 4, 32.0),
    "faster2d2": Network(285.0, 128, 240, 320, 2, 32.0),
    "xfeat": Network(8.535, 64, 60, 80, 1, None),
}


def measure_rates(network: Network, threads: int, *, bf16: bool) -> dict[str, float]:
    """Measure the rates by name, operations or bytes per second."""
    torch.set_num_threads(threads)
    rates = {
        "product_fp32": _fp32_products(),
        "product_int8": _int8_products(),
        "convolution_fp32": _convolutions(network, threads, "f32", quantized=False),
        "convolution_int8": _convolutions(network, threads, "f32", quantized=True),
        "copy": _copy(),
    }
    if bf16:
        rates["convolution_bf16"] = _convolutions(network, threads, "bf16", quantized=False)
    return rates


def megapixels(network: Network, width: int, height: int, scales: np.ndarray) -> float:
    """Pixels that the network looks at in one photo, in millions.

    Args:
        network: of the local features.
        width: of the photo, pixels.
        height: of the photo, pixels.
        scales: of its keypoints, as ``LocalFeatures`` has them: they tell the levels.
    """
    if network.patch_px is None:
        return width * height / 1e6
    levels = network.patch_px / np.unique(np.round(scales, 3))
    return float((width * height * levels**2).sum() / 1e6)


def _best_rate(work: float, run: Callable[[], object]) -> float:
    """Work per second of the quickest run; the first does not count."""
    run()
    best, end = np.inf, time.perf_counter() + _SECONDS_EACH
    while time.perf_counter() < end:
        started = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - started)
    return float(work / best)


def _fp32_products() -> float:
    side = 2048
    left, right = np.random.default_rng(0).normal(size=(2, side, side)).astype(np.float32)
    out = np.empty((side, side), np.float32)
    return _best_rate(2 * side**3, lambda: np.matmul(left, right, out=out))


def _int8_products() -> float:
    rows, columns, dim = 512, 4000, 128
    left = torch.randint(-127, 127, (rows, dim), dtype=torch.int8)
    right = torch.randint(-127, 127, (columns, dim), dtype=torch.int8).t()
    packed = right.contiguous()
    out = torch.empty((rows, columns), dtype=torch.int32)
    product: Any = torch._int_mm  # the one way to it; its layouts differ in speed by the version
    work = 2 * rows * columns * dim
    return max(
        _best_rate(work, lambda: product(left, right, out=out)),
        _best_rate(work, lambda: product(left, packed, out=out)),
    )


def _convolutions(network: Network, threads: int, precision: str, *, quantized: bool) -> float:
    openvino = import_openvino()
    ov_ops = importlib.import_module("openvino.opset13")
    channels, height, width = network.channels, network.height, network.width
    random = np.random.default_rng(0)
    shape = [1, channels, height, width]
    image = ov_ops.parameter(shape, np.float32)
    node = image
    for _ in range(_CHAIN):
        weights = random.normal(size=(channels, channels, 3, 3)).astype(np.float32)
        weights /= np.sqrt(9 * channels / 2)  # as strong behind each layer as before it
        kernel = ov_ops.constant(weights)
        if quantized:
            limit = float(np.abs(weights).max())
            node = ov_ops.fake_quantize(node, 0.0, 4.0, 0.0, 4.0, 256)
            kernel = ov_ops.fake_quantize(kernel, -limit, limit, -limit, limit, 255)
        pads = [network.dilation, network.dilation]
        dilations = [network.dilation, network.dilation]
        node = ov_ops.relu(ov_ops.convolution(node, kernel, [1, 1], pads, pads, dilations))
    # The smallest of each channel: that little leaves the graph.
    model = openvino.Model([ov_ops.reduce_min(node, np.array([2, 3]))], [image], "convolutions")
    settings = {
        "INFERENCE_PRECISION_HINT": precision,
        "INFERENCE_NUM_THREADS": threads,
        "NUM_STREAMS": 1,
    }
    request = openvino.Core().compile_model(model, "CPU", settings).create_infer_request()
    tensor = openvino.Tensor(random.uniform(0, 2, shape).astype(np.float32))
    request.set_input_tensor(tensor)
    work = _CHAIN * 2 * 9 * channels**2 * height * width
    return _best_rate(work, request.infer)


def _copy() -> float:
    source = torch.ones(2**26)
    target = torch.empty_like(source)
    return _best_rate(2 * source.nbytes, lambda: target.copy_(source))
