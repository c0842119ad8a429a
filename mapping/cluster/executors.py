"""The executors of a build's work: processes of this machine, or what an extension adds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

from mapping.cluster.stage_timings import Spent
from mapping.cluster.workers import Workers
from mapping.progress import ItemProgress, Progress
from visloc.extensions import EXECUTORS, extensions, load

S = TypeVar("S")
T = TypeVar("T")

LOCAL = "local"


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
        """Do a task for every item; report progress as items are finished."""

    def run_here(
        self, task: Callable[[T], S], items: Sequence[T], progress: ItemProgress
    ) -> list[S]:
        """Do a task for every item on this machine; return the small results in the items' order.

        Worker processes have loaded what networks and matching need. If there are any, this process
        need not load it too, which would take two seconds.
        """

    def run_one(
        self, task: Callable[[T, Progress], object], item: T, stage: str, progress: Progress
    ) -> None:
        """Do one long task. In this process it reports its stages itself; else it is one stage."""


def executor_names() -> list[str]:
    """Return the names of all executors."""
    return [LOCAL, *extensions(EXECUTORS)]


def open_executor(name: str, workers: int, ray_address: str) -> AbstractContextManager[Executor]:
    """Return an executor of ``executor_names()``, which ends with its ``with`` block."""
    if name == LOCAL:
        return Workers(workers)
    opened: AbstractContextManager[Executor] = load(extensions(EXECUTORS)[name])(
        workers, ray_address
    )
    return opened
