"""The ``localize`` command."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from clients.cli.compare import compare
from clients.cli.connection_options import (
    DEFAULT_SERVER,
    ApiKeyFile,
    Ca,
    Server,
    TimeoutS,
    api_key_of,
)
from clients.cli.display import (
    UNKNOWN_UNIT,
    print_batch,
    print_failed,
    print_line,
    print_report,
    print_result,
    unit_of,
)
from clients.cli.maps import maps_app
from clients.cli.progress import run_with_progress
from clients.cli.query_options import (
    FeaturesDir,
    MapRef,
    Options,
    Origin,
    Seed,
    Source,
    Thresholds,
    options_of,
    thresholds_of,
)
from clients.client import DEFAULT_TIMEOUT_S, AsyncClient, Client
from clients.errors import not_understood
from clients.evaluation.batch import Batch, finish_batch, open_batch, run_batch, run_instants
from clients.evaluation.benchmark import Run, known_poses, make_report
from clients.evaluation.dataset_run import Asking
from clients.evaluation.modes import DEFAULT_MAX_GAP_S, Arrangement, Mode, arrange, parse_modes
from clients.evaluation.queries import read_queries
from clients.evaluation.readers import choose_reader
from clients.evaluation.results import check_can_be_written, write_poses, write_whole
from clients.evaluation.run import InstantOutcome, Outcome
from clients.wire.priors import priors_from_text
from clients.wire.types import PoseEstimate
from visloc.errors import VislocError
from visloc.geometry import Camera, PixelOrigin
from visloc.sequences.filling import TimeUnit

EXIT_ERROR = 1  # 2 is wrong usage, by convention
EXIT_NOT_LOCALIZED = 3

app = typer.Typer(
    name="localize",
    help="Ask a localization service where photos were taken.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
_out = Console()
_err = Console(stderr=True)

Concurrency = Annotated[
    int, typer.Option("--concurrency", min=1, max=1024, help="Photos asked about at once.")
]
_MODES = (
    "single: each photo on its own. rig: a photo without a pose gets that of the best camera of "
    "its rig and instant. seq: ... that between the instants before and after, or of the nearest. "
    "rig+seq: both. gp3p: the photos of a rig and instant solve one pose, which also fills the "
    "photos that did not contribute to it."
)
MaxGap = Annotated[
    float,
    typer.Option(
        "--max-gap",
        min=0,
        metavar="SECONDS",
        help="For seq: longest time between poses that others are filled from.",
    ),
]
TimeUnitOption = Annotated[
    TimeUnit | None,
    typer.Option(
        "--time-unit",
        help="For seq: what the dataset's timestamps count; without it, by their size.",
    ),
]
RigOption = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="ID",
        help="For gp3p: a rig that the map knows, instead of the dataset's own rigs.txt.",
    ),
]
app.add_typer(maps_app, name="maps")
app.command()(compare)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and exit; errors are one line, not a traceback."""
    try:
        # compare writes down how it was called.
        app(arguments, obj=tuple(sys.argv[1:] if arguments is None else arguments))
    except VislocError as error:
        _fail(error.code, str(error))
    except OSError as error:  # a full disk, a folder without permission
        _fail("system", str(error))


