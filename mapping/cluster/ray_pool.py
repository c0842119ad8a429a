"""Work on a Ray cluster: the same task for many items, in batches that Ray schedules and retries.

What a task needs is put into Ray's object store once; what it makes goes into the work folder. So
a machine that dies takes nothing along but the batches that it was at, which Ray does again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice
from types import TracebackType
from typing import Any, TypeVar

import ray

from mapping.cluster.stage_timings import Spent
from mapping.cluster.workers import ONE_THREAD, do_batch, in_batches
from visloc import __version__
from visloc.errors import refuse

T = TypeVar("T")

# An address of its own: a cluster of this machine that ends with the build.
LOCAL = "local"
# How often Ray does a batch again whose worker or machine died; of those that ended for want of
# memory it keeps a count of its own, see ``executors``.
_RETRIES = 3
# Tasks and items are small: results do not travel through it.
_OBJECT_STORE_BYTES = 256 * 2**20


class RayPool:
    """Does work on a cluster, ``count`` batches at a time, each on one processor.

    Args:
        count: processors that are asked for; a cluster that scales itself gets as many.
        address: ``local``, ``auto``, HOST:PORT or ``ray://HOST:PORT``, as Ray has them.

    Raises:
        Unavailable: ``build.no_cluster``.
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        ray.shutdown()

    @property
    def spent(self) -> Spent:
        """What the batches that are done have used up."""
        return self._spent

    def run(
        self, task: Callable[[T], object], items: Sequence[T], progress: Callable[[int, int], None]
    ) -> None:
        """Do the task for every item; tell the progress after each batch.

        Raises:
            Unavailable: ``build.worker_died`` when a batch ended with its worker every time;
                ``build.other_version`` when the cluster has another visloc.
            Exception: what the task raised first; what is under way is cancelled.
        """
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

    def run_one(
        self,
        task: Callable[[T, Callable[[int, int], None]], object],
        item: T,
        progress: Callable[[int, int], None],
    ) -> None:
        """Do one long task on the cluster, of which only the begin and the end are told.

        Raises:
            Unavailable: as ``run``.
            Exception: what the task raised.
        """
        self.run(partial(_do_one, task), [item], progress)


def _do_one(task: Callable[[T, Callable[[int, int], None]], object], item: T) -> None:
    task(item, lambda _done, _total: None)  # progress does not travel from machine to machine


def _reason(error: BaseException) -> str:
    """What went wrong first, in a line: Ray quotes the traceback of another process."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error).strip().splitlines()[-1]


def _do_batch(version: str, task: Callable[[T], object], items: Sequence[T]) -> tuple[int, Spent]:
    """What runs on the cluster."""
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
            (
                f"a worker of the cluster ended {_RETRIES + 1} times in the same batch: it "
                "was killed or ran out of memory; finished work is kept, and the same "
                "command resumes"
            ),
            field="--executor",
            got=type(error).__name__,
        ) from error
    return int(count), spent
