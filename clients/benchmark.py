"""How accurate and how fast a server answers the queries of a dataset."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from clients.running import Outcome
from clients.types import MapInfo, ServerInfo
from visloc.errors import InvalidInput
from visloc.evaluation import (
    Threshold,
    median_errors_localized,
    percentile,
    pose_error,
    recall,
)


def parse_threshold(text: str) -> Threshold:
    """Parse ``METRES/DEGREES`` such as ``0.25/2``.

    Raises:
        InvalidInput: ``evaluation.threshold``.
    """
    try:
        position_m, orientation_deg = (float(part) for part in text.split("/"))
        if math.isfinite(position_m) and math.isfinite(orientation_deg):
            return Threshold(position_m, orientation_deg)
    except (ValueError, InvalidInput):
        pass
    raise InvalidInput(
        "evaluation.threshold",
        "not a threshold",
        field="threshold",
        expected="METRES/DEGREES, neither negative, such as 0.25/2",
        got=text,
    )


def make_report(
    outcomes: Sequence[Outcome],
    wall_seconds: float,
    thresholds: Sequence[Threshold],
    server: ServerInfo,
    map_info: MapInfo,
) -> dict[str, Any]:
    """Summarize a run as plain JSON; null where nothing can be said.

    Recall is over all photos with a known pose, localized or not; the medians are over those
    that were localized. Latencies are those of answers as the client saw them. The seconds of a
    stage are the mean over the answers that reached it.

    Args:
        outcomes: of all photos.
        wall_seconds: from the first request to the last answer.
        thresholds: of the recall.
        server: that answered.
        map_info: the map that was asked for.
    """
    results = [outcome.result for outcome in outcomes if outcome.result is not None]
    latencies = [outcome.seconds for outcome in outcomes if outcome.result is not None]
    errors = pose_errors(outcomes)
    num_with_truth = sum(outcome.query.truth is not None for outcome in outcomes)
    median_position_m, median_orientation_deg = median_errors_localized(errors)
    return {
        "queries": len(outcomes),
        "localized": sum(result.localized for result in results),
        "median_position_error_m": _finite(median_position_m),
        "median_orientation_error_deg": _finite(median_orientation_deg),
        "recall": _recall(errors, num_with_truth, thresholds),
        "latency_s": {f"p{q}": _finite(percentile(latencies, q)) for q in (50, 90, 99)},
        "throughput_qps": len(results) / wall_seconds if wall_seconds > 0 else None,
        "stage_seconds": _mean_by_stage(outcomes),
        "server": {
            "version": server.version,
            "map": map_info.ref,
            "features": {
                "local": map_info.local_features,
                "global": list(map_info.global_features),
            },
        },
    }


def pose_errors(outcomes: Sequence[Outcome]) -> list[tuple[float, float]]:
    """Return (metres, degrees) for each localized photo whose true pose is known."""
    return [
        pose_error(outcome.result.pose.cam_from_world, outcome.query.truth)
        for outcome in outcomes
        if outcome.result is not None
        and outcome.result.pose is not None
        and outcome.query.truth is not None
    ]


def _recall(
    errors: Sequence[tuple[float, float]], num_queries: int, thresholds: Sequence[Threshold]
) -> list[dict[str, float]] | None:
    if num_queries == 0:
        return None
    fractions = recall(errors, num_queries, thresholds)
    return [
        {
            "max_position_error_m": threshold.max_position_error_m,
            "max_orientation_error_deg": threshold.max_orientation_error_deg,
            "fraction": fraction,
        }
        for threshold, fraction in zip(thresholds, fractions, strict=True)
    ]


def _mean_by_stage(outcomes: Sequence[Outcome]) -> dict[str, float]:
    by_stage: dict[str, list[float]] = defaultdict(list)
    for outcome in outcomes:
        if outcome.result is not None:
            for stage, seconds in outcome.result.seconds.items():
                by_stage[stage].append(seconds)
    return {stage: math.fsum(values) / len(values) for stage, values in by_stage.items()}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
