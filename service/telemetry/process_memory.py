"""Memory of processes, read from Linux; other systems report nothing.

Also returns freed memory of this process to the system.
"""

from __future__ import annotations

import asyncio
import ctypes
from collections.abc import Mapping, Sequence
from pathlib import Path

from service.machine import lines_of

_GIVE_BACK_EVERY_S = 5.0
_M_TRIM_THRESHOLD = -1  # malloc.h
_KEPT_BYTES = 2**20
_KINDS = {"RssAnon": "anonymous", "RssFile": "file"}


def resident_memory(
    worker_pids: Sequence[int], proc: Path = Path("/proc")
) -> Mapping[tuple[str, str], int]:
    """Return the bytes of this process (``server``) and its workers (``worker-0``...), by kind.

    Mapped files count once per process and the system may drop them at any time, so that only
    ``anonymous`` memory can leak. Processes that have ended are left out.
    """
    names = {"server": "self", **{f"worker-{i}": str(pid) for i, pid in enumerate(worker_pids)}}
    found = {}
    for name, folder in names.items():
        for line in lines_of(proc / folder / "status"):
            key, _, rest = line.partition(":")
            if key in _KINDS:
                found[name, _KINDS[key]] = int(rest.split()[0]) * 1024  # always said in kB
    return found


async def give_back_memory() -> None:
    """Return freed memory to the system until cancelled. Does nothing without glibc.

    glibc keeps the memory of large requests in one arena for each thread that parsed one. Free
    memory at the end of an arena is returned only above a threshold, which grows with the largest
    request unless it is fixed. Gaps within an arena are returned only by ``malloc_trim``.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "malloc_trim"):
        return
    libc.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
    while True:
        await asyncio.sleep(_GIVE_BACK_EVERY_S)
        await asyncio.to_thread(libc.malloc_trim, 0)
