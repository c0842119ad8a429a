from __future__ import annotations

import asyncio
import ctypes
from pathlib import Path
from types import SimpleNamespace

import pytest

from service.telemetry.process_memory import give_back_memory, resident_memory


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

        libc = SimpleNamespace(malloc_trim=trim, mallopt=lambda *_: None)
        monkeypatch.setattr(ctypes, "CDLL", lambda _: libc)
        monkeypatch.setattr("service.telemetry.process_memory._GIVE_BACK_EVERY_S", 0.0)
        giving = asyncio.create_task(give_back_memory())
        await asyncio.wait_for(third.wait(), 10)
        giving.cancel()

    asyncio.run(wait_for_three())


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda _: SimpleNamespace())

    asyncio.run(give_back_memory())
