"""A step that is recorded once and played again: a GPU then waits for no launch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_FIRST_STEPS = 4  # without recording: libraries choose their kernels


class RecordedStep:
    """A step on a CUDA device that runs the same kernels each time, on other numbers.

    The step takes numbers on the device and returns a tensor. It must not wait for the device, and
    must keep what it changes (weights, states of an optimizer) where it is. What it computes it
    computes in every call, also in the one that records.
    """

    def __init__(self, step: Callable[[Tensor], Tensor]) -> None:
        self._step = step
        self._done = 0
        self._graph = torch.cuda.CUDAGraph()
        self._numbers: Tensor | None = None
        self._result: Tensor | None = None

    def __call__(self, numbers: Tensor) -> Tensor:
        """Do the step with numbers that are on the processor."""
        if self._numbers is None:
            self._numbers = torch.empty_like(numbers, device="cuda")
        # The memory is kept until the copy is done: PyTorch's allocator sees to that.
        self._numbers.copy_(numbers.pin_memory(), non_blocking=True)
        if self._done < _FIRST_STEPS:
            self._done += 1
            return self._aside()
        if self._result is None:
            with torch.cuda.graph(self._graph):
                self._result = self._step(self._numbers)
        self._graph.replay()
        return self._result.clone()

    def _aside(self) -> Tensor:
        """Do the step on another stream, as recording does."""
        assert self._numbers is not None
        stream, current = torch.cuda.Stream(), torch.cuda.current_stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            result = self._step(self._numbers)
        current.wait_stream(stream)
        return result
