"""Localizing all photos of a dataset, so that a stopped run can be taken up again."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clients.client import AsyncClient
from clients.features import Features
from clients.queries import Query
from clients.results import (
    copy_lines,
    drop_torn_line,
    read_results,
    result_line,
    write_poses,
    write_whole,
)
from clients.running import Outcome, localize_all
from clients.types import LocalizeOptions
from visloc.errors import Conflict
from visloc.geometry import PixelOrigin

_FORMAT = 1


@dataclass(frozen=True, slots=True)
class Batch:
    """A folder of results and what they are results of.

    Attributes:
        output: holds ``results.jsonl``, ``poses.txt`` and ``run.json``.
        source: the dataset or list.
        features_dir: where the features of the photos are, when not in the dataset.
        pixel_origin: where its cameras and keypoints count from.
        map_ref: ``id@version``, so that all results are of one map.
        options: for every photo.
    """

    output: Path
    source: Path
    features_dir: Path | None
    pixel_origin: PixelOrigin
    map_ref: str
    options: LocalizeOptions

    @property
    def results(self) -> Path:
        """One answer per line, with the photo's name."""
        return self.output / "results.jsonl"

    @property
    def poses(self) -> Path:
        """The poses of the localized photos, written when all are done."""
        return self.output / "poses.txt"

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
        for path in (batch.results, batch.poses, batch.description):
            path.unlink(missing_ok=True)
    described = {
        "format": _FORMAT,
        "map": batch.map_ref,
        "queries": str(batch.source.resolve()),
        "features": None if batch.features_dir is None else str(batch.features_dir.resolve()),
        "pixel_origin": batch.pixel_origin,
        "options": batch.options.given(),
    }
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


def finish_batch(batch: Batch, queries: Sequence[Query]) -> Counter[str]:
    """Bring ``results.jsonl`` into the order of the dataset and write ``poses.txt``.

    Of a photo that was asked about again the newest result is kept.

    Returns:
        How many photos are localized, not_localized, and error.
    """
    by_name = {result.name: result for result in read_results(batch.results)}
    ordered = [by_name[query.name] for query in queries]
    copy_lines(batch.results, ordered, batch.results)
    write_poses(batch.poses, ((r.name, r.pose) for r in ordered if r.pose is not None))
    return Counter(result.status for result in ordered)


def _check_same_run(path: Path, described: dict[str, Any]) -> None:
    try:
        found = json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        found = None
    if found == described:
        return
    known = found if isinstance(found, dict) else {}
    differing = [name for name, value in described.items() if known.get(name) != value]
    raise Conflict(
        "batch.other_run",
        "the folder holds results of another run; give another folder, what that run was given, "
        "or --restart to remove its results",
        field=str(path),
        expected=", ".join(f"{name} {described[name]}" for name in differing),
        got=", ".join(f"{name} {known.get(name, 'unknown')}" for name in differing),
    )
