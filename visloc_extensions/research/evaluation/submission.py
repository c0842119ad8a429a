"""Poses for visuallocalization.net, under the names that it knows.

Its rules, as hloc (``localize_sfm.py``) and kapture (``kapture_export_LTVL2020.py``) follow them:
a line ``name qw qx qy qz tx ty tz`` of ``cam_from_world`` for each photo. The name has no folders;
for RobotCar Seasons it has the camera's. A photo without a pose gets that of the first retrieved
mapping photo, as in hloc.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from clients.evaluation.filling import estimate_of
from clients.evaluation.results import StoredResult, read_results
from visloc.errors import refuse
from visloc.geometry import Pose
from visloc_api.words.poses import PoseEstimate
from visloc_extensions.research.evaluation.pose_files import KnownPose


class Benchmark(StrEnum):
    """A data set of visuallocalization.net."""

    AACHEN = "aachen"
    AACHEN_V1_1 = "aachen-v1.1"
    INLOC = "inloc"
    ROBOTCAR = "robotcar"
    CMU = "cmu"


def _file_name(photo: str) -> str:
    return photo.rpartition("/")[2]


def _camera_and_file_name(photo: str) -> str:
    parts = photo.split("/")
    if len(parts) < 2:
        raise refuse("submission.camera", field=photo)
    return "/".join(parts[-2:])


_NAMES: Mapping[Benchmark, Callable[[str], str]] = {
    **dict.fromkeys(Benchmark, _file_name),
    Benchmark.ROBOTCAR: _camera_and_file_name,
}


@dataclass(frozen=True, slots=True, eq=False)
class Submission:
    """The poses of a submission.

    Attributes:
        poses: by the benchmark's name, in the order of the results.
        counts: photos by the source of their pose: localized, filled (by the mode of the batch),
            retrieved, and missing, which have no line.
    """

    poses: Mapping[str, PoseEstimate | Pose]
    counts: Counter[str]


def make_submission(
    results: Path, benchmark: Benchmark, mapping: Mapping[str, KnownPose]
) -> Submission:
    """Name and complete the poses of a batch.

    Args:
        mapping: poses of the mapping photos by name. Without them no photo is filled.
    """
    path = results / "results.jsonl" if results.is_dir() else results
    newest = {result.name: result for result in read_results(path)}
    if not newest:
        raise refuse("submission.results", field=str(path))
    poses: dict[str, PoseEstimate | Pose] = {}
    photos: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for result in newest.values():
        name = _NAMES[benchmark](result.name)
        if name in photos:
            raise refuse("submission.names", field=name, got=f"{photos[name]}, {result.name}")
        photos[name] = result.name
        source, pose = _pose(result, mapping)
        counts[source] += 1
        if pose is not None:
            poses[name] = pose
    return Submission(poses, counts)


def _pose(
    result: StoredResult, mapping: Mapping[str, KnownPose]
) -> tuple[str, PoseEstimate | Pose | None]:
    if result.pose is not None:
        return "localized", result.pose
    if result.filled is not None:
        return "filled", estimate_of(result.filled)
    if not mapping or not result.retrieved:
        return "missing", None
    first = result.retrieved[0]
    if first not in mapping:
        raise refuse("submission.mapping", field=first, got=f"{len(mapping)} poses of other photos")
    return "retrieved", mapping[first].pose
