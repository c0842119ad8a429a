"""``localize evaluate`` and ``localize submit``."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from clients.cli.display import print_line
from clients.cli.options import Thresholds, thresholds_of
from clients.evaluation.results import check_can_be_written, write_poses, write_whole
from visloc.errors import refuse
from visloc_extensions.research.cli.compare_display import clean
from visloc_extensions.research.evaluation.pose_files import read_poses
from visloc_extensions.research.evaluation.scoring import read_conditions, read_scene, score
from visloc_extensions.research.evaluation.submission import Benchmark, make_submission

_out = Console()


def evaluate(
    poses: Annotated[
        list[Path],
        typer.Argument(
            metavar="POSES...",
            help="A file with lines 'name qw qx qy qz tx ty tz' (cam_from_world), a kapture "
            "folder, or what localize batch wrote (its folder, or results.jsonl, which has "
            "covariances). Several are the scenes of a data set.",
        ),
    ],
    *,
    truth: Annotated[
        list[Path],
        typer.Option(
            metavar="DATASET",
            help="The true poses, in any of these formats; one for each POSES, in their order.",
        ),
    ],
    threshold: Thresholds = None,
    condition: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=PATTERN",
            help="A row of its own for the photos whose names match, such as 'night=*/night/*'; "
            "can be repeated.",
        ),
    ] = None,
    conditions: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Conditions of photos, a line 'name condition' each."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write all figures as JSON.")
    ] = None,
) -> None:
    """Score poses that exist already, of this or any other tool, against true ones.

    Recall counts all photos with a true pose; a photo without a pose is a failure. The medians are
    over the photos that have a pose, and over all photos. A name that is not a photo's stands for
    the photo whose path ends with it. The last row is the plain mean of the rows above it: of the
    conditions, or else of the scenes. Needs no server.

    Exits with 0 when done, 1 on an error.
    """
    thresholds = thresholds_of(threshold)
    if len(poses) != len(truth):
        raise refuse(
            "evaluation.scenes",
            field="truth",
            expected=f"{len(poses)}, one for each POSES",
            got=len(truth),
        )
    check_can_be_written([] if report is None else [report])
    split = read_conditions(condition or (), conditions)
    scenes = [read_scene(*pair) for pair in zip(poses, truth, strict=True)]
    figures = score(scenes, split, thresholds)
    if report is not None:
        write_whole(report, [json.dumps(figures, indent=2, allow_nan=False).encode() + b"\n"])
    _out.print(_table(figures))
    for scene in figures["scenes"]:
        if scene["unknown"]:
            text = f"{scene['unknown']} poses of photos without a true pose ({scene['scene']})"
            print_line(_out, "not counted", text, "yellow")


def submit(
    results: Annotated[
        Path,
        typer.Argument(metavar="RESULTS", help="The folder of localize batch, or results.jsonl."),
    ],
    *,
    benchmark: Annotated[
        Benchmark, typer.Option("--set", help="The data set, whose names are written.")
    ],
    output: Annotated[Path, typer.Option(metavar="FILE", help="The file to upload.")],
    mapping: Annotated[
        Path | None,
        typer.Option(
            metavar="DATASET",
            help="The mapping photos and their poses, in any format of localize evaluate. A photo "
            "without a pose then gets that of the first photo that was retrieved for it.",
        ),
    ] = None,
) -> None:
    """Write the poses of a batch as visuallocalization.net takes them.

    Names are file names; for robotcar with the camera's folder, such as rear/1.jpg. Tells how many
    poses were filled, and how many photos have none. Needs no server.

    Exits with 0 when done, 1 on an error.
    """
    check_can_be_written([output])
    made = make_submission(results, benchmark, {} if mapping is None else read_poses(mapping))
    write_poses(output, made.poses.items())
    counts = made.counts
    _out.print(
        f"{counts.total()} photos: {counts['localized']} localized, {counts['filled']} filled "
        f"from other photos, {counts['retrieved']} filled from the first retrieved photo, "
        f"{counts['missing']} without a pose",
        highlight=False,
        soft_wrap=True,
    )


def _table(figures: Mapping[str, Any]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("", overflow="fold", min_width=12)
    average = figures["average"]
    bins = [
        f"{each['max_position_error_m']:g} m\n{each['max_orientation_error_deg']:g}°"
        for each in average["recall"]
    ]
    # The median over all photos is another one only where photos have no pose.
    titles = ["median", "of all"] if _lacks_poses(figures) else ["median"]
    for title in ("with\npose", *bins, *titles, "inside\n95 %"):
        table.add_column(title, justify="right", no_wrap=True)
    for label, row in _rows(figures):
        held = row["calibration"]
        table.add_row(
            escape(clean(label)),
            f"{row['with_pose']} of {row['photos']}",
            *_shares(row),
            *_medians(row)[: len(titles)],
            "-" if held is None else f"{held['inside_95']:.1%}",
        )
    if average["rows"] > 1:
        table.add_section()
        table.add_row("average", "", *_shares(average), *_medians(average)[: len(titles)], "")
    return table


def _lacks_poses(figures: Mapping[str, Any]) -> bool:
    return any(scene["with_pose"] < scene["photos"] for scene in figures["scenes"])


def _rows(figures: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for scene in figures["scenes"]:
        yield "/".join(Path(scene["scene"]).parts[-2:]), scene
        for name, part in scene["conditions"].items():
            yield f"  {name}", part


def _shares(row: Mapping[str, Any]) -> list[str]:
    return [f"{each['fraction']:.1%}" for each in row["recall"]]


def _medians(row: Mapping[str, Any]) -> list[str]:
    def text(position: float | None, orientation: float | None) -> str:
        if position is None or orientation is None:
            return "-"
        return f"{position:.4f} m\n{orientation:.4f}°"

    return [
        text(row["median_position_error_m"], row["median_orientation_error_deg"]),
        text(row["median_position_error_of_all_m"], row["median_orientation_error_of_all_deg"]),
    ]
