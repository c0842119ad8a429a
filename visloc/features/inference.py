"""Which way networks are computed on this machine."""

from __future__ import annotations

import importlib.util
import logging
from functools import cache
from pathlib import Path

from visloc.errors import InvalidInput
from visloc.types import Inference

_LOGGER = logging.getLogger(__name__)
_CPU_INFO = Path("/proc/cpuinfo")
# Without these instructions products of 8-bit numbers are no faster than of floats, and OpenVINO
# adds some of them up in 16 bits, where they may overflow.
_EIGHT_BIT_FLAGS = frozenset({"avx512_vnni", "avx_vnni", "amx_int8"})


def choose_inference(wanted: Inference) -> Inference:
    """Return ``wanted``, or what AUTO is here: TORCH, INT8 or FP32.

    Raises:
        InvalidInput: ``inference.unavailable`` if it needs OpenVINO, which is not installed.
    """
    if wanted is Inference.AUTO:
        chosen, reason = _automatic()
        _log_once(chosen, reason)
        return chosen
    if wanted is not Inference.TORCH and not has_openvino():
        raise InvalidInput(
            "inference.unavailable",
            "this way of computing networks needs the Python package openvino: install it with "
            "pip install openvino",
            field="inference",
            expected=f"{Inference.AUTO} or {Inference.TORCH}",
            got=wanted.value,
        )
    return wanted


def has_openvino() -> bool:
    """Whether OpenVINO is installed; it is not loaded for that."""
    return importlib.util.find_spec("openvino") is not None


def _automatic() -> tuple[Inference, str]:
    if _has_cuda():
        return Inference.TORCH, "there is a CUDA GPU"
    if not has_openvino():
        return Inference.TORCH, "the Python package openvino is not installed"
    flags = _cpu_flags()
    if flags is None:
        return Inference.FP32, f"{_CPU_INFO} does not say whether the processor has 8-bit products"
    found = sorted(_EIGHT_BIT_FLAGS & flags)
    if found:
        return Inference.INT8, f"the processor has {', '.join(found)}"
    return Inference.FP32, "the processor has neither VNNI nor AMX"


@cache
def _log_once(chosen: Inference, reason: str) -> None:
    _LOGGER.info("networks are computed with %s: %s", chosen.value, reason)


def _has_cuda() -> bool:
    # The driver's device file tells it without loading torch, which takes a second.
    if not Path("/dev/nvidiactl").exists() and not Path("/dev/dxg").exists():
        return False
    import torch

    return torch.cuda.is_available()


def _cpu_flags() -> frozenset[str] | None:
    try:
        lines = _CPU_INFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() == "flags":
            return frozenset(value.split())
    return None
