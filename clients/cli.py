"""The ``localize`` command."""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from clients.batch import Batch, finish_batch, open_batch, run_batch
from clients.benchmark import make_report, parse_threshold
from clients.client import DEFAULT_TIMEOUT_S, AsyncClient, Client
from clients.display import (
    UNKNOWN_UNIT,
    print_failed,
    print_line,
    print_report,
    print_result,
    unit_of,
)
from clients.queries import read_queries
from clients.results import check_can_be_written, write_poses, write_whole
from clients.running import Outcome, localize_all
from clients.sending import choose_reader
from clients.types import LocalizeOptions
from visloc.errors import VislocError
from visloc.evaluation import DEFAULT_THRESHOLDS
from visloc.geometry import Camera, PixelOrigin

EXIT_ERROR = 1  # 2 is wrong usage, by convention
EXIT_NOT_LOCALIZED = 3
EXIT_STOPPED = 130

app = typer.Typer(
    name="localize",
    help="Ask a localization service where photos were taken.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
_out = Console()
_err = Console(stderr=True)

MapRef = Annotated[str, typer.Option("--map", metavar="ID", help="id, or id@version.")]
Server = Annotated[
    str,
    typer.Option("--server", metavar="URL", help="http://host:port or grpc://host:port."),
]
Options = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="preset, top_k, max_error_px, min_inliers, min_inlier_ratio, read_as or seed; "
        "can be repeated.",
    ),
]
Seed = Annotated[int | None, typer.Option("--seed", min=0, help="The same as --option seed=...")]
TimeoutS = Annotated[
    float, typer.Option("--timeout", min=0.001, help="Longest wait for an answer, seconds.")
]
Concurrency = Annotated[
    int, typer.Option("--concurrency", min=1, max=1024, help="Photos asked about at once.")
]
Source = Annotated[
    Path,
    typer.Argument(
        metavar="DATASET_OR_LIST",
        help="A kapture folder, or a text file with lines 'image_name' or "
        "'image_name MODEL width height params...', names relative to its folder.",
    ),
]
FeaturesDir = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="For a map of ready-made features (kapture:TYPE): the features of the photos, where "
        "they are not in the dataset.",
    ),
]
Origin = Annotated[
    PixelOrigin,
    typer.Option(
        "--pixel-origin",
        help="What the dataset's principal points and ready-made keypoints call the centre of the "
        "top-left pixel: corner, (0.5, 0.5), or center, (0, 0).",
    ),
]
DEFAULT_SERVER = "http://127.0.0.1:8000"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and exit; errors are one line, not a traceback."""
    try:
        app(arguments)
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
            "uses the focal length in EXIF, or guesses.",
        ),
    ] = None,
    server: Server = DEFAULT_SERVER,
    as_json: Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")] = False,
    option: Options = None,
    seed: Seed = None,
    timeout_s: TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Localize one photo.

    Exits with 0 when localized, 3 when not localized, 1 on an error, 2 on wrong usage.
    """
    options = _options(option, seed)
    intrinsics = None if camera is None else Camera.from_text(camera)
    with Client(server, timeout_s=timeout_s) as client:
        result = client.localize(photo, map_ref, intrinsics, options)
        if as_json:
            typer.echo(json.dumps(result.raw, indent=2))
        else:
            print_result(_out, result, _unit(client, f"{result.map.id}@{result.map.version}"))
    if not result.localized:
        raise typer.Exit(EXIT_NOT_LOCALIZED)


