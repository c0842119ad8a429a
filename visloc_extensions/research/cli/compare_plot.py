"""A comparison as a picture: accuracy on the left, time per query on the right."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from visloc_extensions.research.cli.compare_display import clean, mebibytes, threshold_text

_WIDTH_INCHES = 11.0
_BAR_INCHES = 0.17  # the height of one bar
_BESIDE_INCHES = 1.75  # title, legend and axis
_GROUP = 0.84  # of the distance between two values
_TIME_COLOR = "#4c6a92"
_GREY = "#8a8a8a"


def draw_comparison(comparison: Mapping[str, Any]) -> bytes:
    """Draw a PNG."""
    values = comparison["values"]
    bins = _bins(comparison)
    group_inches = max(len(bins), 2) * _BAR_INCHES / _GROUP
    figure = Figure(
        figsize=(_WIDTH_INCHES, _BESIDE_INCHES + len(values) * group_inches), layout="constrained"
    )
    FigureCanvasAgg(figure)
    accuracy, time = figure.subplots(1, 2, sharey=True, width_ratios=(1.35, 1.0))
    _draw_accuracy(accuracy, comparison, bins)
    _draw_time(time, values)
    accuracy.set_yticks(range(len(values)), [_label(comparison, value) for value in values])
    accuracy.set_ylim(len(values) - 0.5, -0.5)  # the first value on top
    for axes in (accuracy, time):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(axis="y", length=0)
        axes.set_axisbelow(True)
        axes.grid(axis="x", color="#e0e0e0")
    maps = {value["map"] for value in values}
    where = _plain(next(iter(maps))) if len(maps) == 1 else f"{len(maps)} maps"
    figure.suptitle(f"{comparison['axis']}: {comparison['photos']} photos in {where}", fontsize=11)
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=150)
    return png.getvalue()


def _bins(comparison: Mapping[str, Any]) -> list[str]:
    if not comparison["photos_with_truth"]:
        return ["localized"]
    return [f"within {threshold_text(comparison, t)}" for t in comparison["thresholds"]]


def _draw_accuracy(axes: Axes, comparison: Mapping[str, Any], bins: list[str]) -> None:
    height = _GROUP / len(bins)
    shades = colormaps["viridis"]
    for number, name in enumerate(bins):
        offset = (number - (len(bins) - 1) / 2) * height
        color = shades(0.12 + 0.75 * number / max(len(bins) - 1, 1))
        axes.barh([0.0], [0.0], color=color, label=name)  # in the legend in any case
        for row, value in enumerate(comparison["values"]):
            figures = value["figures"]
            if figures is None:
                continue
            percent = 100 * _fraction(comparison, figures, number)
            axes.barh(row + offset, percent, height=0.92 * height, color=color)
            axes.text(percent + 1, row + offset, f"{percent:.1f}", va="center", fontsize=7)
    for row, value in enumerate(comparison["values"]):
        if value["refusal"] is not None:
            text = f"refused: {_plain(value['refusal']['code'])}"
            axes.text(1, row, text, va="center", fontsize=8, color=_GREY, style="italic")
    axes.set_xlim(0, 108)
    axes.set_xticks(range(0, 101, 20))
    axes.set_xlabel("photos, %", fontsize=9)
    axes.legend(
        *axes.get_legend_handles_labels(),
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=2,
        frameon=False,
        fontsize=8,
    )


def _fraction(comparison: Mapping[str, Any], figures: Mapping[str, Any], number: int) -> float:
    if figures["recall"] is None:
        return float(figures["localized"]) / float(comparison["photos"])
    return float(figures["recall"][number]["fraction"])


def _draw_time(axes: Axes, values: list[Mapping[str, Any]]) -> None:
    longest = 0.0
    for row, value in enumerate(values):
        latency = None if value["figures"] is None else value["figures"]["latency_s"]
        if latency is None or latency["p50"] is None:
            continue
        p50, p90 = 1000 * latency["p50"], 1000 * latency["p90"]
        longest = max(longest, p90)
        axes.barh(row, p50, height=0.45, color=_TIME_COLOR)
        axes.plot([p50, p90], [row, row], color=_GREY, linewidth=1.2, zorder=3)
        axes.plot([p90], [row], marker="|", markersize=9, color="black", zorder=3)
        axes.annotate(
            f"{p50:.0f}, {p90:.0f}",
            *((p90, row), (6, 0)),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    axes.set_xlim(0, 1.22 * longest if longest > 0 else 1)
    axes.set_xlabel("time per query, ms", fontsize=9)
    axes.set_title("bar: p50, mark: p90", fontsize=8, loc="left", color=_GREY)


def _label(comparison: Mapping[str, Any], value: Mapping[str, Any]) -> str:
    """Name a value, with the size of its map where the maps differ."""
    name = _plain(value["value"])
    differ = len({each["map"] for each in comparison["values"]}) > 1
    return f"{name}\n{mebibytes(value['size_bytes'])}" if differ else name


def _plain(text: str) -> str:
    """Keep matplotlib from taking a name for a formula."""
    return clean(text).replace("$", r"\$")
