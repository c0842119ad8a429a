"""Which way networks are computed on this machine."""

from __future__ import annotations

import logging
from functools import cache
from pathlib import Path

from visloc.errors import refuse
from visloc.features.backends.openvino import import_openvino
from visloc.options import Inference
from visloc.runtime.device import has_cuda, may_have_cuda

_LOGGER = logging.getLogger(__name__)
_CPU_INFO = Path("/proc/cpuinfo")
# Without these instructions products of 8-bit numbers are no faster than of floats, and OpenVINO
# adds some of them up in 16 bits, where they may overflow.
_EIGHT_BIT_FLAGS = frozenset({"avx512_vnni", "avx_vnni", "amx_int8"})


def choose_inference(wanted: Inference) -> Inference:
    """Return ``wanted``, or what AUTO is here. All but TORCH load OpenVINO."""
    if wanted is Inference.AUTO:
        chosen, reason = _automatic()
        _log_once(chosen, reason)
        return chosen
    if wanted is Inference.TORCH:
        return wanted
    missing = _missing_openvino()
    if missing is not None:
        raise refuse(
            "inference.unavailable",
            f"this way of computing networks requires OpenVINO, but {missing}: pip "
            "install openvino, or choose another way",
            field="inference",
            expected=f"{Inference.AUTO} or {Inference.TORCH}",
            got=wanted.value,
        )
    has_eight_bits, reason = _eight_bits()
    if wanted is Inference.INT8 and not has_eight_bits:
        raise refuse(
            "inference.unavailable",
            f"this machine cannot compute networks in 8 bits, because sums may overflow: {reason}",
            field="inference",
            expected=Inference.FP32.value,
            got=wanted.value,
        )
    return wanted


def may_be_torch() -> bool:
    """Return whether AUTO may be TORCH here. Loads OpenVINO, and nothing of a GPU."""
    return may_have_cuda() or _missing_openvino() is not None


def _automatic() -> tuple[Inference, str]:
    if has_cuda():
        return Inference.TORCH, "there is a CUDA GPU"
    missing = _missing_openvino()
    if missing is not None:
        return Inference.TORCH, missing
    has_eight_bits, reason = _eight_bits()
    return Inference.INT8 if has_eight_bits else Inference.FP32, reason


@cache
def _log_once(chosen: Inference, reason: str) -> None:
    _LOGGER.info("networks are computed with %s: %s", chosen.value, reason)


def _missing_openvino() -> str | None:
    """Return why OpenVINO is not there, None if it is."""
    try:
        import_openvino()
    except ModuleNotFoundError as error:
        if error.name == "openvino":
            return "the Python package openvino is not installed"
        return f"the Python package openvino cannot be loaded ({error})"
    except (ImportError, OSError) as error:  # a library that is missing, or for another system
        return f"the Python package openvino cannot be loaded ({error})"
    return None


def _eight_bits() -> tuple[bool, str]:
    """Return whether the processor is made for products of 8-bit numbers, and why (not)."""
    flags = _cpu_flags()
    if flags is None:
        return False, f"{_CPU_INFO} does not say whether the processor has VNNI or AMX"
    found = sorted(_EIGHT_BIT_FLAGS & flags)
    if found:
        return True, f"the processor has {', '.join(found)}"
    return False, "the processor has neither VNNI nor AMX"


def _cpu_flags() -> frozenset[str] | None:
    try:
        lines = _CPU_INFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() in ("flags", "Features"):  # of x86, of ARM
            return frozenset(value.split())
    return None
