"""Poses that exist already: poses files, results of a batch, kapture trajectories."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clients.evaluation.results import read_results
from visloc.errors import DatasetError, InvalidInput, refuse
from visloc.geometry import Pose
from visloc.kapture import read_dataset

_RESULTS = "results.jsonl"


@dataclass(frozen=True, slots=True, eq=False)
class KnownPose:
    """A pose of a file.

    Attributes:
        covariance: (6, 6) of rotation (rad) then translation; None where the file has none.
    """

    pose: Pose
    covariance: NDArray[np.float64] | None = None


def read_poses(path: Path) -> dict[str, KnownPose]:
    """Read the poses of photos, by the photo's name.

    Args:
        path: a text file with lines ``name qw qx qy qz tx ty tz`` of ``cam_from_world``, as
            ``localize batch``, hloc and kapture write them and visuallocalization.net takes them;
            a kapture folder; ``results.jsonl``, or the folder that ``localize batch`` wrote.
    """
    if (path / _RESULTS).is_file():
        path = path / _RESULTS
    if path.is_dir():
        dataset = read_dataset(path)
        posed = ((record.path, dataset.pose(record)) for record in dataset.images)
        return {name: KnownPose(pose) for name, pose in posed if pose is not None}
    if not path.is_file():
        raise refuse("poses.missing", field=str(path))
    return dict(_of_results(path)) if path.suffix == ".jsonl" else _of_text(path)


def _of_results(path: Path) -> Iterator[tuple[str, KnownPose]]:
    for result in read_results(path):
        if result.pose is not None:
            yield result.name, KnownPose(result.pose.cam_from_world, result.pose.covariance)
        elif result.filled is not None:
            yield result.name, KnownPose(result.filled.pose, result.filled.covariance)


def _of_text(path: Path) -> dict[str, KnownPose]:
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise refuse("poses.unreadable", field=str(path), got=str(error)) from error
    poses: dict[str, KnownPose] = {}
    for number, line in enumerate(lines, start=1):
        fields, where = line.split(), f"{path}:{number}"
        if not fields:
            continue
        name = fields[0]
        is_comment = name.startswith("#")  # or the pose of a photo of such a name
        try:
            pose = _pose_in(fields, where)
        except DatasetError:
            if is_comment:
                continue
            raise
        if name not in poses:
            poses[name] = KnownPose(pose)
        elif not is_comment:
            raise refuse("poses.duplicate", field=where, got=name)
    return poses


def _pose_in(fields: Sequence[str], where: str) -> Pose:
    try:
        numbers = [float(field) for field in fields[1:]]
    except ValueError:
        numbers = []
    if len(numbers) != 7:
        raise refuse("poses.line", field=where, got=f"{len(fields)} fields: {' '.join(fields)}")
    try:
        return Pose.from_quaternion(numbers[:4], numbers[4:])
    except InvalidInput as error:
        raise error.about(where, DatasetError) from None
