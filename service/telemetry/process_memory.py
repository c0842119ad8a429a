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
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h
# More than the largest message. What is freed between two trims is used again.
_KEPT_BYTES = 2**28
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


def use_one_heap() -> None:
    """Let all threads share one heap that keeps what is freed. Call it before other threads begin.

    By default glibc maps new pages for every large block. The event loop copies each gRPC message,
    and most of the time that this takes is the kernel's, which clears the pages
    (docs/reliability.md). And glibc gives each thread a heap, from whose end ``malloc_trim``
    returns nothing. Does nothing without glibc.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):
        libc.mallopt(_M_ARENA_MAX, 1)
        for threshold in (_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD):
            libc.mallopt(threshold, _KEPT_BYTES)


async def give_back_memory() -> None:
    """Return freed memory to the system every few seconds until cancelled; needs glibc."""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "malloc_trim"):
        return
    while True:
        await asyncio.sleep(_GIVE_BACK_EVERY_S)
        await asyncio.to_thread(libc.malloc_trim, 0)
