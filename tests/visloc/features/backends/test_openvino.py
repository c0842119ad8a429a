from __future__ import annotations

import importlib
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.features.backends.openvino import Graph, import_openvino

_SIDES = (8, 256, 16)


def _doubling(*, in_8_bits: bool) -> Graph:
    """Doubles images of one channel, after rounding what enters to whole numbers if in 8 bits."""
    openvino = import_openvino()
    operations = importlib.import_module("openvino.opset13")
    x = operations.parameter([1, 1, -1, -1], np.float32, name="x")
    ends = [operations.constant(np.float32(end)) for end in (0, 255)]
    rounded = operations.fake_quantize(x, *ends, *ends, 256)
    kernel = operations.constant(np.full((1, 1, 1, 1), 2, np.float32))
    doubled = operations.convolution(rounded, kernel, [1, 1], [0, 0], [0, 0], [1, 1])
    model = openvino.Model([doubled.output(0)], [x], "doubling")
    return Graph(model, in_8_bits=in_8_bits, threads=1, computed_with="test")


@pytest.fixture
def doubling() -> Graph:
    return _doubling(in_8_bits=False)


def _image(side: int, value: float) -> NDArray[np.float32]:
    return np.full((1, 1, side, side), value, np.float32)


@pytest.mark.parametrize(("in_8_bits", "doubled"), [(True, 6), (False, 6.5)])
def test_rounding_of_a_graph_is_left_out_in_floats(in_8_bits: bool, doubled: float) -> None:
    (result,) = _doubling(in_8_bits=in_8_bits)(_image(8, 3.25))
    np.testing.assert_allclose(result, _image(8, doubled), rtol=1e-6)


def test_what_was_computed_stays_when_larger_images_follow(doubling: Graph) -> None:
    results = [doubling(_image(side, side))[0] for side in _SIDES]
    del doubling
    for side, result in zip(_SIDES, results, strict=True):
        np.testing.assert_array_equal(result, _image(side, 2 * side))


def test_threads_get_what_they_asked_for(doubling: Graph) -> None:
    asked = [(side, float(value)) for value in range(20) for side in _SIDES]
    with ThreadPoolExecutor(4) as threads:
        results = list(threads.map(lambda each: doubling(_image(*each))[0], asked))
    for (side, value), result in zip(asked, results, strict=True):
        np.testing.assert_array_equal(result, _image(side, 2 * value))


def test_others_wait_while_outputs_are_in_use(doubling: Graph) -> None:
    started = Event()

    def other() -> None:
        started.set()
        doubling(_image(256, 0))

    with ThreadPoolExecutor(1) as threads:
        with doubling.computed(_image(8, 3)) as (output,):
            waiting = threads.submit(other)
            assert started.wait(10)
            with pytest.raises(TimeoutError):
                waiting.result(timeout=0.1)
            np.testing.assert_array_equal(output, _image(8, 6))
        waiting.result(timeout=10)


def test_an_error_within_ends_the_turn(doubling: Graph) -> None:
    with pytest.raises(ValueError, match="ours"), doubling.computed(_image(8, 1)):
        raise ValueError("ours")
    np.testing.assert_array_equal(doubling(_image(8, 1))[0], _image(8, 2))


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two processors")
def test_no_thread_is_bound_to_a_processor_that_other_processes_choose_too(
    doubling: Graph,
) -> None:
    allowed, seen = os.sched_getaffinity(0), []
    with ThreadPoolExecutor(1) as pool:
        computing = pool.submit(lambda: [doubling(_image(2048, 1)) for _ in range(20)])
        while not computing.done():
            for thread in Path("/proc/self/task").iterdir():
                with suppress(ProcessLookupError):
                    seen.append(os.sched_getaffinity(int(thread.name)))
        computing.result()
    assert seen
    assert {frozenset(each) for each in seen} == {frozenset(allowed)}
