"""The processor cores and the memory that this process may use.

A container may have less than its machine: Linux tells its quota in the files of cgroups.
"""

from __future__ import annotations

import os
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")
# Of version 2 of cgroups, then of version 1.
_MEMORY_FILES = ("memory.max", "memory/memory.limit_in_bytes")


def usable_cores(cgroup: Path = _CGROUP) -> int:
    """Return the cores that this process may keep busy: those of ``taskset`` or of the container.

    A container's quota may be a fraction of a core, which counts as a whole one.
    """
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    quota = _quota(cgroup)
    return cores if quota is None else max(1, min(cores, int(quota)))


def memory_limit(cgroup: Path = _CGROUP, proc: Path = Path("/proc")) -> int | None:
    """Return the memory for all processes in bytes: the container's, else the machine's."""
    limits = [
        int(line)
        for name in _MEMORY_FILES
        for line in lines_of(cgroup / name)
        if line.isdigit()  # "max": none
    ]
    limits += [
        int(line.split()[1]) * 1024
        for line in lines_of(proc / "meminfo")
        if line.startswith("MemTotal:")
    ]
    return min(limits, default=None)


def lines_of(path: Path) -> list[str]:
    """Return the lines of a file of the system; none where it cannot be read."""
    try:
        return path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:  # another system, or the process has ended
        return []


def _quota(cgroup: Path) -> float | None:
    """Return the cores that the container may use; None without a limit."""
    words = [word for line in lines_of(cgroup / "cpu.max") for word in line.split()]
    if len(words) != 2:  # version 1
        names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
        words = [line for name in names for line in lines_of(cgroup / "cpu" / name)]
    if len(words) != 2 or not all(map(str.isdigit, words)):  # "max", or -1: none
        return None
    microseconds, period = map(int, words)
    return microseconds / period if period > 0 else None
