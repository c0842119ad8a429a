"""Answers and reports for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from clients.evaluation.run import Outcome
from clients.wire.answers import LocalizeResult
from visloc.types import Uncertainty
from visloc_api.words.answers import Candidate
from visloc_api.words.geopose import GeoPose
from visloc_api.words.maps import MapInfo
from visloc_api.words.poses import CoarsePose, PoseEstimate

_NUM_RETRIEVED_SHOWN = 3
_NUM_FAILED_SHOWN = 5
_CAMERA_SOURCES: Mapping[str, str] = {
    "given": "as given",
    "given_scaled": "as given, scaled to the size of the photo",
    "map": "that of the map's own photos",
    "exif": "from the focal length in EXIF",
    "estimated": "estimated with the pose: give --camera for a better one",
    "guess": "a guess: give --camera for a better pose",
}
# Sources of filled poses.
_FILLED: Mapping[str, str] = {
    "rig": "from another camera of the rig",
    "interpolated": "between two instants",
    "nearest": "from the nearest instant",
}
_PERCENTILES = ("p50", "p75", "p90", "max")


def unit_of(told: MapInfo | PoseEstimate | CoarsePose) -> str:
    """Return the unit of lengths in a map's world."""
    return "m" if told.metric else "units of the map"


def print_result(console: Console, result: LocalizeResult) -> None:
    """Print one answer, a line for each fact."""
    if result.pose is not None:
        print_line(console, "localized", f"in {result.map.id}@{result.map.version}", "bold green")
        _print_pose(console, result.pose)
        if result.geopose is not None:
            print_line(console, "on Earth", _on_earth(result.geopose))
    elif result.refusal is not None:
        print_line(console, "not localized", result.refusal.message, "bold yellow")
        print_line(console, "gave up at", f"{result.refusal.stage} ({result.refusal.reason})")
        print_line(console, "map", f"{result.map.id}@{result.map.version}")
        _print_candidates(console, result.refusal.candidates)
    if result.coarse is not None:
        print_line(console, "coarse", "told by retrieval alone; nothing confirms it", "bold yellow")
        _print_place(console, result.coarse)
    if result.tile is not None:
        print_line(console, "tile", result.tile)
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
    if result.orientation.turned:
        print_line(
            console,
            "turned",
            f"by {result.orientation.turned} degrees clockwise: the map knew the photo only so; "
            "camera and pose are those of the photo as sent",
        )
    if result.orientation.exif != 1:
        print_line(
            console,
            "orientation",
            f"EXIF {result.orientation.exif}, features found in the photo as "
            f"{result.orientation.read_as}; camera and pose are those of the stored pixels",
        )
    print_line(
        console, "seconds", ", ".join(f"{k} {v:.3f}" for k, v in _longest_first(result.seconds))
    )
    print_line(console, "request", result.request_id)


def print_report(
    console: Console, report: Mapping[str, Any], num_with_truth: int, num_errors: int, unit: str
) -> None:
    """Print the report of a benchmark, with its modes side by side."""
    server, modes = report["server"], report["modes"]
    features = ", ".join((server["features"]["local"], *server["features"]["global"]))
    console.print(
        f"[bold]{report['localized']} of {report['queries']} localized[/bold]"
        f"{f' ({next(iter(modes))})' if len(modes) > 1 else ''} "
        f"in {escape(server['map'])} ({escape(features)}), "
        f"server {escape(server['version'] or 'of unknown version')}",
        highlight=False,
        soft_wrap=True,
    )
    if num_errors:
        console.print(f"[red]{num_errors} without an answer[/red]", highlight=False)
    if report["recall"] is None:
        console.print("no ground truth in the dataset: no accuracy", highlight=False)
    if report["recall"] is not None or len(modes) > 1:
        console.print(_poses(modes, num_with_truth, unit))
    console.print(_speed(modes))


