from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from multiprocessing import forkserver, util
from pathlib import Path

import cv2
import pytest

from mapping.cluster.workers import Workers
from visloc.archive import Map, MapStore
from visloc.errors import Unavailable

Build = Callable[..., Map]


def write_square(folder: Path, number: int) -> None:
    (folder / f"{number}").write_text(f"{number * number} {os.getpid()}")


def fail_at_3(number: int) -> None:
    if number == 3:
        raise ValueError(f"number {number}")


def write_threads(folder: Path, name: str) -> None:
    import torch  # as a network does, when it is made

    (folder / name).write_text(f"{torch.get_num_threads()} {cv2.getNumThreads()}")


def be_terminated(folder: Path, number: int) -> None:
    import pycolmap  # noqa: F401

    os.dup2(os.open(folder / f"stderr-{number}", os.O_WRONLY | os.O_CREAT), 2)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(60)


def ignore(_done: int, _total: int) -> None:
    pass


def be_killed(folder: Path) -> None:
    """Work with two workers in a child of another process, and die."""
    workers = Workers(2)
    workers.run(partial(write_square, folder), range(2), ignore)
    pids = [str(worker.pid) for worker in multiprocessing.active_children()]
    (folder / "workers").write_text("\n".join(pids))
    os.kill(os.getpid(), signal.SIGKILL)


# Runs the command with trouble ahead: "progress:STAGE:DONE" kills it there, "call:MODULE:FUNCTION"
# when it gets there, "worker:STAGE" one of its workers as the stage begins, with the given signal.
RUN = """
import importlib, multiprocessing.util, os, signal, sys
from mapping.cli import main as cli
from mapping.cli import progress

kind, *where = TROUBLE.split(":")

def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)

if __name__ == "__main__":
    show = progress.StageProgress.__call__
    def show_and_strike(self, stage, done, total):
        show(self, stage, done, total)
        workers = multiprocessing.active_children()
        if workers:
            with open("sockets", "w") as file:
                file.write(multiprocessing.util.get_temp_dir())
            with open("workers", "a") as file:
                file.write("".join(f"{worker.pid}\\n" for worker in workers))
        if kind == "progress" and [stage, str(done)] == where:
            die()
        if kind == "worker" and [stage, str(done)] == where:
            os.kill(workers[0].pid, signal.SIGKILL)
    progress.StageProgress.__call__ = show_and_strike
    if kind == "call":
        setattr(importlib.import_module(where[0]), where[1], die)
    cli.main()
"""


@pytest.fixture
def run_build(walk: Path, tmp_path: Path) -> Callable[[str], subprocess.CompletedProcess[str]]:
    """Build the map with two workers, with trouble ahead."""

    def run(trouble: str) -> subprocess.CompletedProcess[str]:
        # A file: workers import the main module again.
        script = tmp_path / "run.py"
        script.write_text(f"TROUBLE = {trouble!r}\n{RUN}")
        return subprocess.run(
            [
                *(sys.executable, str(script), "build", str(walk / "mapping"), "--map=walk"),
                *("--maps-dir=maps", "--method=sfm", "--local-features=sift", "--force"),
                *("--global-features=localvlad", "--max-keypoints=500", "--workers=2"),
            ],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
            cwd=tmp_path,
            env={
                **{name: value for name, value in os.environ.items() if "VISLOC" not in name},
                "PYTHONPATH": os.pathsep.join(sys.path),
            },
        )

    return run


Run = Callable[[str], subprocess.CompletedProcess[str]]


def items_of(maps_dir: Path) -> dict[Path, tuple[int, int]]:
    """Identity of every finished item of the unfinished build."""
    items = (maps_dir / ".work" / "walk").glob("*/*.npz")
    return {path: ((info := path.stat()).st_ino, info.st_mtime_ns) for path in items}


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"  # one that has ended, but whose parent did not ask


def wait_for_the_end_of_workers(folder: Path) -> None:
    pids = {int(line) for line in (folder / "workers").read_text().split()}
    assert len(pids) >= 2
    deadline = time.monotonic() + 20
    while any(is_alive(pid) for pid in pids):
        assert time.monotonic() < deadline, "a worker outlived its build"
        time.sleep(0.05)
    (folder / "workers").unlink()


@pytest.mark.parametrize("count", [1, 2])
def test_every_item_is_done_once_and_told(tmp_path: Path, count: int) -> None:
    told: list[tuple[int, int]] = []
    Workers(count).run(
        partial(write_square, tmp_path), range(5), lambda done, total: told.append((done, total))
    )
    assert told == [(done, 5) for done in range(6)]
    results = [(tmp_path / f"{number}").read_text().split() for number in range(5)]
    assert [int(square) for square, _ in results] == [0, 1, 4, 9, 16]
    here = {pid == str(os.getpid()) for _, pid in results}
    assert here == {count == 1}