@app.command()
def image(
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", help="The photo to localize.")],
    map_ref: MapRef,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL,W,H,PARAMS...",
            help="Intrinsics, such as PINHOLE,640,480,525,525,320,240. Without them the server "
            "uses the focal length in EXIF, or estimates or guesses one.",
        ),
    ] = None,
    server: Server = DEFAULT_SERVER,
    as_json: Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")] = False,
    option: Options = None,
    seed: Seed = None,
    priors: Annotated[
        str | None,
        typer.Option(
            metavar="JSON_OR_FILE",
            help="What is known of the pose: position, height, pose or gravity, as in the API.",
        ),
    ] = None,
    debug: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.jpg", help="Write a picture of the matches and their mapping photos."
        ),
    ] = None,
    api_key_file: ApiKeyFile = None,
    ca: Ca = None,
    timeout_s: TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Localize one photo.

    Exits with 0 when localized, 3 when not localized, 1 on an error, 2 on wrong usage.
    """
    options = options_of(option, seed)
    intrinsics = None if camera is None else Camera.from_text(camera)
    known = None if priors is None else priors_from_text(priors)
    check_can_be_written([] if debug is None else [debug])
    with Client(server, api_key=api_key_of(api_key_file), ca=ca, timeout_s=timeout_s) as client:
        result = client.localize(
            photo, map_ref, intrinsics, options, priors=known, debug=debug is not None
        )
        if as_json:
            typer.echo(json.dumps(result.raw, indent=2))
        else:
            print_result(_out, result, _unit(client, f"{result.map.id}@{result.map.version}"))
    if debug is not None:
        if result.debug is None:
            raise not_understood(server, "an answer without the picture that was asked for")
        write_whole(debug, [result.debug.overlay])
    if not result.localized:
        raise typer.Exit(EXIT_NOT_LOCALIZED)


@app.command("batch")
def localize_batch(
    source: Source,
    map_ref: MapRef,
    output: Annotated[Path, typer.Option(help="Folder for results.jsonl and poses.")],
    server: Server = DEFAULT_SERVER,
    option: Options = None,
    seed: Seed = None,
    concurrency: Concurrency = 1,
    mode: Annotated[Mode, typer.Option(help=_MODES)] = Mode.SINGLE,
    time_unit: TimeUnitOption = None,
    max_gap: MaxGap = DEFAULT_MAX_GAP_S,
    rig: RigOption = None,
    features_dir: FeaturesDir = None,
    pixel_origin: Origin = PixelOrigin.CORNER,
    restart: Annotated[
        bool, typer.Option("--restart", help="Remove the results in the folder and begin again.")
    ] = False,
    api_key_file: ApiKeyFile = None,
    ca: Ca = None,
    timeout_s: TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Localize all photos of a dataset or list, or their features for a map of ready-made ones.

    Writes results.jsonl, one answer per line, and at the end poses.txt with lines
    'name qw qx qy qz tx ty tz' (cam_from_world) of the localized photos, where a blank in a name
    is %20. The same command takes up a stopped run where it was. A photo that cannot be answered
    is recorded and passed over; where that was the server's fault, the same command asks again.

    All modes but single fill photos without a pose of their own: their status is filled, source
    says from what, and their poses are in poses_filled.txt. poses.txt has measured poses only.

    Exits with 0 when every photo has its line, 1 on an error, 130 when stopped.
    """
    options = options_of(option, seed)
    queries = read_queries(source, pixel_origin)
    key = api_key_of(api_key_file)
    with Client(server, api_key=key, ca=ca, timeout_s=timeout_s) as client:
        info = client.map(map_ref)
    arrangement = arrange(queries, [mode], info, rig_id=rig, time_unit=time_unit, max_gap_s=max_gap)
    read = choose_reader(source, info, features_dir, pixel_origin)
    arranged = _arranged(mode, arrangement, rig)
    batch = Batch(output, source, features_dir, pixel_origin, info.ref, options, mode, arranged)
    done = open_batch(batch, restart=restart)
    photos = queries.photos
    waiting = [query for query in photos if query.name not in done]
    # An instant is asked about again as a whole.
    instants = [i for i in arrangement.asked if not all(q.name in done for q in i.photos)]
    if len(waiting) < len(photos):
        _err.print(f"{len(photos) - len(waiting)} of {len(photos)} are done already")
    failed: list[Outcome] = []

    async def run(advance: Callable[[], None]) -> None:
        def count(outcome: Outcome) -> None:
            if outcome.error is not None:
                failed.append(outcome)

        def count_photo(outcome: Outcome) -> None:
            advance()
            count(outcome)

        def count_instant(outcome: InstantOutcome) -> None:
            advance()
            for photo in outcome.photos:
                count(photo)

        async with AsyncClient(server, api_key=key, ca=ca, timeout_s=timeout_s) as client:
            if mode is Mode.GP3P:
                await run_instants(batch, client, instants, concurrency, count_instant, read)
            else:
                await run_batch(batch, client, waiting, concurrency, count_photo, read)

    if mode is Mode.GP3P:
        what, total = "instants", len(instants)
    else:
        what, total = "photos", len(waiting)
    run_with_progress(_err, run, what, total, "the same command takes the run up where it was")
    counts = finish_batch(batch, arrangement)
    print_failed(_err, failed)
    print_batch(_out, counts, len(photos), mode is not Mode.SINGLE)