def print_batch(console: Console, counts: Mapping[str, int], num_photos: int, fills: bool) -> None:
    """Print how many photos have a pose, and its sources."""
    parts = [f"{counts['localized']} of {num_photos} localized"]
    if fills:
        sources = [f"{counts[name]} {words}" for name, words in _FILLED.items() if counts[name]]
        parts.append(f"{counts['filled']} filled" + (f" ({', '.join(sources)})" if sources else ""))
    if counts["coarse"]:
        parts.append(f"{counts['coarse']} with a coarse pose only")
    parts += [f"{counts['not_localized']} not localized", f"{counts['error']} without an answer"]
    console.print(", ".join(parts), highlight=False)


def print_failed(console: Console, failed: Sequence[Outcome]) -> None:
    """Print the first few photos without an answer, and why."""
    for outcome in failed[:_NUM_FAILED_SHOWN]:
        if outcome.error is not None:
            text = f"{outcome.query.name} [{outcome.error.code}] {outcome.error}"
            print_line(console, "no answer", text, "yellow")
    if len(failed) > _NUM_FAILED_SHOWN:
        print_line(console, "", f"and {len(failed) - _NUM_FAILED_SHOWN} more")


def print_line(console: Console, label: str, text: str, style: str = "bold") -> None:
    """Print a label and a text on one line."""
    # Texts from files and servers could move the cursor or paint the terminal.
    clean = "".join(letter if letter.isprintable() else "?" for letter in text)
    line = Text.assemble((f"{label:<14} ", style), clean)
    console.print(line, highlight=False, soft_wrap=True)


def _on_earth(place: GeoPose) -> str:
    return f"{place.latitude:.8f}, {place.longitude:.8f}, {place.height:.3f} m above the ellipsoid"


def _print_place(console: Console, pose: PoseEstimate | CoarsePose) -> None:
    print_line(
        console,
        "position",
        f"{_numbers(pose.position, 4)} {unit_of(pose)}, std {_numbers(pose.position_std, 4)}",
    )
    print_line(
        console,
        "orientation",
        f"{_numbers(pose.orientation, 6)} (w x y z, world_from_cam), "
        f"std {_numbers(pose.orientation_std_deg, 3)} degrees",
    )


def _print_pose(console: Console, pose: PoseEstimate) -> None:
    _print_place(console, pose)
    print_line(console, "uncertainty", _UNCERTAINTY.get(pose.uncertainty, pose.uncertainty))
    if pose.probability is not None:
        print_line(console, "probability", f"{pose.probability:.3f} that the pose is right")


def _print_candidates(console: Console, candidates: Sequence[Candidate]) -> None:
    """Print the places of an ambiguous photo: two, or the one that is known."""
    labels = ("perhaps",) if len(candidates) == 1 else ("either", "or")
    for label, each in zip(labels, candidates, strict=False):
        preference = each.preference
        facts = [
            f"{each.inliers} inliers",
            *([] if each.image is None else [f"most like {each.image}"]),
            *([] if preference is None else [f"preferred by {preference:+.1f} deviations"]),
        ]
        place = each.tile or f"{each.map.id}@{each.map.version}"
        print_line(
            console,
            label,
            f"{_numbers(each.position, 4)} in {place}, turned {_numbers(each.orientation, 4)}: "
            f"{', '.join(facts)}",
        )


# What the standard deviations cover, for people.
_UNCERTAINTY: Mapping[str, str] = {
    Uncertainty.WHOLE: "whole: scatter of the photo's matches, and errors of the map",
    Uncertainty.PHOTO_ONLY: "photo only: the errors of the map are not in it",
}


