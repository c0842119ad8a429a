"""The curves of a run, as pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc_extensions.training.run import LOG_NAME, VALIDATION_NAME
from visloc_extensions.training.validation import THRESHOLDS_PX

_SMOOTH_SHARE = 0.02  # of the steps: single batches differ more than the network changes
_PARTS = ("total", "peakiness", "reliability", "similarity")


def draw(folder: Path, beside: Path | None = None) -> list[Path]:
    """Write ``loss.png`` and, where there were validations, ``validation.png`` into a run's folder.

    Args:
        beside: lines of JSON that ``validate --output`` wrote of other features, drawn as levels.
    """
    lines = _lines(folder / LOG_NAME)
    if not lines:
        raise refuse("training.log", field=str(folder / LOG_NAME))
    written = [_draw_losses(lines, folder / "loss.png")]
    scores = _lines(folder / VALIDATION_NAME)
    if scores:
        others = [] if beside is None else _lines(beside)
        written.append(_draw_validation(scores, others, folder / "validation.png"))
    return written


def _lines(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def _draw_losses(lines: list[dict[str, Any]], path: Path) -> Path:
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    losses, rates = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    steps = np.array([line["step"] for line in lines])
    width = max(1, round(_SMOOTH_SHARE * len(lines)))
    for part in _PARTS:
        values = _running_mean(np.array([line[part] for line in lines]), width)
        losses.plot(steps[width - 1 :], values, label=part)
    losses.set_ylabel(f"loss, mean of {width} steps")
    losses.set_ylim(bottom=0)
    losses.grid(alpha=0.3)
    losses.legend()
    rates.plot(steps, [line["learning_rate"] for line in lines], color="black")
    rates.set_yscale("log")
    rates.set_ylabel("learning rate")
    rates.set_xlabel("step")
    figure.savefig(path, dpi=120)
    return path


def _running_mean(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    sums = np.cumsum(np.concatenate([[0.0], values]))
    return np.asarray((sums[width:] - sums[:-width]) / width)


def _draw_validation(
    scores: list[dict[str, Any]], others: list[dict[str, Any]], path: Path
) -> Path:
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    steps = [score["step"] for score in scores]
    for number, limit in enumerate(THRESHOLDS_PX):
        accuracy = [100 * score["matching_accuracy"][number] for score in scores]
        axes.plot(steps, accuracy, marker="o", markersize=3, label=f"within {limit:g} px")
    middle = 1
    for other in others:
        level = 100 * other["matching_accuracy"][middle]
        axes.axhline(level, color="grey", linestyle=":", linewidth=1)
        axes.annotate(
            f"{other['features']}, {THRESHOLDS_PX[middle]:g} px",
            (steps[-1], level),
            ha="right",
            va="bottom",
            fontsize=8,
        )
    axes.set_xlabel("step")
    axes.set_ylabel("mutual nearest neighbours that are right, %")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)
    return path
