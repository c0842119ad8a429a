"""Where the work of a build is done: in processes of this machine, or on a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

from mapping.cluster.stage_timings import Spent
from mapping.cluster.workers import Workers
from visloc.errors import refuse

T = TypeVar("T")

EXECUTORS = ("local", "ray")
# Ray reads these when it is loaded. Nothing is reported to anyone; no worker is shown other GPUs
# than its machine has; an address where nothing listens is an error within a minute, not thirteen;
# a batch for which there is not enough memory is tried as often as one whose worker died, not for
# ever.
_RAY_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_NUM_REDIS_GET_RETRIES": "1",
    "RAY_task_oom_retries": "3",
}


class Executor(Protocol):
    """Does a task for many items, in any order, with one thread for each.

    A task and its items travel to other processes: the task is a module's function, a method of a
    dataclass or a ``functools.partial`` of one, and leaves its result in the work folder. It may be
    done twice, where a worker died.
    """

    @property
    def spent(self) -> Spent:
        """What other processes have used up so far for the items that are done."""
        ...

    def run(
        self, task: Callable[[T], object], items: Sequence[T], progress: Callable[[int, int], None]
    ) -> None:
        """Do the task for every item; tell the progress as items are done.

        Raises:
            Unavailable: ``build.worker_died``.
            Exception: what the task raised first; waiting items are dropped.
        """
        ...

    def run_one(
        self,
        task: Callable[[T, Callable[[int, int], None]], object],
        item: T,
        progress: Callable[[int, int], None],
    ) -> None:
        """Do one long task; it tells the progress itself where it is done in this process.

        Raises:
            Unavailable: ``build.worker_died``.
            Exception: what the task raised.
        """
        ...


def open_executor(name: str, workers: int, ray_address: str) -> AbstractContextManager[Executor]:
    """Return an executor, which ends with its ``with`` block.

    Args:
        name: of ``EXECUTORS``.
        workers: how many items are worked on at a time.
        ray_address: of the cluster, for ``ray``.

    Raises:
        InvalidInput: ``build.no_ray``.
        Unavailable: ``build.no_cluster``.
    """
    if name == "local":
        return Workers(workers)
    for setting, value in _RAY_SETTINGS.items():
        os.environ.setdefault(setting, value)
    try:
        from mapping.cluster.ray_pool import RayPool  # ray is optional
    except ImportError as error:
        raise refuse("build.no_ray", field="--executor", got=str(error)) from error
    return RayPool(workers, ray_address)
