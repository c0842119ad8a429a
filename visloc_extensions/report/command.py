"""The command ``mapping report``."""

from __future__ import annotations

import base64
import json
import os
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePath
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from mapping.cli.display import ERR, OUT, say
from mapping.cli.progress import StageProgress
from mapping.cluster.storage import is_map_folder, map_folder
from mapping.cluster.workers import DEFAULT_WORKERS, Workers
from mapping.methods.retrieval_only import refuse_without_landmarks
from mapping.options import MapArgument, MapsDirOption
from mapping.progress import Progress
from mapping.stages.work_folder import WorkFolder, exclusive
from service.page import report_parts
from visloc.archive import Map, open_map
from visloc.drawing.detail_levels import detail_order
from visloc.drawing.point_bytes import packed_points
from visloc.errors import Conflict, VislocError, refuse
from visloc_extensions.report import make_report_data
from visloc_extensions.report.data import UP_IS_A_GUESS, decimals_of
from visloc_extensions.report.html import report_page

# Landmarks that the file carries: 3.2 MB, and as many as a picture of a screen can tell apart.
MAX_POINTS = 150_000
# More names than anyone reads in a terminal; the file has them all.
_SHOWN_NAMES = 20
_NOT_TESTABLE = "not testable: all photos share one place"


def report(
    map_ref: MapArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            help="HTML file to write; an existing file is replaced. Default: ID-report.html here.",
        ),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
    workers: Annotated[
        int,
        typer.Option(
            min=1,
            max=256,
            help="Worker processes that localize. Their number does not change the report.",
        ),
    ] = DEFAULT_WORKERS,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """Report where a map is weak: from which places and directions would a photo be localized?

    Writes one HTML file that needs neither network nor server, and prints the main points. Each
    photo of the map is localized in the rest of the map, from stored features; the photo files are
    not needed.
    """
    opened = open_map(map_folder(map_ref, maps_dir))
    target = Path(f"{opened.manifest.id}-report.html") if output is None else output
    # Beside the report if the map is not in a folder of maps.
    work_dir = target.parent if is_map_folder(map_ref) else maps_dir
    with StageProgress(ERR) as progress:
        data = write_report(
            opened, target, work_dir, workers=workers, command=_typed(), progress=progress
        )
    summary = summary_of_report(data) | {"output": str(target)}
    if as_json:
        sys.stdout.write(json.dumps(summary, indent=2) + "\n")
    else:
        decimals = decimals_of(data["coverage"]["cell"] / 10)
        _print_summary(summary, metric=opened.manifest.world.metric, decimals=decimals)


def write_report(
    opened: Map, target: Path, work_dir: Path, *, workers: int, command: str, progress: Progress
) -> dict[str, Any]:
    """Write the report of a map, whole or not at all.

    Finished runs are kept in ``work_dir`` until the report is written.

    Returns:
        The contents of the report: ``ReportData`` of ``web/src/report/data.ts``.
    """
    refuse_without_landmarks(opened)
    # Errors that would come at the end are provoked before the long work.
    script, style = report_parts()
    unfinished = _begun(target)
    root = work_dir / ".report" / opened.manifest.id
    try:
        with _work_folder(root) as work:
            with Workers(workers) as pool:
                data = make_report_data(
                    opened, work, command=command, workers=pool, progress=progress
                )
            points = packed_points(opened, detail_order(opened.landmarks), 0, MAX_POINTS)
            data["points"] = base64.b64encode(points).decode("ascii")
            unfinished.write_text(report_page(data, script, style), "utf-8")
            unfinished.replace(target)
            shutil.rmtree(root, ignore_errors=True)
    finally:
        unfinished.unlink(missing_ok=True)
    return data


@contextmanager
def _work_folder(root: Path) -> Iterator[WorkFolder]:
    """Hold a folder for finished runs, against another report of the map."""
    with ExitStack() as held:
        try:
            held.enter_context(exclusive(root.with_name(f"{root.name}.lock")))
            root.mkdir(exist_ok=True)
        except Conflict as error:
            raise refuse("report.running", field=str(root)) from error
        except OSError as error:
            raise refuse("report.work", field=str(root.parent), got=error.strerror) from error
        yield WorkFolder(root)


