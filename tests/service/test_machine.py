from __future__ import annotations

from pathlib import Path

import pytest

from service.machine import memory_limit, usable_cores


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 8),
        ({"cpu.max": "max 100000\n"}, 8),
        ({"cpu.max": "200000 100000\n"}, 2),
        ({"cpu.max": "50000 100000\n"}, 1),  # half a core
        ({"cpu.max": "9900000 100000\n"}, 8),
        ({"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ({"cpu.max": "200000 0\n"}, 8),
        ({"cpu.max": ""}, 8),
    ],
)
def test_cores_are_those_of_the_process_and_of_its_container(
    files: dict[str, str], cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)), raising=False)
    for name, text in files.items():
        write(tmp_path / name, text)

    assert usable_cores(tmp_path) == cores


def test_the_limit_is_that_of_the_container_when_it_has_one(tmp_path: Path) -> None:
    cgroup, proc = tmp_path / "cgroup", tmp_path / "proc"
    assert memory_limit(cgroup, proc) is None  # another system

    write(proc / "meminfo", "MemTotal:       1000 kB\nMemFree:  10 kB\n")
    assert memory_limit(cgroup, proc) == 1000 * 1024

    write(cgroup / "memory.max", "max\n")
    assert memory_limit(cgroup, proc) == 1000 * 1024

    write(cgroup / "memory.max", "500000\n")
    assert memory_limit(cgroup, proc) == 500_000


def test_version_1_of_cgroups_says_no_limit_with_a_huge_one(tmp_path: Path) -> None:
    write(tmp_path / "meminfo", "MemTotal:       1000 kB\n")
    write(tmp_path / "memory" / "memory.limit_in_bytes", "9223372036854771712\n")

    assert memory_limit(tmp_path, tmp_path) == 1000 * 1024
