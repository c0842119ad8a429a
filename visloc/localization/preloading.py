"""Loads torch once in a process from which others are forked, so that they share its memory."""

from __future__ import annotations

import importlib

from visloc.features.backends.choice import may_be_torch
from visloc.matching import compiled


def load_torch_if_sure() -> None:
    """Load torch on a machine that has a GPU, or lacks OpenVINO or compiled matching.

    Elsewhere only some networks need it, and the processes that use them load it. It only asks
    whether there is a driver and a compiled library: whether they work is for each process to find
    out, and to log.
    """
    if may_be_torch() or not compiled.LIBRARY.exists():
        importlib.import_module("torch")
