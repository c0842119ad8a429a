"""How many threads a process computes with, whether torch is loaded before or after it was said."""

from __future__ import annotations

import subprocess
import sys

import cv2
import pytest
import torch

from visloc.threads import count_of_threads, threads


def test_libraries_compute_with_as_many_threads_as_was_said() -> None:
    before = torch.get_num_threads(), cv2.getNumThreads()
    with threads(3):
        assert (count_of_threads(), torch.get_num_threads(), cv2.getNumThreads()) == (3, 3, 3)
        with threads(1):
            assert (count_of_threads(), torch.get_num_threads(), cv2.getNumThreads()) == (1, 1, 1)
        assert (count_of_threads(), torch.get_num_threads(), cv2.getNumThreads()) == (3, 3, 3)
    assert (torch.get_num_threads(), cv2.getNumThreads()) == before


@pytest.mark.parametrize("inside", [True, False])
def test_torch_that_is_loaded_later_computes_with_as_many(inside: bool) -> None:
    code = """
import os
from visloc.threads import count_of_threads, threads, use_threads
assert count_of_threads() == 2
with threads(1):
    assert count_of_threads() == 1
    if INSIDE:
        import torch
        assert torch.get_num_threads() == 1
assert count_of_threads() == 2 and os.environ["OMP_NUM_THREADS"] == "2"
use_threads(1)
import torch
assert torch.get_num_threads() == count_of_threads() == 1
"""
    command = [sys.executable, "-c", code.replace("INSIDE", str(inside))]
    subprocess.run(command, check=True, timeout=120, env={"OMP_NUM_THREADS": "2"})


@pytest.mark.parametrize("said", ["", "0", "all", "-1"])
def test_what_the_environment_says_is_a_positive_number_or_counts_as_nothing(said: str) -> None:
    code = "from visloc.threads import count_of_threads; assert count_of_threads() >= 1"
    environment = {"OMP_NUM_THREADS": said}
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, env=environment)