@app.command("batch")
def localize_batch(
    source: Source,
    map_ref: MapRef,
    output: Annotated[Path, typer.Option(help="Folder for poses.txt and results.jsonl.")],
    server: Server = DEFAULT_SERVER,
    option: Options = None,
    seed: Seed = None,
    concurrency: Concurrency = 1,
    features_dir: FeaturesDir = None,
    pixel_origin: Origin = PixelOrigin.CORNER,
    restart: Annotated[
        bool, typer.Option("--restart", help="Remove the results in the folder and begin again.")
    ] = False,
    timeout_s: TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Localize all photos of a dataset or list, or their features for a map of ready-made ones.

    Writes results.jsonl, one answer per line, and at the end poses.txt with lines
    'name qw qx qy qz tx ty tz' (cam_from_world) of the localized photos. The same command takes
    up a stopped run where it was. A photo that cannot be answered is recorded and passed over;
    where that was the server's fault, the same command asks again.

    Exits with 0 when every photo has its line, 1 on an error, 130 when stopped.
    """
    options = _options(option, seed)
    queries = read_queries(source, pixel_origin)
    with Client(server, timeout_s=timeout_s) as client:
        info = client.map(map_ref)
    read = choose_reader(source, info, features_dir, pixel_origin)
    batch = Batch(output, source, features_dir, pixel_origin, info.ref, options)
    done = open_batch(batch, restart=restart)
    waiting = [query for query in queries if query.name not in done]
    if len(waiting) < len(queries):
        _err.print(f"{len(queries) - len(waiting)} of {len(queries)} are done already")
    failed: list[Outcome] = []

    async def run(advance: Callable[[], None]) -> None:
        def count(outcome: Outcome) -> None:
            advance()
            if outcome.error is not None:
                failed.append(outcome)

        async with AsyncClient(server, timeout_s=timeout_s) as client:
            await run_batch(batch, client, waiting, concurrency, count, read)

    _run(run, len(waiting), "the same command takes the run up where it was")
    counts = finish_batch(batch, queries)
    print_failed(_err, failed)
    _out.print(
        f"{counts['localized']} of {len(queries)} localized, "
        f"{counts['not_localized']} not localized, {counts['error']} without an answer",
        highlight=False,
    )


@app.command()
def benchmark(
    source: Source,
    map_ref: MapRef,
    report: Annotated[Path, typer.Option(metavar="FILE.json", help="Where the figures go.")],
    server: Server = DEFAULT_SERVER,
    option: Options = None,
    seed: Seed = None,
    concurrency: Concurrency = 1,
    features_dir: FeaturesDir = None,
    pixel_origin: Origin = PixelOrigin.CORNER,
    threshold: Annotated[
        list[str] | None,
        typer.Option(
            metavar="METRES/DEGREES",
            help="A row of the accuracy table; can be repeated. Without it: "
            "0.05/5, 0.25/2, 0.5/5, 5/10.",
        ),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write poses as localize batch does.")
    ] = None,
    timeout_s: TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Measure how fast and, where the dataset has true poses, how well photos are localized.

    Recall counts all photos with a true pose; those not localized are failures. The median
    errors are over the localized photos only. Latencies are what this client sees.

    Exits with 0 when done, 1 on an error, 130 when stopped; then there is no report.
    """
    options = _options(option, seed)
    thresholds = [parse_threshold(text) for text in threshold or ()] or DEFAULT_THRESHOLDS
    check_can_be_written([report] if poses is None else [report, poses])
    queries = read_queries(source, pixel_origin)
    with Client(server, timeout_s=timeout_s) as client:
        info, about = client.map(map_ref), client.server_info()
    read = choose_reader(source, info, features_dir, pixel_origin)
    outcomes: dict[str, Outcome] = {}
    seconds = 0.0

    async def run(advance: Callable[[], None]) -> None:
        def keep(outcome: Outcome) -> None:
            outcomes[outcome.query.name] = outcome
            advance()

        nonlocal seconds
        async with AsyncClient(server, timeout_s=timeout_s) as client:
            started = time.perf_counter()
            await localize_all(client, queries, info.ref, options, concurrency, keep, read)
            seconds = time.perf_counter() - started

    _run(run, len(queries), "no report was written")
    ordered = [outcomes[query.name] for query in queries]
    figures = make_report(ordered, seconds, thresholds, about, info)
    write_whole(report, [json.dumps(figures, indent=2, allow_nan=False).encode() + b"\n"])
    if poses is not None:
        results = [outcome.result for outcome in ordered]
        named = zip((query.name for query in queries), results, strict=True)
        write_poses(poses, ((name, r.pose) for name, r in named if r is not None and r.pose))
    failed = [outcome for outcome in ordered if outcome.error is not None]
    num_with_truth = sum(query.truth is not None for query in queries)
    print_report(_out, figures, num_with_truth, len(failed), unit_of(info))
    print_failed(_err, failed)


def _unit(client: Client, map_ref: str) -> str:
    try:
        return unit_of(client.map(map_ref))
    except VislocError as error:  # the pose is here already, and worth more than its unit
        print_line(_err, "unit unknown", f"[{error.code}] {error}", "yellow")
        return UNKNOWN_UNIT


def _options(texts: Sequence[str] | None, seed: int | None) -> LocalizeOptions:
    return LocalizeOptions.from_texts([*(texts or ()), *([] if seed is None else [f"seed={seed}"])])


def _run(
    work: Callable[[Callable[[], None]], Coroutine[Any, Any, None]], total: int, if_stopped: str
) -> None:
    """Run ``work``, which calls what it is given after each photo, under a progress bar."""
    columns = (
        TextColumn("photos"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=_err) as progress:
        task = progress.add_task("photos", total=total)
        try:
            asyncio.run(work(lambda: progress.advance(task)))
        except KeyboardInterrupt:
            progress.stop()
            _err.print(f"stopped; {if_stopped}", highlight=False)
            raise typer.Exit(EXIT_STOPPED) from None
        except VislocError:
            progress.stop()
            _err.print(f"cannot go on; {if_stopped}", highlight=False)
            raise


def _fail(code: str, message: str) -> NoReturn:
    print_line(_err, f"error [{code}]", message, "red")
    sys.exit(EXIT_ERROR)
