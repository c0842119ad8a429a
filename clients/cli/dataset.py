"""``localize batch`` and ``localize benchmark``."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from clients.cli.display import print_batch, print_failed, print_report, unit_of
from clients.cli.options import (
    Connection,
    MapRef,
    Photos,
    QueryOptions,
    Thresholds,
    spread,
    thresholds_of,
)
from clients.cli.progress import run_with_progress
from clients.client import AsyncClient
from clients.evaluation.batch import Batch, finish_batch, open_batch, run_batch
from clients.evaluation.benchmark import Run, known_poses, make_report
from clients.evaluation.modes import Arrangement, Mode, arrange, parse_modes
from clients.evaluation.pairs import read_query_pairs
from clients.evaluation.queries import QuerySet
from clients.evaluation.results import check_can_be_written, write_poses, write_whole
from clients.evaluation.run import InstantOutcome, Outcome, QueryClient, localize_all
from clients.evaluation.sent_matches import PhotoMatches
from visloc.errors import refuse
from visloc.kapture.matches import open_matches
from visloc.sequences.filling import DEFAULT_MAX_GAP_S, TimeUnit
from visloc_api.words.maps import MapInfo
from visloc_api.words.poses import PoseEstimate

_out = Console()
_err = Console(stderr=True)

_MODES = (
    "single: each photo on its own. rig: a photo without a pose gets one from the best camera of "
    "its rig at the same instant. seq: a photo without a pose gets one interpolated between the "
    "instants before and after, or the nearest one. rig+seq: both. gp3p: one pose is solved from "
    "all photos of a rig and instant; it also fills photos that did not contribute to it."
)


@dataclass(frozen=True, kw_only=True)
class DatasetRun(Photos, QueryOptions):
    """The options of the commands that localize a dataset in modes."""

    map_ref: MapRef
    pairs: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The mapping photos of each photo, best first, instead of those that the server "
            "retrieves: lines 'photo, mapping photo' or 'photo mapping photo', with a score or "
            "without.",
        ),
    ] = None
    concurrency: Annotated[int, typer.Option(min=1, max=1024, help="Photos sent at once.")] = 1
    time_unit: Annotated[
        TimeUnit | None,
        typer.Option(
            help="For seq: the unit of the dataset's timestamps; without it, inferred from their "
            "size."
        ),
    ] = None
    max_gap: Annotated[
        float,
        typer.Option(
            min=0,
            metavar="SECONDS",
            help="For seq: longest gap between two measured poses that is filled.",
        ),
    ] = DEFAULT_MAX_GAP_S
    rig: Annotated[
        str | None,
        typer.Option(
            metavar="ID",
            help="For gp3p: a rig that the map knows, instead of the dataset's own rigs.txt.",
        ),
    ] = None

    matches_dir: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="For a map of ready-made features: matches of the photos with those of --pairs, "
            "in kapture's layout (reconstruction/matches/TYPE), instead of the server's own. The "
            "features of both are in the same folder.",
        ),
    ] = None

    def arrange(self, queries: QuerySet, modes: Sequence[Mode], info: MapInfo) -> Arrangement:
        """Group the photos as the modes need it; raises as ``arrange``."""
        return arrange(
            *(queries, modes, info),
            rig_id=self.rig,
            time_unit=self.time_unit,
            max_gap_s=self.max_gap,
        )

    def read_pairs(self, queries: QuerySet) -> Mapping[str, tuple[str, ...]] | None:
        """Read the pairs, if there are any; raises as ``read_query_pairs``."""
        return None if self.pairs is None else read_query_pairs(self.pairs, queries.photos)

    def read_matches(self, pairs: Mapping[str, tuple[str, ...]] | None) -> PhotoMatches | None:
        """Open the matches, if there are any."""
        if self.matches_dir is None:
            return None
        if pairs is None:
            raise refuse("queries.matches_dir", field="--pairs", got="none")
        return PhotoMatches(open_matches(self.matches_dir), pairs)

    def further(
        self,
        mode: Mode,
        arrangement: Arrangement,
        pairs: Mapping[str, tuple[str, ...]] | None,
    ) -> dict[str, object]:
        """Return the options that count for a mode and a list, for the description of a run.

        Of pairs, also a hash of what was read: a file of this name may change.
        """
        told: dict[str, object] = {}
        if self.image_root is not None:
            told["image_root"] = str(self.image_root.resolve())
        if self.pairs is not None:
            read = json.dumps(pairs, sort_keys=True).encode()
            told |= {
                "pairs": str(self.pairs.resolve()),
                "pairs_sha256": hashlib.sha256(read).hexdigest(),
            }
        if self.matches_dir is not None:
            told["matches_dir"] = str(self.matches_dir.resolve())
        if mode is Mode.GP3P:
            told["rig"] = self.rig
        elif mode.fills_sequences:
            told |= {"time_unit": arrangement.time_unit, "max_gap_s": arrangement.max_gap_s}
        return told


@spread
def localize_batch(
    *,
    run: DatasetRun,
    output: Annotated[Path, typer.Option(help="Folder for results.jsonl and poses.")],
    mode: Annotated[Mode, typer.Option(help=_MODES)] = Mode.SINGLE,
    restart: Annotated[
        bool, typer.Option("--restart", help="Remove the results in the folder and begin again.")
    ] = False,
    connection: Connection,
) -> None:
    """Localize all photos of a dataset or list, or their ready-made features.

    Writes results.jsonl, one answer per line, and at the end poses.txt with lines
    'name qw qx qy qz tx ty tz' (cam_from_world) of the localized photos, where a blank in a name
    is %20. The same command resumes a stopped run. A photo that cannot be answered is recorded
    and skipped; if that was the server's fault, the same command sends it again.

    All modes except single fill photos that have no measured pose. Their status is filled, source
    says how, and their poses are in poses_filled.txt. poses.txt has measured poses only. With
    --option fallback=coarse, refused photos that nothing fills are in poses_coarse.txt.

    Exits with 0 when every photo has its line, 1 on an error, 130 when stopped.
    """
    options, queries = run.options, run.read()
    pairs = run.read_pairs(queries)
    matches = run.read_matches(pairs)
    with connection.client() as client:
        info = client.map(run.map_ref)
    arrangement = run.arrange(queries, [mode], info)
    read = run.reader(info, matches=matches)
    batch = Batch(
        *(output, run.source, run.features_dir, run.pixel_origin, info.ref, options, mode),
        run.further(mode, arrangement, pairs),
    )
    done = open_batch(batch, restart=restart)
    photos = queries.photos
    waiting = [query for query in photos if query.name not in done]
    # An instant is sent again as a whole.
    instants = [i for i in arrangement.asked if not all(q.name in done for q in i.photos)]
    if len(waiting) < len(photos):
        _err.print(f"{len(photos) - len(waiting)} of {len(photos)} are done already")
    failed: list[Outcome] = []

    async def work(advance: Callable[[], None]) -> None:
        def count(outcome: Outcome | InstantOutcome) -> None:
            advance()
            failed.extend(photo for photo in outcome.photos if photo.error is not None)

        async with connection.async_client() as client:
            asked = QueryClient(client, info.ref, options, read, pairs)
            if mode is Mode.GP3P:
                await run_batch(batch, instants, asked.localize_instant, run.concurrency, count)
            else:
                await run_batch(batch, waiting, asked.localize, run.concurrency, count)

    what = ("instants", len(instants)) if mode is Mode.GP3P else ("photos", len(waiting))
    run_with_progress(_err, work, *what, "the same command resumes the run")
    counts = finish_batch(batch, arrangement)
    print_failed(_err, failed)
    print_batch(_out, counts, len(photos), mode is not Mode.SINGLE)


@spread
def benchmark(
    *,
    run: DatasetRun,
    report: Annotated[Path, typer.Option(metavar="FILE.json", help="File for the figures.")],
    mode: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MODE[,MODE...]",
            help=f"Columns of the table; can be repeated; all for all. {_MODES}",
        ),
    ] = None,
    threshold: Thresholds = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the measured poses of the first mode, in the format of poses.txt of "
            "localize batch. Filled poses are not written.",
        ),
    ] = None,
    connection: Connection,
) -> None:
    """Measure how fast photos are localized, and how well if the dataset has true poses.

    Recall counts all photos with a true pose; a photo with neither a measured nor a filled pose is
    a failure. Errors are over the photos that have a pose. Latencies are measured by this client.
    Each photo is sent once for all modes together, and once more for gp3p.

    Exits with 0 when done, 1 on an error, 130 when stopped; then there is no report.
    """
    options, modes, thresholds = run.options, parse_modes(mode or ()), thresholds_of(threshold)
    check_can_be_written([report] if poses is None else [report, poses])
    queries = run.read()
    with connection.client() as client:
        info, about = client.map(run.map_ref), client.server_info()
    arrangement = run.arrange(queries, modes, info)
    pairs = run.read_pairs(queries)
    read = run.reader(info, matches=run.read_matches(pairs))
    ask = partial(QueryClient, map_ref=info.ref, options=options, read=read, pairs=pairs)
    timed = {
        in_instants: _timed(connection, ask, arrangement, run.concurrency, in_instants=in_instants)
        for in_instants in sorted({mode is Mode.GP3P for mode in modes})
    }
    runs = {mode: timed[mode is Mode.GP3P] for mode in modes}
    poses_of = {mode: arrangement.fill(mode, known_poses(each)) for mode, each in runs.items()}
    figures = make_report(runs, poses_of, thresholds, about, info)
    write_whole(report, [json.dumps(figures, indent=2, allow_nan=False).encode() + b"\n"])
    if poses is not None:
        write_poses(poses, _measured_poses(runs[modes[0]]))
    # By name: a photo that fails on its own mostly fails in its rig as well.
    outcomes = (outcome for each in timed.values() for outcome in each.outcomes)
    failed = {o.query.name: o for o in outcomes if o.error is not None}
    num_with_truth = sum(query.truth is not None for query in queries.photos)
    print_report(_out, figures, num_with_truth, len(failed), unit_of(info))
    print_failed(_err, list(failed.values()))


def _timed(
    connection: Connection,
    ask: Callable[[AsyncClient], QueryClient],
    arrangement: Arrangement,
    concurrency: int,
    *,
    in_instants: bool,
) -> Run:
    """Localize a dataset and measure how long it takes."""
    answers: list[Outcome | InstantOutcome] = []
    seconds = 0.0

    async def work(advance: Callable[[], None]) -> None:
        nonlocal seconds

        def keep(answer: Outcome | InstantOutcome) -> None:
            answers.append(answer)
            advance()

        async with connection.async_client() as client:
            asked = ask(client)
            started = time.perf_counter()
            if in_instants:
                await localize_all(arrangement.asked, asked.localize_instant, concurrency, keep)
            else:
                await localize_all(arrangement.photos, asked.localize, concurrency, keep)
            seconds = time.perf_counter() - started

    total = len(arrangement.asked if in_instants else arrangement.photos)
    what = "instants" if in_instants else "photos"
    run_with_progress(_err, work, what, total, "no report was written")
    return Run.of(answers, arrangement.photos, seconds)


def _measured_poses(run: Run) -> Iterator[tuple[str, PoseEstimate]]:
    for outcome in run.outcomes:
        if outcome.result is not None and outcome.result.pose is not None:
            yield outcome.query.name, outcome.result.pose
