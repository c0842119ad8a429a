"""Accuracy and speed of a server over a dataset."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clients.evaluation.filling import estimate_of, measured
from clients.evaluation.modes import Mode
from clients.evaluation.queries import Query
from clients.evaluation.run import InstantOutcome, Outcome
from clients.wire.answers import ServerInfo
from visloc.accuracy import Compared, accuracy_of, finite
from visloc.errors import InvalidInput, refuse
from visloc.evaluation import Threshold, percentile
from visloc.sequences.filling import TracedPose
from visloc.types import PoseSource, Uncertainty
from visloc_api.words.maps import MapInfo

# Of probabilities, the low ones matter.
_PROBABILITY_PERCENTILES = {"p50": 50, "p10": 10, "min": 0}


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """The outcomes of a dataset, and how long they took.

    Attributes:
        outcomes: of all photos, in the order of the dataset.
        latencies_s: of each answer, as the client saw it.
        stage_seconds: of each answer, as the server reports it.
        wall_s: from the first request to the last answer.
        instants: the requests, when they were not for single photos.
    """

    outcomes: tuple[Outcome, ...]
    latencies_s: tuple[float, ...]
    stage_seconds: tuple[Mapping[str, float], ...]
    wall_s: float
    instants: tuple[InstantOutcome, ...] | None = None

    @staticmethod
    def of(
        answers: Sequence[Outcome | InstantOutcome],
        photos: Sequence[Query],
        wall_s: float,
    ) -> Run:
        """Make a run of the answers to photos or to instants."""
        by_name = {o.query.name: o for answer in answers for o in answer.photos}
        answered = [answer for answer in answers if answer.has_answer]
        # The photos of an instant share its seconds.
        results = [[o.result for o in each.photos if o.result is not None] for each in answered]
        instants = tuple(each for each in answers if isinstance(each, InstantOutcome))
        return Run(
            tuple(by_name[query.name] for query in photos),
            tuple(answer.seconds for answer in answered),
            tuple(each[0].seconds for each in results if each),
            wall_s,
            instants or None,
        )


def parse_threshold(text: str) -> Threshold:
    """Parse ``METRES/DEGREES`` such as ``0.25/2``."""
    try:
        position_m, orientation_deg = (float(part) for part in text.split("/"))
        if math.isfinite(position_m) and math.isfinite(orientation_deg):
            return Threshold(position_m, orientation_deg)
    except (ValueError, InvalidInput):
        pass
    raise refuse(
        "evaluation.threshold",
        field="threshold",
        expected="METRES/DEGREES, neither negative, such as 0.25/2",
        got=text,
    )


def make_report(
    runs: Mapping[Mode, Run],
    poses: Mapping[Mode, Sequence[TracedPose | None]],
    thresholds: Sequence[Threshold],
    server: ServerInfo,
    map_info: MapInfo,
) -> dict[str, Any]:
    """Summarize runs as plain JSON; null where there is no figure.

    Recall is over all photos with a known pose, localized or not. The medians and percentiles are
    over those that have a pose, localized or filled. Latencies are those of answers as the client
    saw them. The seconds of a stage are the mean over the answers that reached it.

    Args:
        runs: by mode, in the order of the table; the first one's figures are also at the top.
    """
    modes = {mode.value: figures_of(run, poses[mode], thresholds) for mode, run in runs.items()}
    first = next(iter(modes.values()))
    return {
        **{name: first[name] for name in _FIGURES_OF_THE_FIRST},
        "server": {
            "version": server.version,
            "map": map_info.ref,
            "features": {
                "local": map_info.local_features,
                "global": list(map_info.global_features),
            },
        },
        "modes": modes,
    }


_FIGURES_OF_THE_FIRST = (
    *("queries", "localized", "median_position_error_m", "median_orientation_error_deg"),
    *("recall", "latency_s", "throughput_qps", "stage_seconds"),
)


def known_poses(run: Run) -> list[TracedPose | None]:
    """Return the poses of the answers: measured ones, and those filled from a rig's."""
    return [
        o.filled
        if o.result is None or o.result.pose is None
        else measured(o.result.pose, o.result.inliers)
        for o in run.outcomes
    ]


def figures_of(
    run: Run, poses: Sequence[TracedPose | None], thresholds: Sequence[Threshold]
) -> dict[str, Any]:
    """Summarize one run as ``make_report`` does."""
    sources = _sources(poses)
    num_localized = sources.get(PoseSource.ESTIMATED.value, {}).get("poses", 0)
    return {
        "queries": len(poses),
        "localized": num_localized,
        "filled": sum(pose is not None for pose in poses) - num_localized,
        "sources": sources,
        "instants": None
        if run.instants is None
        else {"asked": len(run.instants), "localized": sum(i.localized for i in run.instants)},
        **accuracy_of(_compared(run.outcomes, poses), thresholds),
        "uncertainty": _uncertainty(poses),
        "probability": _probability(run.outcomes),
        "latency_s": {f"p{q}": finite(percentile(run.latencies_s, q)) for q in (50, 90, 99)},
        "throughput_qps": len(run.latencies_s) / run.wall_s if run.wall_s > 0 else None,
        "stage_seconds": _mean_by_stage(run.stage_seconds),
    }


def _compared(outcomes: Sequence[Outcome], poses: Sequence[TracedPose | None]) -> list[Compared]:
    """Return the photos whose true pose is known, each with its pose."""
    return [
        Compared(outcome.query.truth, None)
        if pose is None
        else Compared(outcome.query.truth, pose.pose, pose.covariance)
        for outcome, pose in zip(outcomes, poses, strict=True)
        if outcome.query.truth is not None
    ]


def _uncertainty(poses: Sequence[TracedPose | None]) -> str | None:
    """Return what all stated uncertainties cover: the least that one of them does."""
    words = {pose.uncertainty for pose in poses if pose is not None}
    if not words:
        return None
    return (Uncertainty.WHOLE if words == {Uncertainty.WHOLE} else Uncertainty.PHOTO_ONLY).value


def _probability(outcomes: Sequence[Outcome]) -> dict[str, float] | None:
    """Return percentiles of the probability that a pose is right, over the poses that have one."""
    stated = [
        outcome.result.pose.probability
        for outcome in outcomes
        if outcome.result is not None
        and outcome.result.pose is not None
        and outcome.result.pose.probability is not None
    ]
    if not stated:
        return None
    return {name: float(np.percentile(stated, q)) for name, q in _PROBABILITY_PERCENTILES.items()}


def _sources(poses: Sequence[TracedPose | None]) -> dict[str, dict[str, float]]:
    """Count poses by their source, with the median standard deviation of the position."""
    known = [pose for pose in poses if pose is not None]
    stds = defaultdict(list)
    for pose in known:
        stds[pose.source].append(float(np.linalg.norm(estimate_of(pose).position_std)))
    counts = Counter(pose.source for pose in known)
    return {
        source.value: {
            "poses": counts[source],
            "median_position_std_m": float(np.median(stds[source])),
        }
        for source in PoseSource
        if counts[source]
    }


def _mean_by_stage(answers: Sequence[Mapping[str, float]]) -> dict[str, float]:
    by_stage: dict[str, list[float]] = defaultdict(list)
    for answer in answers:
        for stage, seconds in answer.items():
            by_stage[stage].append(seconds)
    return {stage: math.fsum(values) / len(values) for stage, values in by_stage.items()}
