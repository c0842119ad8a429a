"""Convolutional networks as OpenVINO graphs, in floats or with 8-bit weights and activations.

The graphs are made operation by operation from folded weights, never converted from a model.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import json
import os
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.convolution import Convolution

_CONVERTER = "openvino.tools.ovc"
_IMPORT_LOCK = threading.Lock()
# 255 and 256 levels are what OpenVINO turns into 8-bit integers, -127 to 127 and 0 to 255.
_WEIGHT_LEVELS, _ACTIVATION_LEVELS = 255, 256

# Smallest and largest value of what enters a convolution, by the convolution's name.
Ranges = Mapping[str, tuple[float, float]]
_MAX_ISA = "AVX512_CORE_BF16"


def import_openvino() -> tuple[ModuleType, ModuleType]:
    """Return the modules ``openvino`` and ``openvino.opset13``.

    Use this, never a plain import: the converter of models, which that would load as well, tells
    Google Analytics that it was loaded and keeps an identifier in the user's home.

    Raises:
        ImportError: it is not installed, or cannot be loaded.
    """
    with _IMPORT_LOCK:
        # OpenVINO 2026.4 crashes the process where AMX computes Fast-R2D2 in 8 bits on wide, low
        # pictures (40 x 2000, 200 x 8000). Without AMX, 8-bit features are also the same bits on
        # all processors. Read when the first network is compiled.
        os.environ.setdefault("ONEDNN_MAX_CPU_ISA", _MAX_ISA)
        converter_was_hidden = _CONVERTER not in sys.modules
        if converter_was_hidden:
            sys.modules[_CONVERTER] = None  # type: ignore[assignment]
        try:
            openvino = importlib.import_module("openvino")
            operations = importlib.import_module("openvino.opset13")
        finally:
            if converter_was_hidden:
                del sys.modules[_CONVERTER]
    return openvino, operations


def openvino_with(ranges: Ranges | None) -> str:
    """Return library and numbers, to show: ``openvino 2026.4.1, int8, calibration 04aff650``."""
    version = importlib.metadata.version("openvino")
    if ranges is None:
        return f"openvino {version}, fp32"
    calibration = hashlib.sha256(json.dumps(ranges, sort_keys=True).encode()).hexdigest()
    return f"openvino {version}, int8, calibration {calibration[:8]}"


class GraphBuilder:
    """Makes the operations of one graph.

    With ranges, the convolutions that have one are computed with 8-bit numbers: weights scaled
    for each output, activations for all of a layer together.

    Attributes:
        inputs: what enters each convolution, by its name.
    """

    def __init__(self, ranges: Ranges | None = None) -> None:
        self._openvino, self._operations = import_openvino()
        self._ranges = ranges or {}
        self.inputs: dict[str, Any] = {}

    def constant(self, values: Any) -> Any:
        """Return a float32 constant."""
        return self._operations.constant(np.asarray(values, np.float32))

    def convolution(
        self,
        x: Any,
        name: str,
        convolution: Convolution,
        *,
        relu: bool = False,
    ) -> Any:
        """Convolve x (1, I, h, w); in groups, always in floats.

        Args:
            x: what enters.
            name: of the convolution, among those of ``inputs`` and ranges.
            relu: whether negative values become zero.
        """
        self.inputs[name] = x
        weight, bias = convolution.weight, convolution.bias
        kernel = self.constant(weight)
        if name in self._ranges:
            x = self.quantized(x, name)
            largest = np.abs(weight).max(axis=(1, 2, 3), keepdims=True)
            largest = np.maximum(largest, np.finfo(np.float32).tiny)
            kernel = self._in_levels(kernel, -largest, largest, _WEIGHT_LEVELS)
        before, after = convolution.padding
        convolve = self._operations.convolution
        if convolution.groups > 1:
            convolve = self._operations.group_convolution
            kernel = self.constant(weight.reshape(convolution.groups, -1, *weight.shape[1:]))
        strides, dilations = [convolution.stride] * 2, [convolution.dilation] * 2
        x = convolve(x, kernel, strides, [before] * 2, [after] * 2, dilations)
        x = self._operations.add(x, self.constant(bias[None, :, None, None]))
        return self._operations.relu(x) if relu else x

    def quantized(self, x: Any, name: str) -> Any:
        """Round x to the 8-bit numbers that the named convolution takes, if it does.

        Rounding twice changes nothing; a pooling between may work on 8 bits then.
        """
        if name not in self._ranges:
            return x
        low, high = self._ranges[name]
        if low < 0:  # -128 to 127 steps of one size, so that zero, the padding, is exact
            low, high = -max(-low, high), max(-low, high) * 127 / 128
        high = max(high, float(np.finfo(np.float32).tiny))
        return self._in_levels(x, low, high, _ACTIVATION_LEVELS)

    def extremes(self, names: Sequence[str]) -> list[Any]:
        """Return the smallest and the largest value of what enters each named convolution."""
        axes = np.arange(4)
        return [
            reduce(self.inputs[name], axes, keep_dims=False)
            for name in names
            for reduce in (self._operations.reduce_min, self._operations.reduce_max)
        ]

    def _in_levels(self, x: Any, low: Any, high: Any, levels: int) -> Any:
        ends = self.constant(low), self.constant(high)
        return self._operations.fake_quantize(x, *ends, *ends, levels)

    def max_pool(self, x: Any) -> Any:
        """Halve the resolution; an odd last row or column is dropped."""
        sizes: tuple[Any, ...] = ([2, 2], [1, 1], [0, 0], [0, 0], [2, 2], "floor", "explicit")
        return self._operations.max_pool(x, *sizes).output(0)


class Graph:
    """A graph, compiled for the processor.

    Threads that use one take turns. It keeps room for the largest arrays that it computed.
    """

    def __init__(self, inputs: Sequence[Any], outputs: Sequence[Any], threads: int | None) -> None:
        openvino, _ = import_openvino()
        model = openvino.Model([_output(each) for each in outputs], list(inputs), "network")
        settings: dict[str, Any] = {
            "INFERENCE_PRECISION_HINT": "f32",  # bfloat16 otherwise, where the processor has it
            "PERFORMANCE_HINT": "LATENCY",
            "NUM_STREAMS": 1,
            # Each process would bind its threads to the first cores, and all would share these.
            "ENABLE_CPU_PINNING": False,
        }
        if threads is not None:
            settings["INFERENCE_NUM_THREADS"] = threads
        compiled = openvino.Core().compile_model(model, "CPU", settings)
        self._request = compiled.create_infer_request()
        self._turn = threading.Lock()

    def __call__(self, *arrays: NDArray[Any]) -> list[NDArray[Any]]:
        """Compute all outputs."""
        with self.computed(*arrays) as outputs:
            return [output.copy() for output in outputs]

    @contextmanager
    def computed(self, *arrays: NDArray[Any]) -> Iterator[list[NDArray[Any]]]:
        """Compute all outputs, for use within the ``with`` statement; other threads wait.

        Afterwards their memory is used for something else, or freed. For large ones this saves
        a copy; the same thread must not use the graph again within.
        """
        with self._turn:
            self._request.infer(list(arrays), share_inputs=True, share_outputs=True)
            yield [tensor.data for tensor in self._request.output_tensors]


def _output(operation: Any) -> Any:
    return operation.output(0) if hasattr(operation, "output") else operation
