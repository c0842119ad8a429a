"""Builds on a Ray cluster of this machine, with workers that are killed."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from ray._raylet import Config

from mapping.cluster.executors import open_executor
from mapping.cluster.storage import place_of
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import Map, open_map
from visloc.errors import InvalidInput, Unavailable
from visloc_extensions.ray import pool as ray_pool
from visloc_extensions.ray.pool import RayPool

ROOT = Path(__file__).resolve().parents[3]
# Ends with its input: also with a test process that is killed.
CLUSTER = """
import ray, sys

if __name__ == "__main__":
    ray.init(
        "local", num_cpus=2, include_dashboard=False, object_store_memory=2**27,
        _temp_dir=sys.argv[1], _node_ip_address="127.0.0.1",
    )
    print(ray.get_runtime_context().gcs_address, flush=True)
    sys.stdin.read()
"""


@pytest.fixture(scope="module")
def cluster(bucket: str) -> Iterator[str]:  # noqa: ARG001  its workers know how to reach it
    """The address of a cluster with two processors, which is what ``auto`` means here."""
    # Short: the names of sockets are within it.
    folder = Path(tempfile.mkdtemp(prefix="ray", dir="/tmp"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", str(folder))
        patch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
        patch.setenv("RAY_AUTH_MODE", "token")
        Config.initialize("")  # Ray has read the environment when this module was loaded
        patch.setenv("PYTHONPATH", str(ROOT))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        with (folder / "log").open("wb") as log:
            head = subprocess.Popen(
                [sys.executable, "-c", CLUSTER, folder],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        assert head.stdin is not None
        assert head.stdout is not None
        try:
            address = head.stdout.readline().strip()
            assert address, (folder / "log").read_text()
            patch.setenv("RAY_ADDRESS", address)  # there may be other clusters on this machine
            yield address
        finally:
            head.stdin.close()
            head.wait()
            head.stdout.close()
            shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="class")
def pool(cluster: str) -> Iterator[RayPool]:  # noqa: ARG001
    with RayPool(2, "auto") as pool:
        yield pool


def write_square(folder: Path, number: int) -> None:
    threads = os.environ["OMP_NUM_THREADS"]
    (folder / f"{number}").write_text(f"{number * number} {os.getpid()} {threads}")


def die_once(folder: Path, number: int) -> None:
    """Take the worker along, the first time that 1 is met."""
    if number == 1 and not (folder / f"{number}.met").exists():
        (folder / f"{number}.met").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    write_square(folder, number)


def die_if_told(order: Path, task: Callable[[object], object], item: object) -> None:
    """Take the worker along once for each order, instead of doing the item."""
    with suppress(FileNotFoundError):
        order.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    task(item)


def refuse_3(number: int) -> None:
    if number == 3:
        raise InvalidInput("test.number", "not a number", field="n", expected="2", got=number)


def use_up(number: int) -> None:
    sum(range(10_000_000 * number))


def ignore(_done: int, _total: int) -> None:
    pass


class TestPool:
    """What one pool does; joining a cluster takes seconds."""

    def test_every_item_is_done_elsewhere_with_one_thread(
        self, pool: RayPool, tmp_path: Path
    ) -> None:
        told: list[tuple[int, int]] = []
        pool.run(partial(write_square, tmp_path), range(5), lambda *now: told.append(now))
        assert told == [(done, 5) for done in range(6)]
        found = [(tmp_path / f"{number}").read_text().split() for number in range(5)]
        assert [int(square) for square, _, _ in found] == [0, 1, 4, 9, 16]
        assert {threads for _, _, threads in found} == {"1"}
        assert str(os.getpid()) not in {pid for _, pid, _ in found}

    def test_nothing_to_do_is_done(self, pool: RayPool) -> None:
        told: list[tuple[int, int]] = []
        pool.run(refuse_3, [], lambda *now: told.append(now))
        assert told == [(0, 0)]

    def test_what_workers_use_up_is_counted(self, pool: RayPool) -> None:
        before = pool.spent.cpu_s
        pool.run(use_up, [0], ignore)
        little = pool.spent.cpu_s - before
        pool.run(use_up, [3], ignore)
        assert pool.spent.cpu_s - before > 2 * little > 0

    def test_a_batch_whose_worker_was_killed_is_done_again(
        self, pool: RayPool, tmp_path: Path
    ) -> None:
        pool.run(partial(die_once, tmp_path), range(4), ignore)
        assert [path.name for path in tmp_path.glob("*.met")] == ["1.met"]
        squares = [(tmp_path / f"{number}").read_text().split()[0] for number in range(4)]
        assert squares == ["0", "1", "4", "9"]

    def test_an_error_of_ours_arrives_as_it_was_raised(self, pool: RayPool) -> None:
        with pytest.raises(InvalidInput, match="not a number") as caught:
            pool.run(refuse_3, range(5), ignore)
        error = caught.value
        assert type(error) is InvalidInput
        assert (error.code, error.field, error.expected) == ("test.number", "n", "2")

    def test_a_batch_that_always_ends_its_worker_is_an_error_with_advice(
        self, pool: RayPool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        # Three retries take seconds, and show no more than none.
        monkeypatch.setattr(pool, "_do_batch", pool._do_batch.options(max_retries=0))
        with pytest.raises(Unavailable, match=r"killed.*memory.*resumes") as caught:
            pool.run(os._exit, [1], ignore)
        assert (caught.value.code, caught.value.field) == ("build.worker_died", "--executor")

    def test_a_machine_with_another_version_is_refused(
        self, pool: RayPool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(ray_pool, "__version__", "0.0.1")
        with pytest.raises(Unavailable) as caught:
            pool.run(ignore, [(1, 2)], ignore)
        assert (caught.value.code, caught.value.expected) == ("build.other_version", "0.0.1")


@pytest.mark.parametrize("method", ["rgbd", "sfm"])
def test_a_build_whose_workers_are_killed_makes_the_map_of_a_local_build(
    cluster: str,
    bucket: str,
    walk: Path,
    tmp_path: Path,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
) -> None:
    local: Map = request.getfixturevalue(f"{method}_walk")
    order, ordered = tmp_path / "kill", []
    run = RayPool.run

    def run_with_kills(pool: RayPool, task: object, items: object, progress: object) -> None:
        run(pool, partial(die_if_told, order, task), items, progress)  # type: ignore[arg-type]

    def kill_one(stage: str, done: int, _total: int) -> None:
        if stage in ("local features", "matches") and done == 2:
            order.touch()
            ordered.append(stage)

    settings = BuildSettings(
        walk / "mapping",
        "walk",
        tmp_path / "maps",
        method=method,
        local_features="sift",
        global_features=("localvlad",),
        max_keypoints=500,
        executor="ray",
        ray_address=cluster,
        workers=2,
        work_dir=place_of(f"{bucket}/ray", "--work-dir") if method == "rgbd" else None,
    )
    monkeypatch.setattr(RayPool, "run", run_with_kills)
    built = open_map(build_map(settings, kill_one))
    assert ordered == ["local features", "matches"][: 2 if method == "sfm" else 1]
    assert not order.exists()  # a worker took it
    assert built.manifest.content_hash == local.manifest.content_hash


def test_a_cluster_with_another_token_is_refused_with_that_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answer = (
        "Failed to connect to GCS. Last connection error: Traceback:\n  File ...\n"
        "ray.exceptions.AuthenticationError: RPC error: InvalidAuthToken: missing or incorrect.\n"
    )

    error = ConnectionError("Failed to connect to Ray cluster at 127.0.0.1:6379")
    error.__cause__ = RuntimeError(answer)

    def connect(*_: object, **__: object) -> None:  # as Ray does, which tries for half a minute
        raise error

    monkeypatch.setattr("ray.init", connect)
    with pytest.raises(Unavailable, match="InvalidAuthToken") as caught:
        open_executor("ray", 1, "127.0.0.1:6379")
    assert caught.value.code == "build.no_cluster"


def test_an_address_where_nothing_listens_is_refused() -> None:
    with pytest.raises(Unavailable) as caught:
        open_executor("ray", 1, "ray//nowhere")
    assert (caught.value.code, caught.value.field) == ("build.no_cluster", "--ray-address")


def test_a_batch_without_enough_memory_is_not_tried_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Ray's own default is to try for ever. It reads this when it is loaded.
    monkeypatch.setattr(os, "environ", {})
    with pytest.raises(Unavailable):
        open_executor("ray", 1, "ray//nowhere")
    assert ("RAY_task_oom_retries", str(ray_pool._RETRIES)) in os.environ.items()
