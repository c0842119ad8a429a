"""Localizing all photos of a dataset, so that a stopped run can be taken up again."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clients.client import AsyncClient
from clients.evaluation.filling import estimate_of, measured
from clients.evaluation.instants import QueryInstant
from clients.evaluation.modes import Arrangement, Mode
from clients.evaluation.queries import Query
from clients.evaluation.results import (
    StoredResult,
    copy_lines,
    drop_torn_line,
    read_results,
    result_line,
    write_poses,
    write_whole,
)
from clients.evaluation.running import InstantOutcome, Outcome, localize_all, localize_instants
from clients.wire.features import Features
from clients.wire.types import LocalizeOptions
from visloc.errors import refuse
from visloc.geometry import PixelOrigin
from visloc.sequences.filling import TracedPose

_FORMAT = 1


@dataclass(frozen=True, slots=True)
class Batch:
    """A folder of results and what they are results of.

    Attributes:
        output: holds ``results.jsonl``, ``poses.txt``, ``poses_filled.txt`` and ``run.json``.
        source: the dataset or list.
        features_dir: where the features of the photos are, when not in the dataset.
        pixel_origin: where its cameras and keypoints count from.
        map_ref: ``id@version``, so that all results are of one map.
        options: for every photo.
        mode: what is made of the answers.
        arranged: what more the mode is told, for the description.
    """

    output: Path
    source: Path
    features_dir: Path | None
    pixel_origin: PixelOrigin
    map_ref: str
    options: LocalizeOptions
    mode: Mode = Mode.SINGLE
    arranged: Mapping[str, object] = field(default_factory=dict)

    @property
    def results(self) -> Path:
        """One answer per line, with the photo's name."""
        return self.output / "results.jsonl"

    @property
    def poses(self) -> Path:
        """The poses that were measured, written when all are done."""
        return self.output / "poses.txt"

    @property
    def poses_filled(self) -> Path:
        """The poses from other photos, apart, so that nobody takes them for measured ones."""
        return self.output / "poses_filled.txt"

    @property
    def description(self) -> Path:
        """What the results are of."""
        return self.output / "run.json"


def open_batch(batch: Batch, *, restart: bool) -> set[str]:
    """Make the folder ready and return the names of the photos that need not be asked about.

    Those are the photos that it has results of, but for errors of the server.

    Raises:
        Conflict: ``batch.other_run`` when the folder holds results of something else, and
            ``restart``, which removes them, is not set.
        DatasetError: ``results.line`` when ``results.jsonl`` is damaged.
    """
    batch.output.mkdir(parents=True, exist_ok=True)
    if restart:
        for path in (batch.results, batch.poses, batch.poses_filled, batch.description):
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
        described |= {"mode": batch.mode.value, **batch.arranged}
    if batch.results.exists():
        _check_same_run(batch.description, described)
    else:
        write_whole(batch.description, [json.dumps(described, indent=2).encode() + b"\n"])
    drop_torn_line(batch.results)
    newest = {result.name: result for result in read_results(batch.results)}
    return {name for name, result in newest.items() if result.is_final}


async def run_batch(
    batch: Batch,
    client: AsyncClient,
    queries: Sequence[Query],
    concurrency: int,
    on_outcome: Callable[[Outcome], None],
    read: Callable[[Query], bytes | Features],
) -> None:
    """Localize ``queries`` and append each result to the folder at once.

    Raises:
        VislocError: what makes going on pointless; the results so far are kept.
    """
    with batch.results.open("a", encoding="utf-8") as file:

        def keep(outcome: Outcome) -> None:
            file.write(result_line(outcome))
            file.flush()
            on_outcome(outcome)

        await localize_all(client, queries, batch.map_ref, batch.options, concurrency, keep, read)


async def run_instants(
    batch: Batch,
    client: AsyncClient,
    instants: Sequence[QueryInstant],
    concurrency: int,
    on_outcome: Callable[[InstantOutcome], None],
    read: Callable[[Query], bytes | Features],
) -> None:
    """As ``run_batch``, for instants; the results of an instant are appended together.

    Raises:
        VislocError: as ``run_batch``.
    """
    with batch.results.open("a", encoding="utf-8") as file:

        def keep(outcome: InstantOutcome) -> None:
            file.write("".join(map(result_line, outcome.photos)))
            file.flush()
            on_outcome(outcome)

        await localize_instants(
            client, instants, batch.map_ref, batch.options, concurrency, keep, read
        )


def finish_batch(batch: Batch, arrangement: Arrangement) -> Counter[str]:
    """Bring ``results.jsonl`` into the order of the dataset, fill, and write the poses.

    Of a photo that was asked about again the newest result is kept. ``poses_filled.txt`` is
    written in the modes that fill, and in gp3p when any pose was filled.

    Returns:
        How many photos are localized, filled, not_localized, and error; and how many were filled
        from each source.
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
    statuses = ("filled" if r.name in filled else r.status for r in ordered)
    return Counter(statuses) + Counter(pose.source.value for pose in filled.values())


def _known(result: StoredResult, mode: Mode) -> TracedPose | None:
    if result.pose is not None:
        return measured(result.pose, result.num_inliers)
    # What the other modes have filled is filled anew, but in gp3p it came with the answer.
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
