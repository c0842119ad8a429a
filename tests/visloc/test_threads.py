"""How many threads a process computes with, whether torch is loaded before or after it is set."""

from __future__ import annotations

import os
import subprocess
import sys

import cv2
import pytest
import torch

from visloc.runtime.threads import count_of_threads, threads


def test_the_number_holds_for_all_libraries_within_the_block() -> None:
    before = torch.get_num_threads(), cv2.getNumThreads()
    with threads(3):
        assert (count_of_threads(), torch.get_num_threads(), cv2.getNumThreads()) == (3, 3, 3)
        with threads(1):
            assert (count_of_threads(), torch.get_num_threads(), cv2.getNumThreads()) == (1, 1, 1)
        assert (count_of_threads(), torch.get_num_threads(), cv2.getNumThreads()) == (3, 3, 3)
    assert (torch.get_num_threads(), cv2.getNumThreads()) == before


@pytest.mark.parametrize("inside", [True, False])
def test_torch_that_is_loaded_later_computes_with_as_many(inside: bool) -> None:
    code = f"""
import os
from visloc.runtime.threads import count_of_threads, threads, use_threads
assert count_of_threads() == {min(2, len(os.sched_getaffinity(0)))}
with threads(1):
    assert count_of_threads() == 1
    if {inside}:
        import torch
        assert torch.get_num_threads() == 1
assert count_of_threads() == {min(2, len(os.sched_getaffinity(0)))}
assert os.environ["OMP_NUM_THREADS"] == "2"
use_threads(1)
import torch
assert torch.get_num_threads() == count_of_threads() == 1
"""
    command = [sys.executable, "-c", code]
    subprocess.run(command, check=True, timeout=120, env={"OMP_NUM_THREADS": "2"})


@pytest.mark.parametrize("said", ["", "0", "all", "-1"])
def test_an_invalid_number_in_the_environment_is_ignored(said: str) -> None:
    code = "from visloc.runtime.threads import count_of_threads; assert count_of_threads() >= 1"
    environment = {"OMP_NUM_THREADS": said}
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, env=environment)
