"""The command ``mapping report``."""

from __future__ import annotations

import base64
import json
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mapping.options import MapArgument, MapsDirOption
from mapping.progress import StageProgress
from mapping.report import make_report_data
from mapping.report.html import report_page
from mapping.stages import WorkFolder, exclusive
from mapping.workers import DEFAULT_WORKERS, Workers
from visloc.archive import Map, MapStore, open_map
from visloc.archive.detail import detail_order, packed_points
from visloc.errors import Conflict
from visloc_web import report_parts

# Landmarks that the file carries: 3.2 MB, and as many as a picture of a screen can tell apart.
MAX_POINTS = 150_000
# More names than anyone reads in a terminal; the file has them all.
_SHOWN_NAMES = 20

_out = Console()
_err = Console(stderr=True)


def report(
    map_ref: MapArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            help="The HTML file to write, over one that is there; left out: ID-report.html here.",
        ),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
    workers: Annotated[
        int,
        typer.Option(
            min=1, max=256, help="Processes that localize; they do not change the report."
        ),
    ] = DEFAULT_WORKERS,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """Tell where a map is weak: where, and looking which way, would a photo be localized?

    Writes one HTML file that needs neither network nor server, and says the main points here.
    Photos of the map are localized without themselves; no photo is needed for that.
    """
    path = Path(map_ref)
    given_as_folder = (path / "manifest.json").is_file()
    opened = open_map(path if given_as_folder else MapStore(maps_dir).folder(map_ref))
    target = Path(f"{opened.manifest.id}-report.html") if output is None else output
    command = ["mapping", "report", map_ref]
    if maps_dir != Path("maps") and not given_as_folder:
        command += ["--maps-dir", str(maps_dir)]
    with StageProgress(_err) as progress:
        data = write_report(
            opened, target, maps_dir, workers=workers, command=command, progress=progress
        )
    summary = summary_of_report(data) | {"output": str(target)}
    if as_json:
        sys.stdout.write(json.dumps(summary, indent=2) + "\n")
    else:
        _print_summary(summary, metric=opened.manifest.world.metric)


def write_report(
    opened: Map,
    target: Path,
    maps_dir: Path,
    *,
    workers: int,
    command: list[str],
    progress: Callable[[str, int, int], None],
) -> dict[str, Any]:
    """Write the report of a map, whole or not at all, and return what it shows.

    Finished runs are kept in ``maps_dir`` until the report is written.

    Args:
        opened: the map.
        target: the HTML file; one that exists is replaced.
        maps_dir: where work in progress is kept.
        workers: processes that localize.
        command: how to make it again, for the reader.
        progress: told the stage, how much is done, and how much there is.

    Returns:
        A ``ReportData`` as ``web/src/report/data.ts`` has it.

    Raises:
        Conflict: ``report.output`` if a folder is there, ``report.running``.
        Unavailable: ``page.not_built``.
    """
    if target.is_dir():
        raise Conflict(
            "report.output",
            "this is a folder",
            field="--output",
            expected="a file, such as room.html",
            got=target,
        )
    script, style = report_parts()  # raises before the long work
    root = maps_dir / ".report" / opened.manifest.id
    with ExitStack() as held:
        try:
            held.enter_context(exclusive(root.with_name(f"{root.name}.lock")))
        except Conflict as error:
            raise Conflict(
                "report.running", "another report of this map is being made", field=str(root)
            ) from error
        with Workers(workers) as pool:
            data = make_report_data(
                opened,
                WorkFolder(root),
                command=shlex.join(command),
                workers=pool,
                progress=progress,
            )
        order = detail_order(opened.landmarks)
        points = packed_points(opened, order, 0, MAX_POINTS)
        data["points"] = base64.b64encode(points).decode("ascii")
        _replace(target, report_page(data, script, style))
        shutil.rmtree(root, ignore_errors=True)
    return data


def summary_of_report(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the main points of a report, for programs.

    Each photo counts by the run that left out the fewest others. ``likely`` and ``unlikely`` are
    the shares of places and directions with a chance of 90 % and more, and of less than 10 %.
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
        "within": within,
        "held_out": len(kindest),
        "failed": failed,
        "likely": sum(chance >= 0.9 for chance in chances) / len(chances) if chances else None,
        "unlikely": sum(chance < 0.1 for chance in chances) / len(chances) if chances else None,
        "weak_spots": data["coverage"]["weak_spots"],
    }


def _replace(target: Path, page: str) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        unfinished.write_text(page, "utf-8")
        unfinished.replace(target)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def _print_summary(summary: Mapping[str, Any], *, metric: bool) -> None:
    def say(text: str) -> None:
        _out.print(text, markup=False, highlight=False, soft_wrap=True)

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
            f"{summary['likely']:.0%}; of less than 10 %: {summary['unlikely']:.0%}"
        )
    if summary["weak_spots"]:
        table = Table(box=None, title="where to take more photos", title_justify="left")
        for name in ("place", "looking", "chance", "why"):
            table.add_column(name)
        for spot in summary["weak_spots"]:
            table.add_row(
                ", ".join(f"{value:.2f}" for value in spot["position"]),
                _clock(spot["direction_deg"]),
                f"{spot['probability']:.0%}",
                escape(spot["why"]),
            )
        _out.print(table, highlight=False)
        say("looking: as a clock on the plan of the report, where 12 is up")
    say(f"report: {summary['output']}")


def _clock(heading_deg: float) -> str:
    """Hour of a direction, 0 degrees being to the right."""
    return f"{round((90 - heading_deg) % 360 / 30) % 12 or 12} o'clock"