@pytest.fixture
def long_temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let temporary files lie where no server of forks can listen."""
    long = tmp_path / ("long" * 25)
    long.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    # As in a process that has started no worker yet.
    config = multiprocessing.current_process()._config  # type: ignore[attr-defined]
    monkeypatch.setitem(config, "tempdir", None)  # so that what is cached here goes afterwards
    monkeypatch.setattr(forkserver._forkserver, "_forkserver_pid", None)


@pytest.mark.usefixtures("long_temporary")
def test_the_folder_of_temporary_files_may_have_a_long_path(tmp_path: Path) -> None:
    Workers(2).run(partial(write_square, tmp_path), [3, 4], ignore)
    assert {path.name for path in tmp_path.glob("[0-9]")} == {"3", "4"}


@pytest.mark.parametrize("count", [1, 2])
def test_libraries_use_one_thread(tmp_path: Path, count: int) -> None:
    import torch

    before = torch.get_num_threads(), cv2.getNumThreads()
    Workers(count).run(partial(write_threads, tmp_path), ["first", "second"], ignore)
    assert {path.read_text() for path in tmp_path.iterdir()} == {"1 1"}
    assert (torch.get_num_threads(), cv2.getNumThreads()) == before


def test_nothing_to_do_is_done() -> None:
    told: list[tuple[int, int]] = []
    Workers(2).run(fail_at_3, [], lambda done, total: told.append((done, total)))
    assert told == [(0, 0)]


@pytest.mark.parametrize("count", [1, 2])
def test_what_a_task_raises_is_raised(count: int) -> None:
    with pytest.raises(ValueError, match="number 3"):
        Workers(count).run(fail_at_3, range(5), ignore)


def test_a_worker_that_dies_is_an_error_with_advice() -> None:
    with pytest.raises(Unavailable, match=r"killed.*memory.*resumes") as caught:
        Workers(2).run(os._exit, [1, 1, 1], ignore)
    assert (caught.value.code, caught.value.field) == ("build.worker_died", "--workers")


@pytest.mark.parametrize("started_by", ["forks", pytest.param("spawning", marks=pytest.mark.slow)])
def test_terminated_worker_prints_no_stack_trace(
    started_by: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if started_by == "spawning":
        request.getfixturevalue("long_temporary")
    with pytest.raises(Unavailable):
        Workers(2).run(partial(be_terminated, tmp_path), [0, 1], ignore)
    written = [path.read_text() for path in tmp_path.glob("stderr-*")]
    assert written
    assert not any(written)


def test_workers_of_a_killed_child_leave_the_folder_of_sockets_to_its_parent(
    tmp_path: Path,
) -> None:
    shared = Path(util.get_temp_dir())
    child = multiprocessing.get_context("spawn").Process(target=be_killed, args=(tmp_path,))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    wait_for_the_end_of_workers(tmp_path)
    assert shared.is_dir()


def test_two_workers_make_the_same_map_by_depth(
    walk: Path, tmp_path: Path, rgbd_walk: Map, build_walk: Build
) -> None:
    built = build_walk(walk / "mapping", tmp_path, method="rgbd", workers=2)
    assert built.manifest.content_hash == rgbd_walk.manifest.content_hash


def test_killed_with_its_workers_the_same_command_resumes_and_makes_the_same_map(
    run_build: Run, tmp_path: Path, sfm_walk: Map
) -> None:
    maps_dir = tmp_path / "maps"
    items: dict[Path, tuple[int, int]] = {}
    for trouble in (
        "progress:local features:5",
        "progress:matches:4",
        "call:mapping.methods.model_stage:triangulate",
    ):
        killed = run_build(trouble)
        assert killed.returncode == -signal.SIGKILL, (trouble, killed.stderr)
        wait_for_the_end_of_workers(tmp_path)
        assert not Path((tmp_path / "sockets").read_text()).exists()
        found = items_of(maps_dir)
        assert found.items() >= items.items(), trouble  # nothing finished was done again
        assert len(found) > len(items)
        items = found
        assert not (maps_dir / "walk").exists()

    finished = run_build("none")
    assert finished.returncode == 0, finished.stderr
    after = MapStore(maps_dir).open("walk").manifest
    assert after.content_hash == sfm_walk.manifest.content_hash


def test_a_build_whose_worker_was_killed_says_so_and_resumes(
    run_build: Run, tmp_path: Path
) -> None:
    died = run_build("worker:local features:3")
    assert (died.returncode, died.stdout) == (1, "")
    assert "error [build.worker_died] --workers: a worker process was killed" in died.stderr
    assert "Traceback" not in died.stderr
    wait_for_the_end_of_workers(tmp_path)
    items = items_of(tmp_path / "maps")
    assert items
    killed = run_build("progress:triangulation:1")
    assert killed.returncode == -signal.SIGKILL
    assert items_of(tmp_path / "maps").items() >= items.items()