@app.command()
def benchmark(
    source: Source,
    map_ref: MapRef,
    report: Annotated[Path, typer.Option(metavar="FILE.json", help="Where the figures go.")],
    server: Server = DEFAULT_SERVER,
    option: Options = None,
    seed: Seed = None,
    concurrency: Concurrency = 1,
    mode: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MODE[,MODE...]",
            help=f"Columns of the table; can be repeated; all for all. {_MODES}",
        ),
    ] = None,
    time_unit: TimeUnitOption = None,
    max_gap: MaxGap = DEFAULT_MAX_GAP_S,
    rig: RigOption = None,
    features_dir: FeaturesDir = None,
    pixel_origin: Origin = PixelOrigin.CORNER,
    threshold: Thresholds = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the measured poses of the first mode, as localize batch does in "
            "poses.txt; filled ones are in no file.",
        ),
    ] = None,
    api_key_file: ApiKeyFile = None,
    ca: Ca = None,
    timeout_s: TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Measure how fast and, where the dataset has true poses, how well photos are localized.

    Recall counts all photos with a true pose; those without one of their own or a filled one are
    failures. The errors are those of the photos that have a pose. Latencies are what this client
    sees. Photos are asked about once, whatever the number of modes, and once more for gp3p.

    Exits with 0 when done, 1 on an error, 130 when stopped; then there is no report.
    """
    options = options_of(option, seed)
    modes = parse_modes(mode or ())
    thresholds = thresholds_of(threshold)
    check_can_be_written([report] if poses is None else [report, poses])
    queries = read_queries(source, pixel_origin)
    key = api_key_of(api_key_file)
    with Client(server, api_key=key, ca=ca, timeout_s=timeout_s) as client:
        info, about = client.map(map_ref), client.server_info()
    arrangement = arrange(queries, modes, info, rig_id=rig, time_unit=time_unit, max_gap_s=max_gap)
    read = choose_reader(source, info, features_dir, pixel_origin)
    connect = partial(AsyncClient, server, api_key=key, ca=ca, timeout_s=timeout_s)
    ask = Asking(connect, info.ref, options, concurrency, read, _err)
    of_photos = ask.photos(arrangement) if set(modes) != {Mode.GP3P} else None
    of_instants = ask.instants(arrangement) if Mode.GP3P in modes else None
    runs = {m: of_instants if m is Mode.GP3P else of_photos for m in modes}
    figures_of = {m: run for m, run in runs.items() if run is not None}
    poses_of = {m: arrangement.fill(m, known_poses(run)) for m, run in figures_of.items()}
    figures = make_report(figures_of, poses_of, thresholds, about, info)
    write_whole(report, [json.dumps(figures, indent=2, allow_nan=False).encode() + b"\n"])
    if poses is not None:
        write_poses(poses, _measured_poses(figures_of[modes[0]]))
    asked = [run for run in (of_photos, of_instants) if run is not None]
    # A photo that fails on its own mostly fails in its rig as well: told once.
    outcomes = (outcome for run in asked for outcome in run.outcomes)
    failed = {o.query.name: o for o in outcomes if o.error is not None}
    num_with_truth = sum(query.truth is not None for query in queries.photos)
    print_report(_out, figures, num_with_truth, len(failed), unit_of(info))
    print_failed(_err, list(failed.values()))


def _measured_poses(run: Run) -> Iterator[tuple[str, PoseEstimate]]:
    for outcome in run.outcomes:
        if outcome.result is not None and outcome.result.pose is not None:
            yield outcome.query.name, outcome.result.pose


def _arranged(mode: Mode, arrangement: Arrangement, rig_id: str | None) -> dict[str, object]:
    if mode is Mode.GP3P:
        return {"rig": rig_id}
    if mode.fills_sequences:
        return {"time_unit": arrangement.time_unit, "max_gap_s": arrangement.max_gap_s}
    return {}


def _unit(client: Client, map_ref: str) -> str:
    try:
        return unit_of(client.map(map_ref))
    except VislocError as error:  # the pose is here already, and worth more than its unit
        print_line(_err, "unit unknown", f"[{error.code}] {error}", "yellow")
        return UNKNOWN_UNIT


def _fail(code: str, message: str) -> NoReturn:
    print_line(_err, f"error [{code}]", message, "red")
    sys.exit(EXIT_ERROR)
