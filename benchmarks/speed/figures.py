"""From measurements of several rounds to the figures of the tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.speed.building import landmark_seconds
from benchmarks.speed.dataset import num_within
from benchmarks.speed.queries import DEFAULT, TORCH
from visloc.options import LocalizeOptions


@dataclass(frozen=True, slots=True)
class Spread:
    """Median, smallest and largest of the rounds."""

    median: float
    low: float
    high: float

    @staticmethod
    def of(values: Iterable[float]) -> Spread:
        """Summarize what each round gave; NaN without rounds."""
        known = [value for value in values if np.isfinite(value)]
        if not known:
            return Spread(np.nan, np.nan, np.nan)
        return Spread(float(np.median(known)), min(known), max(known))


@dataclass(frozen=True, slots=True)
class Measured:
    """What was measured, a list by round each; the peer and builds are in fewer rounds.

    Attributes:
        queries: answers by way.
        service: reports of ``localize benchmark`` by concurrency.
        peer: reports of the peer, and the error of each query.
        builds: of our map.
        rates: of the machine.
        described: by way, what computes features.
    """

    queries: Sequence[Mapping[str, Sequence[Mapping[str, Any]]]]
    service: Sequence[Mapping[str, Any]]
    peer: Sequence[Mapping[str, Any]]
    builds: Sequence[Mapping[str, Any]]
    rates: Sequence[Mapping[str, float]]
    described: Mapping[str, Mapping[str, Any]]

    def best_rates(self) -> dict[str, float]:
        """The best that any round saw of each rate."""
        names = {name for rates in self.rates for name in rates}
        return {name: max(rates[name] for rates in self.rates) for name in names}

    def stages(self) -> list[str]:
        """Stages of our queries, in their order."""
        first = self.queries[0][DEFAULT]
        return list(dict.fromkeys(stage for answer in first for stage in answer["seconds"]))

    def stage(self, way: str, stage: str) -> Spread:
        """Seconds of one stage: the median query of each round."""
        return self._each_round(way, lambda answer: answer["seconds"].get(stage, np.nan), 50)

    def total(self, way: str, percent: float = 50) -> Spread:
        """Seconds of a whole query: the median query, or another percentile, of each round."""
        return self._each_round(way, lambda answer: answer["total"], percent)

    def keypoints(self, way: str) -> Spread:
        """Keypoints of the median query."""
        return self._each_round(way, lambda answer: answer["keypoints"], 50)

    def accuracy(self, way: str) -> dict[str, Spread]:
        """Figures of accuracy, of each round and so of each seed."""
        rounds = [[answer["error"] for answer in answers[way]] for answers in self.queries]
        return _accuracy(rounds)

    def peer_accuracy(self) -> dict[str, Spread]:
        """The same of the peer, which has no seed."""
        return _accuracy([entry["errors"] for entry in self.peer])

    def served(self, concurrency: int, *path: str) -> Spread:
        """One figure of the service's reports."""
        values = []
        for reports in self.service:
            figure: Any = reports[str(concurrency)]
            for name in path:
                figure = figure[name]
            values.append(float(figure))
        return Spread.of(values)

    def peer_stage(self, stage: str) -> Spread:
        """Seconds per query of the peer's matching or localization, less the process's start."""
        return Spread.of(_peer_stage(entry, stage) for entry in self.peer)

    def peer_total(self) -> Spread:
        """The peer's matching and localization, and our plain torch extraction, per query."""
        return Spread.of(
            _peer_stage(entry, "query_matches")
            + _peer_stage(entry, "localize")
            + _median(answers[TORCH], lambda answer: answer["seconds"]["local_features"])
            for entry, answers in zip(self.peer, self.queries, strict=False)
        )

    def ratios(self) -> dict[str, Spread]:
        """Peer / ours, in each round that has both."""
        rounds = list(zip(self.peer, self.queries, self.service, self.builds, strict=False))
        found: dict[str, list[float]] = {}
        for entry, answers, reports, built in rounds:
            matching = _peer_stage(entry, "query_matches")
            extraction = _median(answers[TORCH], lambda answer: answer["seconds"]["local_features"])
            whole = matching + _peer_stage(entry, "localize") + extraction
            own = answers[DEFAULT]
            latency = reports["1"]["latency_s"]["p50"]
            from_features = sum(landmark_seconds(built))
            for name, value in (
                ("whole query, ours in process", whole / _median(own, lambda a: a["total"])),
                ("whole query, ours over HTTP (p50)", whole / latency),
                ("matching alone", matching / _median(own, lambda a: a["seconds"]["matching"])),
                ("map building without extraction", peer_map_seconds(entry) / from_features),
            ):
                found.setdefault(name, []).append(value)
        return {name: Spread.of(values) for name, values in found.items()}

    def least_seconds(self, features_gflop: float | None) -> dict[str, dict[str, float]]:
        """By way, the least time that products need on this machine, of the stages made of them.

        Matching: every descriptor of the query with every one that the retrieved photos see.
        """
        rates, counts = self.best_rates(), self.builds[0]["counts"]
        seen = LocalizeOptions().top_k * counts["observations"] / counts["images"]
        least: dict[str, dict[str, float]] = {}
        for way, about in self.described.items():
            products = 2 * self.keypoints(way).median * seen * about["descriptor_dim"]
            # Without VNNI, products of floats are quicker than torch's of 8-bit numbers.
            best = max(rates["product_int8"], rates["product_fp32"])
            least[way] = {"matching": products / best}
            if features_gflop is not None:
                precision = "int8" if "int8" in about["computed_with"] else "fp32"
                work = about["megapixels"] * features_gflop * 1e9
                least[way]["local_features"] = work / rates[f"convolution_{precision}"]
        return least

    def _each_round(
        self, way: str, value: Callable[[Mapping[str, Any]], float], percent: float
    ) -> Spread:
        return Spread.of(_median(answers[way], value, percent) for answers in self.queries)


def peer_map_seconds(entry: Mapping[str, Any]) -> float:
    """Seconds of the peer's stages from features to a map, less the start of their processes.

    How long those take to start is not measured: what the slowest one takes, that of matching, is
    taken off each, in the peer's favour.
    """
    start = entry["result"]["process_start_s"]["query_matches"]
    stages = {k: v for k, v in entry["result"]["seconds"].items() if k.startswith("map_")}
    return float(sum(max(value - start, 0.0) for value in stages.values()))


def _peer_stage(entry: Mapping[str, Any], stage: str) -> float:
    return float(entry["result"]["per_query_s_less_process_start"][stage])


def _median(
    answers: Sequence[Mapping[str, Any]],
    value: Callable[[Mapping[str, Any]], float],
    percent: float = 50,
) -> float:
    values = [value(answer) for answer in answers]
    known = [v for v in values if np.isfinite(v)]
    return float(np.percentile(known, percent)) if known else np.nan


def _accuracy(rounds: Sequence[Sequence[Sequence[float] | None]]) -> dict[str, Spread]:
    localized = [[error for error in errors if error is not None] for errors in rounds]
    medians = [np.median(errors, axis=0) if errors else (np.nan, np.nan) for errors in localized]
    return {
        "localized": Spread.of(len(errors) for errors in localized),
        "5 cm, 5 deg": Spread.of(num_within(errors, 0.05, 5.0) for errors in rounds),
        "25 cm, 2 deg": Spread.of(num_within(errors, 0.25, 2.0) for errors in rounds),
        "median cm": Spread.of(metres * 100 for metres, _ in medians),
        "median deg": Spread.of(degrees for _, degrees in medians),
    }
