"""The shared inputs of all stages of a job."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from mapping.cluster.executors import Executor
from mapping.progress import Progress
from mapping.stages.camera_mask import CameraMask
from mapping.stages.local_features import LocalFeaturesSource
from mapping.stages.networks import Networks
from mapping.stages.work_folder import WorkFolder
from visloc.kapture.matches import MatchFiles

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class BuildContext:
    """The shared inputs of all stages of a build or an update.

    Attributes:
        matches: of another program, instead of our own; they name rows of ``features``.
        fixed: masks, by sensor, in which these matches are left out.
    """

    work: WorkFolder
    features: LocalFeaturesSource
    networks: Networks
    workers: Executor
    progress: Progress
    matches: MatchFiles | None = None
    fixed: Mapping[str, CameraMask] = field(default_factory=dict)

    def run(self, stage: str, task: Callable[[T], object], items: Sequence[T]) -> None:
        """Do a task for every item, as one stage."""
        self.workers.run(task, items, partial(self.progress, stage))
