"""The command ``mapping capture``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from mapping.cli.acceptance import require_acceptance
from mapping.cli.display import (
    ERR,
    OUT,
    print_costs,
    print_map,
    print_pieces,
    say,
    say_notes,
    say_peak_memory,
)
from mapping.cli.progress import StageProgress
from mapping.cluster.stage_timings import Costs
from visloc.archive import Map, MapStore, open_map
from visloc_extensions.capture.account import fates, film_again, verdict
from visloc_extensions.capture.job import Captured, Outlook, capture_map
from visloc_extensions.capture.picture import draw_walk
from visloc_extensions.capture.settings import CaptureSettings
from visloc_extensions.capture.trying import Trials, out_of_order, try_photos


def capture(
    settings: CaptureSettings,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            dir_okay=False,
            help="PNG of the walk from above; an existing file is replaced. Default: "
            "ID-capture.png here.",
        ),
    ] = None,
) -> None:
    """Make a map of videos, photos or scans of one place.

    Tells beforehand how long it takes. Tells afterwards what became of each second and photo, how
    good the map is, and what to film again. A map that its own test speaks against is not put into
    use, nor one of unknown size in place of one in metres. Killed, the same command resumes.
    """
    costs = Costs()
    with StageProgress(ERR) as progress:
        captured = capture_map(settings, progress, _announce, costs)
        opened = open_map(captured.folder)
        trials = try_photos(opened, partial(progress, "trying the map"))
    picture = Path(f"{settings.map_id}-capture.png") if output is None else output
    picture.parent.mkdir(parents=True, exist_ok=True)
    draw_walk(opened, trials, picture)
    store = MapStore(settings.maps_dir)
    pieces = [store.open(ref) for ref in opened.manifest.pieces]
    print_map(opened)
    print_pieces(store, opened)
    print_costs(OUT, costs.table())
    say_peak_memory(costs.table()[-1].spent)
    say_notes(captured.notes)
    _print_account(captured, opened, trials, pieces)
    say(f"picture: {picture}")
    captured.forget()
    require_acceptance(
        opened, accept=settings.accept, pictures=settings.maps_dir / ".work" / ".doubts"
    )


def _announce(outlook: Outlook) -> None:
    minutes = max(1, round(outlook.minutes))
    say(
        f"{outlook.photos} photos to match: about {minutes} minute{'s' * (minutes > 1)}, "
        f"{_size(outlook.memory_bytes)} of memory, {_size(outlook.disk_bytes)} of disk for the "
        f"time being ({_size(outlook.free_bytes)} are free)"
    )
    if outlook.disk_bytes > outlook.free_bytes:
        say(
            "the disk will probably be full before the map is made: make room, or choose a folder "
            "on another disk (--maps-dir)"
        )


def _size(num_bytes: int) -> str:
    gib = num_bytes / 2**30
    return f"{gib:.1f} GiB" if gib >= 1 else f"{num_bytes / 2**20:.0f} MiB"


def _print_account(captured: Captured, opened: Map, trials: Trials, pieces: Sequence[Map]) -> None:
    astray = out_of_order(opened, captured.videos)
    stretches = fates(captured, opened, astray, pieces)
    table = Table(box=None)
    for name in ("source", "part", "what became of it"):
        table.add_column(name)
    for stretch in stretches:
        table.add_row(*(escape(text) for text in (stretch.source, stretch.what, stretch.fate)))
    OUT.print(table)
    say(verdict(trials, captured, opened))
    for line in film_again(trials, stretches, opened):
        say(f"film again: {line}")
