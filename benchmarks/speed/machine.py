"""What the figures were measured on: a figure without its machine says nothing."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import torch

# Of the processor's flags, as Linux lists them, those that decide how fast networks can be.
_FLAGS = {
    "avx2": "AVX2",
    "avx512f": "AVX-512",
    "avx512_vnni": "AVX-512 VNNI",
    "avx_vnni": "AVX VNNI",
    "avx512_bf16": "AVX-512 bf16",
    "amx_int8": "AMX int8",
    "amx_bf16": "AMX bf16",
}
_PACKAGES = ("numpy", "openvino", "poselib", "pycolmap", "torch")


@dataclass(frozen=True, slots=True)
class Machine:
    """The machine, and what runs on it.

    Attributes:
        cpu: the processor's name.
        threads: processor cores that this process may use.
        flags: what the processor has for networks.
        cuda: the CUDA device and torch's version of CUDA, if there is one.
        python: its version.
        packages: versions by name, of those that are installed.
    """

    cpu: str
    threads: int
    flags: tuple[str, ...]
    cuda: str | None
    python: str
    packages: dict[str, str]

    @property
    def has_bf16(self) -> bool:
        """Whether products of bf16 are made in hardware."""
        return any("bf16" in flag for flag in self.flags)


def this_machine() -> Machine:
    """Describe the machine at hand."""
    fields = _cpu_fields()
    model = fields.get("model name", platform.processor() or platform.machine())
    family = ", ".join(
        f"{name} {fields[name]}" for name in ("cpu family", "model") if name in fields
    )
    known = set(fields.get("flags", "").split())
    return Machine(
        cpu=f"{model} ({family})" if family else model,
        threads=num_threads(),
        flags=tuple(label for flag, label in _FLAGS.items() if flag in known),
        cuda=_cuda_device(),
        python=platform.python_version(),
        packages={name: version(name) for name in _PACKAGES if find_spec(name) is not None},
    )


def _cuda_device() -> str | None:
    if not torch.cuda.is_available():
        return None
    return f"{torch.cuda.get_device_name(0)}, CUDA {torch.version.cuda}"


def num_threads() -> int:
    """Processor cores that this process may use, as ``taskset`` left them."""
    return len(os.sched_getaffinity(0))


def load_average() -> float:
    """Processes that ran or wanted to during the last minute, this one among them."""
    return os.getloadavg()[0]


def _cpu_fields() -> dict[str, str]:
    """The first processor's lines of /proc/cpuinfo."""
    lines = Path("/proc/cpuinfo").read_text().split("\n\n", 1)[0].splitlines()
    pairs = (line.partition(":") for line in lines)
    return {name.strip(): value.strip() for name, _, value in pairs}
