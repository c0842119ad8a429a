"""Answers and reports for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from clients.running import Outcome
from clients.types import LocalizeResult, MapInfo, PoseEstimate

_NUM_RETRIEVED_SHOWN = 3
_NUM_FAILED_SHOWN = 5
_CAMERA_SOURCES: Mapping[str, str] = {
    "given": "as given",
    "given_scaled": "as given, scaled to the size of the photo",
    "exif": "from the focal length in EXIF",
    "guess": "a guess: give --camera for a better pose",
}


# Lengths in a world that is not metric, or may not be.
UNKNOWN_UNIT = "units of the map"


def unit_of(map_info: MapInfo) -> str:
    """The unit of lengths in a map's world."""
    return "m" if map_info.metric else UNKNOWN_UNIT


def print_result(console: Console, result: LocalizeResult, unit: str) -> None:
    """Print one answer, a line for each thing that it says."""
    if result.pose is not None:
        print_line(console, "localized", f"in {result.map.id}@{result.map.version}", "bold green")
        _print_pose(console, result.pose, unit)
    elif result.refusal is not None:
        print_line(console, "not localized", result.refusal.message, "bold yellow")
        print_line(console, "gave up at", f"{result.refusal.stage} ({result.refusal.reason})")
        print_line(console, "map", f"{result.map.id}@{result.map.version}")
    print_line(
        console,
        "inliers",
        f"{result.inliers} of {result.correspondences} correspondences "
        f"({result.inlier_ratio:.0%}), from {result.keypoints} keypoints",
    )
    for rank, image in enumerate(result.retrieved[:_NUM_RETRIEVED_SHOWN]):
        similarities = ", ".join(f"{k} {v:.3f}" for k, v in image.similarities.items())
        label = f"retrieved {len(result.retrieved)}" if rank == 0 else ""
        print_line(console, label, f"{image.image}  {image.score:.3f}  ({similarities})")
    camera = result.camera.camera
    print_line(
        console,
        "camera",
        f"{camera.model} {camera.width} x {camera.height}  {_numbers(camera.params, 6)}  "
        f"({_CAMERA_SOURCES.get(result.camera.source, result.camera.source)})",
    )
    if result.orientation.exif != 1 or result.orientation.read_as != "stored":
        print_line(
            console,
            "orientation",
            f"EXIF {result.orientation.exif}, features found in the photo as "
            f"{result.orientation.read_as}",
        )
    print_line(
        console, "seconds", ", ".join(f"{k} {v:.3f}" for k, v in _longest_first(result.seconds))
    )
    print_line(console, "request", result.request_id)


def print_report(
    console: Console, report: Mapping[str, Any], num_with_truth: int, num_errors: int, unit: str
) -> None:
    """Print what the report of a benchmark says."""
    server = report["server"]
    features = ", ".join((server["features"]["local"], *server["features"]["global"]))
    console.print(
        f"[bold]{report['localized']} of {report['queries']} localized[/bold] "
        f"in {escape(server['map'])} ({escape(features)}), "
        f"server {escape(server['version'] or 'of unknown version')}",
        highlight=False,
        soft_wrap=True,
    )
    if num_errors:
        console.print(f"[red]{num_errors} without an answer[/red]", highlight=False)
    if report["recall"] is not None:
        console.print(_accuracy(report, num_with_truth, unit))
    else:
        console.print("no ground truth in the dataset: no accuracy", highlight=False)
    console.print(_speed(report))


def print_failed(console: Console, failed: Sequence[Outcome]) -> None:
    """Print the first few photos that have no answer, and why."""
    for outcome in failed[:_NUM_FAILED_SHOWN]:
        if outcome.error is not None:
            text = f"{outcome.query.name} [{outcome.error.code}] {outcome.error}"
            print_line(console, "no answer", text, "yellow")
    if len(failed) > _NUM_FAILED_SHOWN:
        print_line(console, "", f"and {len(failed) - _NUM_FAILED_SHOWN} more")


def print_line(console: Console, label: str, text: str, style: str = "bold") -> None:
    """Print a label and a text from anywhere on one line."""
    # What comes from files and servers could move the cursor or paint the terminal.
    clean = "".join(letter if letter.isprintable() else "?" for letter in text)
    line = Text.assemble((f"{label:<14} ", style), clean)
    console.print(line, highlight=False, soft_wrap=True)


def _print_pose(console: Console, pose: PoseEstimate, unit: str) -> None:
    print_line(
        console,
        "position",
        f"{_numbers(pose.position, 4)} {unit}, std {_numbers(pose.position_std, 4)}",
    )
    print_line(
        console,
        "orientation",
        f"{_numbers(pose.orientation, 6)} (w x y z, world_from_cam), "
        f"std {_numbers(pose.orientation_std_deg, 3)} degrees",
    )


def _accuracy(report: Mapping[str, Any], num_with_truth: int, unit: str) -> Table:
    table = Table(title=f"accuracy over {num_with_truth} with known pose", title_justify="left")
    table.add_column("within")
    table.add_column("localized", justify="right")
    for row in report["recall"]:
        table.add_row(
            f"{row['max_position_error_m']:g} {unit}, {row['max_orientation_error_deg']:g}°",
            f"{row['fraction']:.1%}  ({round(row['fraction'] * num_with_truth)})",
        )
    if report["median_position_error_m"] is not None:
        table.add_section()
        table.add_row(
            "median of the localized",
            f"{report['median_position_error_m']:.4f} {unit}, "
            f"{report['median_orientation_error_deg']:.3f}°",
        )
    return table


def _speed(report: Mapping[str, Any]) -> Table:
    table = Table(title="time, as the client sees it", title_justify="left")
    table.add_column("")
    table.add_column("seconds", justify="right")
    for name, seconds in report["latency_s"].items():
        table.add_row(f"latency {name}", "-" if seconds is None else f"{seconds:.3f}")
    table.add_section()
    for stage, seconds in _longest_first(report["stage_seconds"]):
        table.add_row(f"server, {escape(stage)} (mean)", f"{seconds:.4f}")
    if report["throughput_qps"] is not None:
        table.add_section()
        table.add_row("answers per second", f"{report['throughput_qps']:.2f}")
    return table


def _longest_first(seconds: Mapping[str, float]) -> list[tuple[str, float]]:
    # Over gRPC the stages come in no order.
    return sorted(seconds.items(), key=lambda stage: -stage[1])


def _numbers(values: Iterable[float], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}".rstrip("0").rstrip(".") for value in values)
