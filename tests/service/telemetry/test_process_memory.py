from __future__ import annotations

import asyncio
import ctypes
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from service.telemetry.process_memory import give_back_memory, resident_memory, use_one_heap


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_the_memory_of_processes_is_read_in_bytes(tmp_path: Path) -> None:
    write(tmp_path / "self" / "status", "VmRSS:\t 30 kB\nRssAnon:\t 20 kB\nRssFile:\t 10 kB\n")
    write(tmp_path / "77" / "status", "RssAnon:\t 5 kB\nRssShmem:\t 1 kB\n")

    assert resident_memory((77, 78), tmp_path) == {
        ("server", "anonymous"): 20 * 1024,
        ("server", "file"): 10 * 1024,
        ("worker-0", "anonymous"): 5 * 1024,
    }


def test_freed_memory_is_given_back_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    async def wait_for_three() -> None:
        given, third = 0, asyncio.Event()
        loop = asyncio.get_running_loop()

        def trim(kept: int) -> None:
            nonlocal given
            assert kept == 0
            given += 1
            if given == 3:
                loop.call_soon_threadsafe(third.set)

        libc = SimpleNamespace(malloc_trim=trim)
        monkeypatch.setattr(ctypes, "CDLL", lambda _: libc)
        monkeypatch.setattr("service.telemetry.process_memory._GIVE_BACK_EVERY_S", 0.0)
        giving = asyncio.create_task(give_back_memory())
        await asyncio.wait_for(third.wait(), 10)
        giving.cancel()

    asyncio.run(wait_for_three())


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda _: SimpleNamespace())

    use_one_heap()
    asyncio.run(give_back_memory())


# Prints whether a block that a thread gets lies in the heap of the main thread.
IN_HEAP = """
import ctypes, threading
from pathlib import Path
from service.telemetry.process_memory import use_one_heap

libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
if USED:
    use_one_heap()

def ask(size):
    at = libc.malloc(ctypes.c_size_t(size))
    lines = Path("/proc/self/maps").read_text().splitlines()
    (heap,) = [line.split()[0] for line in lines if "[heap]" in line]
    first, last = (int(each, 16) for each in heap.split("-"))
    print(first <= at < last)

for size in (64 * 2**20, 1000):
    thread = threading.Thread(target=ask, args=(size,))
    thread.start()
    thread.join()
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="this is not glibc")
@pytest.mark.parametrize("used", [False, True])
def test_blocks_of_all_threads_and_sizes_lie_in_one_heap(*, used: bool) -> None:
    code = f"USED = {used}\n{IN_HEAP}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(used)] * 2