def summary_of_report(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the main points of a report, for programs.

    A photo counts by the run that left out the fewest others. ``likely`` and ``unlikely`` are the
    shares of places and directions with a chance of at least 90 %, and of less than 10 %.
    ``cameras`` are descriptions. ``up`` is ``gravity``, or ``cameras`` if it was guessed from how
    they were held.
    """
    within = data["coverage"]["within"]
    kindest: dict[int, Mapping[str, Any]] = {}
    for run in data["held_out"]:
        known = kindest.get(run["image"])
        if known is None or run["left_out"] < known["left_out"]:
            kindest[run["image"]] = run
    failed = [
        data["images"][image]["name"]
        for image, run in kindest.items()
        if not run["localized"]
        or run["position_error"] > within["position"]
        or run["orientation_error_deg"] > within["orientation_deg"]
    ]
    chances = [chance for cell in data["coverage"]["cells"] for chance in cell["probability"]]
    return {
        "map": f"{data['map']['id']}@{data['map']['version']}",
        "cameras": data["map"]["cameras"],
        "up": data["up"]["source"],
        "within": within,
        "held_out": len(kindest),
        "failed": failed,
        "likely": sum(chance >= 0.9 for chance in chances) / len(chances) if chances else None,
        "unlikely": sum(chance < 0.1 for chance in chances) / len(chances) if chances else None,
        "weak_spots": data["coverage"]["weak_spots"],
        "look_alikes": data["look_alikes"],
        "look_alikes_asked": data["look_alikes_asked"],
    }


def _begun(target: Path) -> Path:
    """Make an empty file that will replace the target."""
    unfinished = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        if target.is_dir():
            raise _no_output(target, "the path is a folder", "there is a folder of this name")
        target.parent.mkdir(parents=True, exist_ok=True)
        unfinished.touch()
    except OSError as error:
        raise _no_output(
            target, "the report cannot be written there", str(error.strerror)
        ) from error
    return unfinished


def _no_output(target: Path, message: str, why: str) -> VislocError:
    return refuse(
        "report.output",
        message,
        field="--output",
        expected="a file in a folder that can be written, such as room.html",
        got=f"{target}: {why}",
    )


def _typed() -> str:
    """Return the command as typed, for the reader: only the last parts of paths."""
    options = ("--output=", "--maps-dir=")
    words = []
    for word in sys.argv[1:]:
        option = next((option for option in options if word.startswith(option)), "")
        value = word.removeprefix(option)
        words.append(option + (PurePath(value).name or value))
    return shlex.join(["mapping", *words])


def _print_summary(summary: Mapping[str, Any], *, metric: bool, decimals: int) -> None:
    for line in summary["cameras"]:
        say(f"cameras: {line}")
    within, unit = summary["within"], " m" if metric else " units"
    limits = f"within {within['position']:g}{unit} and {within['orientation_deg']:g} degrees"
    failed = summary["failed"]
    if summary["held_out"]:
        localized = summary["held_out"] - len(failed)
        say(f"photos localized without themselves, {limits}: {localized} of {summary['held_out']}")
    for name in failed[:_SHOWN_NAMES]:
        say(f"not localized: {name}")
    if len(failed) > _SHOWN_NAMES:
        say(f"and {len(failed) - _SHOWN_NAMES} more")
    if summary["likely"] is not None:
        say(
            "places and directions where a photo has a chance of 90 % or more: "
            f"{100 * summary['likely']:.0f} %; of less than 10 %: {100 * summary['unlikely']:.0f} %"
        )
    if summary["weak_spots"]:
        table = Table(box=None, title="where to take more photos", title_justify="left")
        for name in ("place", "looking", "chance", "why"):
            table.add_column(name)
        for spot in summary["weak_spots"]:
            table.add_row(
                ", ".join(f"{value:.{decimals}f}" for value in spot["position"]),
                _clock(spot["direction_deg"]),
                f"{100 * spot['probability']:.0f} %",
                escape(spot["why"]),
            )
        OUT.print(table, highlight=False)
        say("looking: as a clock on the plan of the report, where 12 is up")
    for pair in summary["look_alikes"]:
        say(f"look-alikes: {pair['told']}")
    if not summary["look_alikes"]:
        asked = summary["look_alikes_asked"]
        say(f"look-alikes: {f'none, of {asked} photos asked' if asked else _NOT_TESTABLE}")
    if summary["up"] != "gravity":
        say(f"note: {UP_IS_A_GUESS}")
    say(f"report: {summary['output']}")


def _clock(heading_deg: float) -> str:
    """Return the hour of a direction; 0 degrees is to the right."""
    return f"{round((90 - heading_deg) % 360 / 30) % 12 or 12} o'clock"
