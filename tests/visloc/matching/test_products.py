from __future__ import annotations

import subprocess
import sys
import threading

import numpy as np
import pytest
import torch

from visloc.matching import products
from visloc.matching.products import block_rows, in_threads, round_descriptors, row_products


def test_eight_bits_are_within_half_a_step() -> None:
    rows = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 8)).astype(np.float32)
    rows[3, 4] = -0.5
    quantized = round_descriptors(rows)
    assert quantized.scale == pytest.approx(0.5 / 127)
    assert quantized.rows.min() == -127
    assert np.abs(quantized.rows * quantized.scale - rows).max() <= 0.5001 * quantized.scale


@pytest.mark.parametrize("shape", [(0, 4), (3, 4)])
def test_nothing_and_zeros_stay_what_they_are(shape: tuple[int, int]) -> None:
    quantized = round_descriptors(np.zeros(shape, np.float32))
    assert quantized.rows.shape == shape
    assert not quantized.rows.any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_descriptors_that_are_not_finite_are_a_bug(value: float) -> None:
    with pytest.raises(ValueError, match="not finite"):
        round_descriptors(np.array([[0.5, value]], np.float32))


@pytest.mark.parametrize("lost", ["_int_mm", "_is_vnni_supported"])
def test_without_its_private_names_torch_multiplies_floats(
    monkeypatch: pytest.MonkeyPatch, lost: str
) -> None:
    monkeypatch.delattr(torch if lost == "_int_mm" else torch.cpu, lost)
    products._has_integer_products.cache_clear()
    try:
        assert not products._has_integer_products()
        rows = np.full((2, 64), -128, np.int8)
        assert (row_products(rows, rows, 2)(slice(0, 2)) == 2**20).all()
    finally:
        products._has_integer_products.cache_clear()


@pytest.mark.parametrize("dim", [1024, 1025, 131_071, 131_072])
def test_the_largest_sums_are_exact(monkeypatch: pytest.MonkeyPatch, dim: int) -> None:
    rows = np.full((3, dim), -128, np.int8)
    rows[0, 0] = 127
    largest = dim * 2**14
    expected = [largest - 128 * 255, largest]
    assert row_products(rows[:2], rows[1:], 2)(slice(0, 2))[:, 0].tolist() == expected
    monkeypatch.setattr(products, "_has_integer_products", lambda: False)
    assert row_products(rows[:2], rows[1:], 2)(slice(0, 2))[:, 0].tolist() == expected


@pytest.mark.parametrize("columns", [1, 40, 1500, 2751, 5000])
def test_a_block_of_products_fits_into_a_megabyte(columns: int) -> None:
    rows = block_rows(columns)
    assert rows % 32 == 0
    assert 0.5 <= rows * columns * 4 / 2**20 <= 1.0


def test_a_block_has_rows_however_many_columns() -> None:
    assert block_rows(10**7) == 32


def test_work_in_threads_keeps_its_order_and_leaves_torch_as_it_was() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        both = threading.Barrier(2, timeout=10)

        def work(item: int) -> tuple[int, int]:
            both.wait()
            return item, torch.get_num_threads()

        assert in_threads(work, range(4)) == [(item, 1) for item in range(4)]
        seen: list[int] = []
        new = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
        new.start()
        new.join()
        assert (torch.get_num_threads(), seen) == (2, [2])
    finally:
        torch.set_num_threads(before)


def test_a_forked_child_starts_threads_of_its_own() -> None:
    script = """
import os, signal, torch
from visloc.matching.products import in_threads
torch.set_num_threads(2)
assert in_threads(abs, [-1, -2]) == [1, 2]
child = os.fork()
if child == 0:
    signal.alarm(60)  # ends a child that waits for its parent's threads
    os._exit(in_threads(abs, [-3, -4]) != [3, 4])
assert os.waitpid(child, 0)[1] == 0
"""
    subprocess.run([sys.executable, "-W", "ignore", "-c", script], check=True)


def test_threads_that_ask_at_the_same_time_share_one_set_of_them() -> None:
    script = """
import threading, torch
from visloc.matching.products import start_threads
torch.set_num_threads(3)
asking = [threading.Thread(target=start_threads) for _ in range(8)]
for thread in asking:
    thread.start()
for thread in asking:
    thread.join()
assert sum(each.name.startswith("matching") for each in threading.enumerate()) == 3
"""
    subprocess.run([sys.executable, "-W", "ignore", "-c", script], check=True)


def test_no_more_threads_work_than_torch_uses_and_none_are_started_for_fewer() -> None:
    script = """
import threading, time, torch
from visloc.matching.products import in_threads
working, most, lock = 0, 0, threading.Lock()

def work(item):
    global working, most
    with lock:
        working += 1
        most = max(most, working)
    time.sleep(0.01)
    with lock:
        working -= 1
    return item

for count in (4, 3, 2, 4):
    torch.set_num_threads(count)
    most = 0
    assert in_threads(work, range(12)) == list(range(12))
    assert most <= count, (most, count)
    assert torch.get_num_threads() == count
assert sum(each.name.startswith("matching") for each in threading.enumerate()) == 4
"""
    subprocess.run([sys.executable, "-W", "ignore", "-c", script], check=True)
