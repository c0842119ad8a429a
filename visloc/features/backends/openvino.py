"""Networks as graphs in OpenVINO's own format, computed in floats or in 8 bits."""

from __future__ import annotations

import importlib
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

_CONVERTER = "openvino.tools.ovc"
_IMPORT_LOCK = threading.Lock()
_MAX_ISA = "AVX512_CORE_BF16"
ROUNDING = "FakeQuantize"  # the type of the operations that round to 8 bits


def import_openvino() -> ModuleType:
    """Return the module ``openvino``.

    Use this, never a plain import: the converter of models, which that would load as well, tells
    Google Analytics that it was loaded and keeps an identifier in the user's home.
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
            return importlib.import_module("openvino")
        finally:
            if converter_was_hidden:
                del sys.modules[_CONVERTER]


class Graph:
    """A graph, compiled for the processor.

    Threads that use one take turns. It keeps room for the largest arrays that it computed.

    Args:
        in_8_bits: whether to round as the graph says; if not, all is computed in floats.
        threads: of the processor; None for all.
    """

    def __init__(
        self, model: Any, *, in_8_bits: bool, threads: int | None, computed_with: str
    ) -> None:
        self.computed_with = computed_with
        if not in_8_bits:
            for operation in model.get_ops():
                if operation.get_type_name() == ROUNDING:
                    operation.output(0).replace(operation.input_value(0))
        settings: dict[str, Any] = {
            "INFERENCE_PRECISION_HINT": "f32",  # bfloat16 otherwise, where the processor has it
            "PERFORMANCE_HINT": "LATENCY",
            "NUM_STREAMS": 1,
            # Each process would bind its threads to the first cores, and all would share these.
            "ENABLE_CPU_PINNING": False,
        }
        if threads is not None:
            settings["INFERENCE_NUM_THREADS"] = threads
        compiled = import_openvino().Core().compile_model(model, "CPU", settings)
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
            self._request.infer(
                [np.ascontiguousarray(array) for array in arrays],
                share_inputs=True,
                share_outputs=True,
            )
            yield [tensor.data for tensor in self._request.output_tensors]
