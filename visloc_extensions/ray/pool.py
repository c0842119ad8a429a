"""Work on a Ray cluster, in batches that Ray schedules and retries.

A task is put into Ray's object store once; its results go into the work folder. A machine that dies
thus loses only its current batches, which Ray does again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice
from typing import Any, TypeVar

import ray

from mapping.cluster.stage_timings import Spent
from mapping.cluster.workers import ONE_THREAD, THIS_PROCESS, do_batch, in_batches
from mapping.progress import ItemProgress, Progress
from visloc import __version__
from visloc.errors import refuse

S = TypeVar("S")
T = TypeVar("T")

# The address of a new cluster on this machine, which ends with the build.
LOCAL = "local"
# How often Ray retries a batch whose worker or machine died. Batches that ran out of memory have
# their own limit, see ``executor``.
_RETRIES = 3
# Tasks and items are small: results do not travel through it.
_OBJECT_STORE_BYTES = 256 * 2**20


class RayPool:
    """An ``Executor`` on a cluster: ``count`` batches at a time, each on one processor.

    Args:
        count: processors to ask for; an autoscaling cluster grows to them.
    """

    def __init__(self, count: int, address: str) -> None:
        own: dict[str, Any] = {}
        if address == LOCAL:
            own = {
                "num_cpus": count,
                "include_dashboard": False,
                "object_store_memory": _OBJECT_STORE_BYTES,
            }
        try:
            ray.init(
                address,
                runtime_env={"env_vars": ONE_THREAD},
                log_to_driver=False,
                logging_level=logging.ERROR,
                **own,
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise refuse(
                "build.no_cluster", field="--ray-address", got=f"{address}: {_reason(error)}"
            ) from error
        self._count = count
        self._spent = Spent()
        self._do_batch: Any = ray.remote(num_cpus=1, max_retries=_RETRIES, retry_exceptions=False)(
            _do_batch
        )

    def __enter__(self) -> RayPool:
        return self

    def __exit__(self, *_: object) -> None:
        ray.shutdown()

    @property
    def spent(self) -> Spent:
        return self._spent

    def run(self, task: Callable[[T], object], items: Sequence[T], progress: ItemProgress) -> None:
        """Do a task for every item; report progress after each batch."""
        progress(0, len(items))
        batches = iter(in_batches(items))
        shared = ray.put(task)
        running: list[ray.ObjectRef[Any]] = []
        done = 0
        try:
            while True:
                for batch in islice(batches, self._count - len(running)):
                    running.append(self._do_batch.remote(__version__, shared, batch))
                if not running:
                    return
                [ready], running = ray.wait(running)
                count, spent = _result_of(ready)
                done += count
                self._spent += spent
                progress(done, len(items))
        except BaseException:
            for one in running:
                ray.cancel(one, force=True)  # results appear whole or not at all
            raise

    def run_here(
        self, task: Callable[[T], S], items: Sequence[T], progress: ItemProgress
    ) -> list[S]:
        return THIS_PROCESS.run_here(task, items, progress)

    def run_one(
        self, task: Callable[[T, Progress], object], item: T, stage: str, progress: Progress
    ) -> None:
        self.run(partial(_do_one, task), [item], partial(progress, stage))


def _do_one(task: Callable[[T, Progress], object], item: T) -> None:
    task(item, lambda _stage, _done, _total: None)  # progress is not sent between machines


def _reason(error: BaseException) -> str:
    """Return the first cause in one line; Ray quotes the traceback of another process."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error).strip().splitlines()[-1]


def _do_batch(version: str, task: Callable[[T], object], items: Sequence[T]) -> tuple[int, Spent]:
    """Do a batch; this runs on the cluster."""
    if version != __version__:
        raise refuse(
            "build.other_version", field="--ray-address", expected=version, got=__version__
        )
    return do_batch(task, items)


def _result_of(reference: ray.ObjectRef[Any]) -> tuple[int, Spent]:
    try:
        count, spent = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None  # as the task raised it
    except ray.exceptions.RayError as error:
        raise refuse(
            "build.worker_died",
            f"a worker of the cluster ended {_RETRIES + 1} times in the same batch: it "
            "was killed or ran out of memory; finished work is kept, and the same "
            "command resumes",
            field="--executor",
            got=type(error).__name__,
        ) from error
    return int(count), spent
