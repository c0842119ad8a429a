"""A comparison as a table, for a terminal and as Markdown."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from clients.cli.display import print_line

_MAX_LINE = 100
_NUM_OF_COST = 3  # columns of time and size
_NOTHING = "-"


def command_text(arguments: Sequence[str]) -> str:
    """Write the command so that it can be pasted into a shell, broken into lines."""
    words = [shlex.quote(word) for word in ("localize", *arguments)]
    lines = [words[0]]
    for word in words[1:]:
        # Only an option begins a line, never its value.
        begins = len(lines[-1]) > _MAX_LINE - 30 and word.startswith("-")
        if begins:
            lines.append(f"    {word}")
        else:
            lines[-1] += f" {word}"
    return " \\\n".join(lines)


def threshold_text(comparison: Mapping[str, Any], threshold: Sequence[float]) -> str:
    """Write a threshold, such as ``0.25 m, 2°``."""
    length, degrees = threshold
    return f"{length:g} {_unit(comparison)}, {degrees:g}°"


def mebibytes(size_bytes: int) -> str:
    """Write the size of a map."""
    return f"{size_bytes / 2**20:.1f} MiB"


def print_comparison(console: Console, comparison: Mapping[str, Any]) -> None:
    """Print a row for each value, then the remarks."""
    header, rows = _cells(comparison)
    for row in rows:
        row[1] = row[1].partition(":")[0]  # the reason of a refusal is printed below
    # Two tables, so that they fit into 80 columns.
    num_accuracy = len(header) - _NUM_OF_COST
    for columns in (range(num_accuracy), (0, *range(num_accuracy, len(header)))):
        table = Table(box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
        for column in columns:
            table.add_column(
                escape(header[column]),
                justify="right" if column else "left",
                overflow="fold",
                # Only titles are broken.
                width=max(map(len, (*header[column].split(), *(row[column] for row in rows)))),
            )
        for row in rows:
            table.add_row(*(escape(clean(row[column])) for column in columns))
        console.print(table)
    for value in comparison["values"]:
        if value["refusal"] is not None:
            print_line(console, "refused", _refusal(value), "yellow")
    for line in _remarks(comparison):
        console.print(escape(clean(line)), highlight=False)


def markdown_of(comparison: Mapping[str, Any], picture: str) -> str:
    """Write the command, the table, its remarks, and a link to the picture."""
    header, rows = _cells(comparison)
    lines = ["```", comparison["command"], "```", "", _markdown_row(header)]
    lines.append(_markdown_row(["---"] * len(header)))
    lines += [_markdown_row(row) for row in rows]
    refusals = [_refusal(value) for value in comparison["values"] if value["refusal"] is not None]
    for refusal in refusals:
        lines += ["", f"Refused: {clean(refusal)}"]
    lines += ["", *map(clean, _remarks(comparison))]
    lines += ["", f"![{comparison['axis']}]({picture})"]
    return "\n".join(lines) + "\n"


def _cells(comparison: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    thresholds = comparison["thresholds"] if comparison["photos_with_truth"] else []
    header = [
        *(comparison["axis"], "localized"),
        *(threshold_text(comparison, threshold) for threshold in thresholds),
        "median error",
        *("p50", "p90", "map"),
    ]
    return header, [_row(comparison, value, len(thresholds)) for value in comparison["values"]]


def _row(comparison: Mapping[str, Any], value: Mapping[str, Any], num_bins: int) -> list[str]:
    size = mebibytes(value["size_bytes"])
    figures = value["figures"]
    if figures is None:
        nothing = [_NOTHING] * (num_bins + 3)
        return [value["value"], f"refused: {value['refusal']['code']}", *nothing, size]
    return [
        value["value"],
        f"{figures['localized']} of {comparison['photos']}",
        *(f"{bin_['fraction']:.1%}" for bin_ in (figures["recall"] or ())[:num_bins]),
        _median(comparison, figures),
        *(_milliseconds(figures["latency_s"][name]) for name in ("p50", "p90")),
        size,
    ]


def _median(comparison: Mapping[str, Any], figures: Mapping[str, Any]) -> str:
    length, degrees = figures["median_position_error_m"], figures["median_orientation_error_deg"]
    if length is None or degrees is None:
        return _NOTHING
    if comparison["metric"]:
        return f"{100 * length:.2f} cm, {degrees:.3f}°"
    return f"{length:.4f} {_unit(comparison)}, {degrees:.3f}°"


def _milliseconds(seconds: float | None) -> str:
    return _NOTHING if seconds is None else f"{1000 * seconds:.0f} ms"


def _unit(comparison: Mapping[str, Any]) -> str:
    return "m" if comparison["metric"] else "units"


def _refusal(value: Mapping[str, Any]) -> str:
    return f"{value['value']}: [{value['refusal']['code']}] {value['refusal']['message']}"


def _remarks(comparison: Mapping[str, Any]) -> list[str]:
    """Return the facts that a reader needs to trust the figures."""
    values = comparison["values"]
    maps = {
        value["map"]: ", ".join((value["local_features"], *value["global_features"]))
        for value in values
    }
    described = "; ".join(f"{ref} ({features})" for ref, features in maps.items())
    version = comparison["server"]["version"] or "of unknown version"
    photos, known = comparison["photos"], comparison["photos_with_truth"]
    times = "once" if comparison["repeats"] == 1 else f"{comparison['repeats']} times"
    lines = [
        f"{'Map' if len(maps) == 1 else 'Maps'} {described}; server {version}.",
        f"{photos} photos, {known} with a known pose: recall counts all of these, the median those "
        "that were localized."
        if known
        else f"{photos} photos, none with a known pose: no accuracy.",
        f"Each was asked about {times} with each value, one request at a time, the values in turn "
        f"in an order drawn with seed {comparison['seed']}; p50 and p90 are the times that the "
        "client saw. A first request of each value, to warm up, is not counted.",
    ]
    errors = {value["value"]: value["errors"] for value in values if value["errors"]}
    if errors:
        counts = ", ".join(f"{value} {count}" for value, count in errors.items())
        lines.append(f"Photos without an answer: {counts}.")
    return lines


def _markdown_row(cells: Sequence[str]) -> str:
    escaped = [clean(cell).replace("|", r"\|") for cell in cells]
    return f"| {' | '.join(escaped)} |"


def clean(text: str) -> str:
    """Replace characters that could move a cursor or break a line; names come from elsewhere."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)
