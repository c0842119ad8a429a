"""Localizing all photos of a dataset in a run that can be stopped and resumed."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from clients.evaluation.filling import estimate_of, measured
from clients.evaluation.modes import Arrangement, Mode
from clients.evaluation.results import (
    StoredResult,
    copy_lines,
    drop_torn_line,
    read_results,
    result_line,
    write_poses,
    write_whole,
)
from clients.evaluation.run import InstantOutcome, Outcome, localize_all
from visloc.errors import refuse
from visloc.geometry import PixelOrigin
from visloc.sequences.filling import TracedPose
from visloc_api.words.options import LocalizeOptions

_FORMAT = 1
_T = TypeVar("_T")
_Outcome = TypeVar("_Outcome", Outcome, InstantOutcome)


@dataclass(frozen=True, slots=True)
class Batch:
    """A folder of results, and the run that they belong to.

    Attributes:
        output: holds ``results.jsonl``, ``poses.txt``, ``poses_filled.txt`` and ``run.json``.
        features_dir: of the photos' features, when they are not in the dataset.
        pixel_origin: of the dataset's cameras and keypoints.
        map_ref: ``id@version``, so that all results are of one map.
        further: options that not every run has, for the description.
    """

    output: Path
    source: Path
    features_dir: Path | None
    pixel_origin: PixelOrigin
    map_ref: str
    options: LocalizeOptions
    mode: Mode = Mode.SINGLE
    further: Mapping[str, object] = field(default_factory=dict)

    @property
    def results(self) -> Path:
        """One answer per line, with the photo's name."""
        return self.output / "results.jsonl"

    @property
    def poses(self) -> Path:
        """The measured poses, written when all photos are done."""
        return self.output / "poses.txt"

    @property
    def poses_filled(self) -> Path:
        """The filled poses, in a file of their own so that nobody takes them for measured ones."""
        return self.output / "poses_filled.txt"

    @property
    def poses_coarse(self) -> Path:
        """The poses that retrieval alone told, apart for the same reason."""
        return self.output / "poses_coarse.txt"

    @property
    def description(self) -> Path:
        """The map, the photos and the options of the run."""
        return self.output / "run.json"


def open_batch(batch: Batch, *, restart: bool) -> set[str]:
    """Prepare the folder and return the names of the photos that are done.

    A photo is done when the folder has its result, unless that is an error of the server.
    """
    batch.output.mkdir(parents=True, exist_ok=True)
    if restart:
        poses = (batch.poses, batch.poses_filled, batch.poses_coarse)
        for path in (batch.results, *poses, batch.description):
            path.unlink(missing_ok=True)
    described = {
        "format": _FORMAT,
        "map": batch.map_ref,
        "queries": str(batch.source.resolve()),
        "features": None if batch.features_dir is None else str(batch.features_dir.resolve()),
        "pixel_origin": batch.pixel_origin,
        "options": batch.options.given(),
    }
    if batch.mode is not Mode.SINGLE:
        described["mode"] = batch.mode.value
    described |= batch.further
    if batch.results.exists():
        _check_same_run(batch.description, described)
    else:
        write_whole(batch.description, [json.dumps(described, indent=2).encode() + b"\n"])
    drop_torn_line(batch.results)
    newest = {result.name: result for result in read_results(batch.results)}
    return {name for name, result in newest.items() if result.is_final}


async def run_batch(
    batch: Batch,
    items: Iterable[_T],
    localize: Callable[[_T], Awaitable[_Outcome]],
    concurrency: int,
    on_outcome: Callable[[_Outcome], None],
) -> None:
    """Localize photos or instants; each one's results are appended to the folder at once."""
    with batch.results.open("a", encoding="utf-8") as file:

        def keep(outcome: _Outcome) -> None:
            file.write("".join(map(result_line, outcome.photos)))
            file.flush()
            on_outcome(outcome)

        await localize_all(items, localize, concurrency, keep)


def finish_batch(batch: Batch, arrangement: Arrangement) -> Counter[str]:
    """Sort ``results.jsonl`` as the dataset, fill poses, and write them.

    The newest result of a photo is kept. ``poses_filled.txt`` is written in the modes that fill,
    and in gp3p when any pose was filled; ``poses_coarse.txt`` when a photo has no better one.

    Returns:
        How many photos are localized, filled, coarse, not_localized and error, and how many were
        filled from each source.
    """
    by_name = {result.name: result for result in read_results(batch.results)}
    ordered = [by_name[query.name] for query in arrangement.photos]
    poses = arrangement.fill(batch.mode, [_known(result, batch.mode) for result in ordered])
    filled = {
        result.name: pose
        for result, pose in zip(ordered, poses, strict=True)
        if result.pose is None and pose is not None
    }
    copy_lines(batch.results, ordered, batch.results, filled)
    write_poses(batch.poses, ((r.name, r.pose) for r in ordered if r.pose is not None))
    if batch.mode.fills or filled:
        write_poses(batch.poses_filled, ((name, estimate_of(p)) for name, p in filled.items()))
    else:
        batch.poses_filled.unlink(missing_ok=True)
    coarse = [(r.name, r.coarse) for r in ordered if r.coarse is not None and r.name not in filled]
    if coarse:
        write_poses(batch.poses_coarse, coarse)
    else:
        batch.poses_coarse.unlink(missing_ok=True)
    statuses = ("filled" if r.name in filled else r.status for r in ordered)
    return Counter(statuses) + Counter(pose.source.value for pose in filled.values())


def _known(result: StoredResult, mode: Mode) -> TracedPose | None:
    if result.pose is not None:
        return measured(result.pose, result.num_inliers)
    # In gp3p the answer filled the pose; in the other modes poses are filled again.
    return result.filled if mode is Mode.GP3P else None


def _check_same_run(path: Path, described: dict[str, Any]) -> None:
    try:
        found = json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        found = None
    if found == described:
        return
    known = found if isinstance(found, dict) else {}
    names = dict.fromkeys((*described, *known))
    differing = [name for name in names if known.get(name) != described.get(name)]
    raise refuse(
        "batch.other_run",
        field=str(path),
        expected=", ".join(f"{name} {described.get(name)}" for name in differing),
        got=", ".join(f"{name} {known.get(name, 'unknown')}" for name in differing),
    )