def _poses(modes: Mapping[str, Mapping[str, Any]], num_with_truth: int, unit: str) -> Table:
    """Make the table of the paper: the modes over the same photos."""
    figures = list(modes.values())
    has_truth = figures[0]["recall"] is not None
    title = f"accuracy over {num_with_truth} with known pose" if has_truth else "poses"
    table = Table(title=title, title_justify="left")
    table.add_column("", no_wrap=True)
    for mode in modes:
        table.add_column(mode, justify="right", no_wrap=True)

    def row(label: str, cells: Iterable[str]) -> None:
        table.add_row(label, *cells)

    row("localized", (f"{f['localized']} of {f['queries']}" for f in figures))
    if any(f["instants"] is not None for f in figures):
        instants = (f["instants"] for f in figures)
        row(
            "instants",
            ("-" if i is None else f"{i['localized']} of {i['asked']}" for i in instants),
        )
    for source in _FILLED:
        of_modes = [f["sources"].get(source) for f in figures]
        if any(of_modes):
            row(f"filled, {source}", ("-" if of is None else f"{of['poses']}" for of in of_modes))
            row(
                f"  their std ({unit})",
                ("-" if of is None else f"{of['median_position_std_m']:.4f}" for of in of_modes),
            )
    table.add_section()
    row("uncertainty", (f["uncertainty"] or "-" for f in figures))
    for name in ("p50", "p10", "min"):
        row(
            f"probability {name}",
            ("-" if f["probability"] is None else f"{f['probability'][name]:.3f}" for f in figures),
        )
    if not has_truth:
        return table
    table.add_section()
    for rows in zip(*(f["recall"] for f in figures), strict=True):
        row(
            f"within {rows[0]['max_position_error_m']:g} {unit}, "
            f"{rows[0]['max_orientation_error_deg']:g}°",
            (_share(r["fraction"], num_with_truth, len(modes)) for r in rows),
        )
    for label, field in (
        (f"position ({unit})", "position_error_m"),
        ("orientation (°)", "orientation_error_deg"),
    ):
        table.add_section()
        for name in _PERCENTILES:
            row(
                f"{label} {name}",
                ("-" if f[field] is None else f"{f[field][name]:.4f}" for f in figures),
            )
    table.add_section()
    held = [f["calibration"] for f in figures]
    row(
        "inside stated 95 %",
        ("-" if one is None else f"{one['inside_95']:.1%}" for one in held),
    )
    row(
        "error / stated std, p50",
        (
            "-" if one is None or one["median_ratio"] is None else f"{one['median_ratio']:.2f}"
            for one in held
        ),
    )
    return table


def _share(fraction: float, total: int, num_columns: int) -> str:
    share = f"{fraction:.1%}"
    return f"{share}  ({round(fraction * total)})" if num_columns == 1 else share


def _speed(modes: Mapping[str, Mapping[str, Any]]) -> Table:
    # The modes that fill send no requests of their own.
    asked: dict[str, Mapping[str, Any]] = {}
    for figures in modes.values():
        asked.setdefault("a photo" if figures["instants"] is None else "an instant", figures)
    table = Table(title="time, as the client sees it", title_justify="left")
    table.add_column("")
    for what in asked:
        table.add_column("seconds" if len(asked) == 1 else f"seconds, {what}", justify="right")
    columns = list(asked.values())
    for name in columns[0]["latency_s"]:
        table.add_row(
            f"latency {name}", *(_seconds(figures["latency_s"][name], 3) for figures in columns)
        )
    table.add_section()
    stages: dict[str, float] = {}
    for figures in columns:
        for stage, seconds in figures["stage_seconds"].items():
            stages[stage] = max(seconds, stages.get(stage, 0.0))
    for stage, _ in _longest_first(stages):
        table.add_row(
            f"server, {escape(stage)} (mean)",
            *(_seconds(figures["stage_seconds"].get(stage), 4) for figures in columns),
        )
    if columns[0]["throughput_qps"] is not None:
        table.add_section()
        rates = (figures["throughput_qps"] for figures in columns)
        table.add_row("answers per second", *(_seconds(rate, 2) for rate in rates))
    return table


def _seconds(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _longest_first(seconds: Mapping[str, float]) -> list[tuple[str, float]]:
    # Over gRPC the stages come in no order.
    return sorted(seconds.items(), key=lambda stage: -stage[1])


def _numbers(values: Iterable[float], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}".rstrip("0").rstrip(".") for value in values)
