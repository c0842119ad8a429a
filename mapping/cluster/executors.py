"""The executors of a build's work: processes of this machine, or a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

from mapping.cluster.stage_timings import Spent
from mapping.cluster.workers import Workers
from mapping.progress import ItemProgress, Progress
from visloc.errors import refuse

S = TypeVar("S")
T = TypeVar("T")

EXECUTORS = ("local", "ray")
# Ray reads these when it is loaded. It reports no usage statistics. Workers see the GPUs of their
# machine. An address where nothing listens is an error within a minute, not thirteen. A batch that
# runs out of memory is retried as often as one whose worker died, not for ever.
_RAY_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_NUM_REDIS_GET_RETRIES": "1",
    "RAY_task_oom_retries": "3",
}


class Executor(Protocol):
    """Does a task for many items, in any order, with one thread per item.

    Tasks and items are pickled for other processes. A task is a module's function, a method of a
    dataclass, or a ``functools.partial`` of one; it leaves its result in the work folder. It may
    run twice if a worker dies.
    """

    @property
    def spent(self) -> Spent:
        """Resources that other processes have used for finished items."""

    def run(self, task: Callable[[T], object], items: Sequence[T], progress: ItemProgress) -> None:
        """Do a task for every item; report progress as items are finished.

        Raises:
            Unavailable: ``build.worker_died``.
            Exception: what the task raised first; waiting items are dropped.
        """

    def run_here(
        self, task: Callable[[T], S], items: Sequence[T], progress: ItemProgress
    ) -> list[S]:
        """Do a task for every item on this machine; return the small results in the items' order.

        Worker processes have loaded what networks and matching need. If there are any, this process
        need not load it too, which would take two seconds.

        Raises:
            Unavailable: ``build.worker_died``.
            Exception: what the task raised first; waiting items are dropped.
        """

    def run_one(
        self, task: Callable[[T, Progress], object], item: T, stage: str, progress: Progress
    ) -> None:
        """Do one long task. In this process it reports its stages itself; else it is one stage.

        Raises:
            Unavailable: ``build.worker_died``.
            Exception: what the task raised.
        """


def open_executor(name: str, workers: int, ray_address: str) -> AbstractContextManager[Executor]:
    """Return an executor of ``EXECUTORS``, which ends with its ``with`` block.

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
