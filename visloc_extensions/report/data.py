"""All that a report shows, in the shape of web/src/report/data.ts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.cluster.workers import Workers
from mapping.frames.plan import Plan
from mapping.maps.cameras import camera_lines
from mapping.own_test.held_out import HeldOut, Within, tolerance_of
from mapping.stages.work_folder import WorkFolder
from visloc import __version__
from visloc.archive import Map
from visloc.geometry import Camera
from visloc.localization.map_view.constraints import MapGeometry, Viewpoints
from visloc_extensions.report.grid import Grid, forecast_grid, make_grid
from visloc_extensions.report.held_out import hold_out
from visloc_extensions.report.look_alikes import LookAlike, find_look_alikes
from visloc_extensions.report.model import Forecast, Learned, learn
from visloc_extensions.report.statistics import statistics_of
from visloc_extensions.report.weak_spots import WeakSpot, find_weak_spots

_MAX_CALIBRATION_BINS, _RUNS_PER_BIN = 10, 10
# With fewer runs that failed, or succeeded, than this, what tells both apart is a guess.
_FEW_OUTCOMES = 5
UP_IS_A_GUESS = (
    "Up was guessed from how the cameras were held, which is wrong for cameras that look straight "
    "down and for photos stored on their side. Then state it: build the map with --gravity."
)


def make_report_data(
    opened: Map,
    work: WorkFolder,
    *,
    command: str,
    workers: Workers,
    progress: Callable[[str, int, int], None],
) -> dict[str, Any]:
    """Measure and predict where a map localizes.

    Args:
        work: keeps held-out runs, for a report that was interrupted or is made again.
        progress: told the stage, how much is done, and of how much.

    Returns:
        JSON values as ``ReportData`` of web/src/report/data.ts, but for ``points``.
    """
    viewpoints = MapGeometry(opened).viewpoints
    within = tolerance_of(opened, viewpoints)
    runs = hold_out(opened, work, workers, partial(progress, "held-out photos"))
    told = partial(progress, "look-alikes")
    alike = find_look_alikes(opened, viewpoints, runs, work, workers, told)
    learned = learn(opened, viewpoints, runs, within, partial(progress, "what is found again"))
    plan = Plan.of(opened, viewpoints)
    grid = make_grid(plan, viewpoints)
    forecasts = forecast_grid(learned.model, plan, grid, partial(progress, "coverage"))
    unit = " m" if opened.manifest.world.metric else ""
    spots = find_weak_spots(grid, plan, forecasts, learned.model, within, unit)
    origin = np.array(opened.manifest.world.origin)
    # Micrometres, and of small worlds as much finer.
    digits = max(6, decimals_of(viewpoints.reach / 1e5))
    return {
        "map": {**_about(opened), "notes": _notes(opened, plan, runs, within)},
        "made_by": {"command": command, "version": __version__},
        "up": {"direction": _numbers(plan.up, 9), "source": plan.up_source},
        "cameras": {name: _camera(camera) for name, camera in opened.cameras.items()},
        "images": _images(opened, viewpoints, origin, digits),
        "statistics": statistics_of(opened),
        "held_out": _held_out(runs, learned, digits),
        "look_alikes": [_look_alike(one, opened, digits) for one in alike.found],
        "look_alikes_asked": alike.asked,
        "coverage": {
            "within": {"position": within.position, "orientation_deg": within.orientation_deg},
            "cell": grid.side,
            "right": _numbers(plan.right, 9),
            "ahead": _numbers(plan.ahead, 9),
            "directions_deg": list(grid.directions_deg),
            "pitch_deg": round(plan.pitch_deg, 3),
            "camera": _camera(plan.camera),
            "cells": [
                _cell(_numbers(position + origin, digits), row)
                for position, row in zip(grid.positions, forecasts, strict=True)
            ],
            "weak_spots": [_weak_spot(spot, grid, forecasts, origin, digits) for spot in spots],
            "calibration": calibration_of(runs, learned.probabilities, within),
            "rank_correlation": rank_correlation_of(runs, learned.probabilities),
        },
    }


def _notes(opened: Map, plan: Plan, runs: Sequence[HeldOut], within: Within) -> list[str]:
    guess = [] if plan.up_source == "gravity" else [UP_IS_A_GUESS]
    against = [f"not put into use by itself: {d.message}" for d in opened.manifest.parts.doubts]
    return [*against, *opened.manifest.notes, *_doubts(runs, within), *guess]


def calibration_of(
    runs: Sequence[HeldOut], probabilities: NDArray[np.float64], within: Within
) -> list[dict[str, float]]:
    """Compare predicted with measured shares of success, in bins of as many runs each."""
    order = np.argsort(probabilities, kind="stable")
    held = np.array([within.holds(run) for run in runs], dtype=np.float64)
    num_bins = min(_MAX_CALIBRATION_BINS, len(runs) // _RUNS_PER_BIN)
    return [
        {
            "predicted": round(float(probabilities[rows].mean()), 4),
            "measured": round(float(held[rows].mean()), 4),
            "runs": len(rows),
        }
        for rows in (np.array_split(order, num_bins) if num_bins else [])
    ]


def rank_correlation_of(
    runs: Sequence[HeldOut], probabilities: NDArray[np.float64]
) -> float | None:
    """Spearman's, of predicted failure and measured error; those refused are the worst.

    None where all predictions or all errors are the same.
    """
    errors = np.array([run.position_error for run in runs])
    if len(runs) < 3 or np.ptp(probabilities) == 0 or (errors == errors[0]).all():
        return None
    from scipy.stats import spearmanr  # takes long to load, and every command loads this module

    return round(float(spearmanr(-probabilities, errors).statistic), 4)


def decimals_of(step: float) -> int:
    """Digits after the point that tell numbers apart that differ by a step."""
    return max(0, -math.floor(math.log10(step)))


def _doubts(runs: Sequence[HeldOut], within: Within) -> list[str]:
    """Warnings to read before trusting the predictions."""
    if not runs:
        return [
            "Coverage: no photo could be held out, so that probabilities rest on what holds for "
            "other maps."
        ]
    failed = sum(not within.holds(run) for run in runs)
    few = min(failed, len(runs) - failed)
    if few >= _FEW_OUTCOMES:
        return []
    kind = "failed" if failed == few else "succeeded"
    return [
        f"Coverage: only {few} of {len(runs)} held-out runs {kind}, so that where the line runs "
        "rests in part on what holds for other maps."
    ]


def _about(opened: Map) -> dict[str, Any]:
    manifest, extent = opened.manifest, opened.manifest.world.extent
    return {
        "id": manifest.id,
        "version": manifest.version,
        "created": manifest.created,
        "method": manifest.method.name,
        "local_features": manifest.local_features.fingerprint.name,
        "global_features": [g.fingerprint.name for g in manifest.global_features],
        "metric": manifest.world.metric,
        "cameras": camera_lines(opened),
        "images": manifest.counts.images,
        "landmarks": manifest.counts.landmarks,
        "observations": manifest.counts.observations,
        "size_bytes": opened.size_bytes,
        "extent": {"min": list(extent.min), "max": list(extent.max)},
    }


def _images(
    opened: Map, viewpoints: Viewpoints, origin: NDArray[np.float64], digits: int
) -> list[dict[str, Any]]:
    turned_back = opened.image_poses[:, :4] * (1.0, -1.0, -1.0, -1.0)
    return [
        {
            "name": image.name,
            "camera": image.camera,
            "position": _numbers(center + origin, digits),
            "orientation": _numbers(orientation, 9),
        }
        for image, center, orientation in zip(
            opened.images, viewpoints.centers, turned_back, strict=True
        )
    ]


def _held_out(runs: Sequence[HeldOut], learned: Learned, digits: int) -> list[dict[str, Any]]:
    return [
        {
            "image": run.image,
            "left_out": len(run.left_out),
            "localized": run.localized,
            "reason": run.reason or None,
            "position_error": round(run.position_error, digits) if run.localized else None,
            "orientation_error_deg": round(run.orientation_error_deg, 5) if run.localized else None,
            "inliers": run.inliers,
            "expected_inliers": round(float(expected), 1),
            "probability": round(float(probability), 4),
        }
        for run, expected, probability in zip(
            runs, learned.expected_inliers, learned.probabilities, strict=True
        )
    ]


def _look_alike(one: LookAlike, opened: Map, digits: int) -> dict[str, Any]:
    return {
        "image": one.image,
        "twin": one.twin,
        "position": _numbers(one.position + opened.manifest.world.origin, digits),
        "inliers": one.inliers,
        "own_inliers": one.own_inliers,
        "told": one.told(opened),
    }


def _cell(position: list[float], forecasts: Sequence[Forecast]) -> dict[str, Any]:
    stds = [forecast.position_std for forecast in forecasts]
    return {
        "position": position,
        "probability": [round(forecast.probability, 4) for forecast in forecasts],
        "expected_inliers": [round(f.outlook.expected_inliers, 1) for f in forecasts],
        "position_std": [float(f"{std:.4g}") if math.isfinite(std) else None for std in stds],
    }


def _weak_spot(
    spot: WeakSpot,
    grid: Grid,
    forecasts: Sequence[Sequence[Forecast]],
    origin: NDArray[np.float64],
    digits: int,
) -> dict[str, Any]:
    return {
        "position": _numbers(grid.positions[spot.cell] + origin, digits),
        "direction_deg": grid.directions_deg[spot.direction],
        "probability": round(forecasts[spot.cell][spot.direction].probability, 4),
        "why": spot.why,
    }


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }


def _numbers(values: ArrayLike, digits: int) -> list[float]:
    return [round(float(value), digits) for value in np.asarray(values)]
