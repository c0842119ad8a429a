"""A sequence in a set of maps, in worker processes: its instants come solved, from any tile."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.values import InstantJob, Localization, PackedSolved, SequenceJob, check_order
from service.workers.instants import SolvedInMap
from service.workers.sequences import check_number, guessed_unit
from visloc.archive import SetOutline, SetWorld
from visloc.errors import inside, refuse
from visloc.geometry import Similarity
from visloc.localization.solving import Solved
from visloc.pose.motion import moved_pose
from visloc.priors import Priors
from visloc.sequences.filling import Odometry
from visloc.sequences.solver import SeenInstant, SequenceSolver, check_max_gap, check_odometry
from visloc.types import InstantAnswer, PoseSource
from visloc_extensions.sets.choosing import allowed_tiles
from visloc_extensions.sets.frame import scaled_device


class SetFrame:
    """The frame of a set, for poses and priors."""

    def __init__(self, outline: SetOutline) -> None:
        self._outline = outline
        box = outline.manifest.world.extent
        self.origin = np.add(box.min, box.max) / 2
        self.down = outline.gravity

    @property
    def world(self) -> SetWorld:
        return self._outline.manifest.world

    def leads_out(self, center: NDArray[np.float64]) -> float | None:
        """Return how far a centre (3,) is from the nearest tile; None within its sight."""
        boxes, center = self._outline.photo_boxes, center + self.origin
        away = np.linalg.norm(center - np.clip(center, boxes[:, 0], boxes[:, 1]), axis=1)
        return None if (away <= self._outline.reaches).any() else float(away.min())


class SetRun:
    """Puts the instants of a sequence in order, in the frame of a set."""

    def __init__(self, start: SequenceJob, outline: SetOutline, frame: SetFrame) -> None:
        check_max_gap(start.max_gap_s)
        self._start, self._outline, self._frame = start, outline, frame
        self._before: tuple[int, int] | None = None  # index and timestamp
        self._solver: SequenceSolver | None = None
        self._waiting: list[Localization] = []
        self._localized_in: list[str | None] = []  # tile of each instant; None for a refused one

    @property
    def cameras(self) -> bytes:
        """What the instants so far say of their cameras, for ``solve_instant`` of the next."""
        return pickle.dumps({} if self._solver is None else self._solver.cameras)

    def check(self, index: int, instant: InstantJob, max_instants: int) -> Priors:
        """Refuse an instant that no tile can take, and return its priors."""
        check_number(index, max_instants)
        with inside(f"instants[{index}]"):
            if self._before is not None and self._before[0] < index:
                check_order(self._before[1], instant.timestamp)
            self._before = index, instant.timestamp
            if instant.priors is None:
                return self._start.priors
            if instant.priors.maps is not None:
                allowed_tiles(self._outline, Priors(maps=instant.priors.maps))
            return instant.priors

    def add(
        self,
        instant: InstantJob,
        row: int,
        found: Localization,
        packed: PackedSolved,
        priors: Priors,
    ) -> list[Localization]:
        """Take the next instant, solved in the tile of this row; return the final answers."""
        if self._solver is None:
            self._solver = SequenceSolver(
                self._frame,
                metric=True,  # odometry comes in the unit of the frame
                options=self._start.options,
                time_unit=self._start.time_unit or guessed_unit(instant.timestamp),
                max_gap_s=self._start.max_gap_s,
            )
        in_tile: SolvedInMap = pickle.loads(packed)  # by a worker of this service
        tile = self._outline.tiles[row].set_from_tile.similarity
        solved = solved_in_set(in_tile.solved, tile, in_tile.origin, self._frame.origin)
        solved = replace(solved, answer=found.answer)
        if found.answer.refusal is not None:  # perhaps because of another tile
            solved = solved.refused(found.answer.refusal)
        with inside(f"instants[{len(self._localized_in)}]"):
            odometry = self._in_unit(instant.odometry, tile.scale if in_tile.metric else None)
        if self._frame.down is None and priors.gravity is not None and priors.gravity.world is None:
            priors = replace(priors, gravity=None)  # which only the tile could check
        self._waiting.append(found)
        self._localized_in.append(None if solved.pose is None else found.tile)
        return self._in_order(
            self._solver.take(SeenInstant(instant.timestamp, (), odometry, priors), solved)
        )

    def finish(self) -> list[Localization]:
        """Return the answers that waited for further instants."""
        if self._solver is None:
            raise refuse("sequence.empty", field="instants")
        return self._in_order(self._solver.finish())

    def _in_unit(self, odometry: Odometry | None, metre: float | None) -> Odometry | None:
        """Return odometry in the unit of the set; ``metre`` is what a metric tile has for one."""
        if odometry is None or self._frame.world.metric:
            return odometry
        check_odometry(odometry, metric=metre is not None)
        assert metre is not None  # it was checked
        unit = np.repeat([1.0, metre], 3)
        pose, covariance = odometry.rig_from_odometry, odometry.covariance
        return Odometry(
            replace(pose, translation=metre * pose.translation),
            None if covariance is None else covariance * np.outer(unit, unit),
        )

    def _in_order(self, answers: Sequence[InstantAnswer]) -> list[Localization]:
        first = len(self._localized_in) - len(self._waiting)
        found, self._waiting = self._waiting[: len(answers)], self._waiting[len(answers) :]
        for i, answer in enumerate(answers, first):
            if answer.pose is None or answer.pose.source is not PoseSource.ESTIMATED:
                self._localized_in[i] = None  # perhaps its neighbours overruled it
        return [
            replace(one, answer=answer, tile=self._tile(i, answer) or one.tile)
            for i, (one, answer) in enumerate(zip(found, answers, strict=True), first)
        ]

    def _tile(self, index: int, answer: InstantAnswer) -> str | None:
        """Return the tile of a pose; a filled one has that of the nearest localized instant."""
        localized = [i for i, tile in enumerate(self._localized_in) if tile is not None]
        if answer.pose is None or not localized:
            return None
        return self._localized_in[min(localized, key=lambda i: abs(i - index))]


def solved_in_set(
    solved: Solved,
    set_from_tile: Similarity,
    tile_origin: NDArray[np.float64],
    set_origin: NDArray[np.float64],
) -> Solved:
    """Move the pose and the views of an instant from a tile to the set; its answer stays.

    Args:
        solved: relative to the origin of the tile.
        tile_origin: (3,) in the tile.
        set_origin: (3,) in the set, which the result is relative to.
    """
    scale = set_from_tile.scale
    moved = Similarity(scale, set_from_tile.rotation, set_from_tile.apply(tile_origin) - set_origin)
    views = tuple(
        replace(
            view,
            cam_from_rig=scaled_device(view.cam_from_rig, scale),
            points=moved.apply(view.points),
        )
        for view in solved.views
    )
    pose = solved.pose
    if pose is not None and pose.covariance is not None:
        there, of_camera = pose.rig_from_world, pose.of_camera
        in_set, covariance = moved_pose(there, pose.covariance, moved)
        if of_camera is not None:
            _, of_camera = moved_pose(there, of_camera, moved)
        pose = replace(pose, rig_from_world=in_set, covariance=covariance, of_camera=of_camera)
    errors = replace(solved.errors, position_std=scale * solved.errors.position_std)
    return replace(solved, views=views, pose=pose, errors=errors)
