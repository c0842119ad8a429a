"""The tables, in Markdown, as docs/performance.md has them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.speed.building import landmark_seconds
from benchmarks.speed.dataset import Bench
from benchmarks.speed.figures import Measured, Spread, peer_map_seconds
from benchmarks.speed.limits import NETWORKS, RATES
from benchmarks.speed.machine import Machine
from benchmarks.speed.queries import DEFAULT, WAYS
from benchmarks.speed.served import CONCURRENCIES

# The peer's stages beside ours of the same purpose.
_PEER_STAGE = {"matching": "query_matches", "pose": "localize"}
_EXTRACTION = "local_features"


def describe_machine(machine: Machine, loads: Sequence[float]) -> Iterator[str]:
    """What the figures were measured on."""
    flags = ", ".join(machine.flags) or "none that matter here"
    packages = ", ".join(f"{name} {version}" for name, version in machine.packages.items())
    load = Spread.of(loads)
    cuda = machine.cuda or "none"
    yield f"{machine.cpu}, {machine.threads} threads; {flags}. CUDA device: {cuda}."
    yield f"Python {machine.python}, {packages}."
    yield f"Load average before each measurement: {_text(load, 1)}."
    yield ""


def tables(bench: Bench, measured: Measured, no_peer: str | None) -> Iterator[str]:
    """All tables, ratios first. Figures are the median of the rounds, and their span."""
    counts = measured.builds[0]["counts"]
    yield (
        f"{bench.dataset.name}, `{bench.features}`: {bench.num_queries} queries on "
        f"{counts['images']} mapping photos, {counts['landmarks']} landmarks, "
        f"{counts['observations']} observations. {len(measured.queries)} rounds, one seed each; "
        "median of the rounds (smallest to largest)."
    )
    yield ""
    if no_peer is None:
        yield from table(["peer / ours", "ratio"], _ratio_rows(measured))
    else:
        yield f"Without the peer: {no_peer}."
        yield ""
    yield from _seconds(measured, with_peer=no_peer is None)
    yield from table(
        ["service, over HTTP", "p50 s", "p90 s", "queries per second"], _service_rows(measured)
    )
    yield from table(
        [
            "accuracy",
            "localized",
            "5 cm, 5 deg",
            "25 cm, 2 deg",
            "median cm",
            "median deg",
            "keypoints",
        ],
        _accuracy_rows(bench, measured, with_peer=no_peer is None),
    )
    yield from table(["building", "seconds"], _building_rows(measured))
    yield from _limits(bench, measured)


def _ratio_rows(measured: Measured) -> Iterator[list[str]]:
    for name, ratio in measured.ratios().items():
        yield [name, _text(ratio, 1)]


def _seconds(measured: Measured, *, with_peer: bool) -> Iterator[str]:
    peer = ["peer"] if with_peer else []
    rows = []
    for stage in measured.stages():
        row = [stage.replace("_", " ")]
        if with_peer and stage == _EXTRACTION:
            row.append(f"{number(measured.stage(WAYS[0].label, stage).median, 3)} (ours, torch)")
        elif with_peer:
            known = stage in _PEER_STAGE
            row.append(_text(measured.peer_stage(_PEER_STAGE[stage]), 3) if known else "")
        rows.append(row + [number(measured.stage(way.label, stage).median, 3) for way in WAYS])
    whole = [_text(measured.peer_total(), 2)] if with_peer else []
    rows.append(["**whole query**", *whole, *(_text(measured.total(w.label), 3) for w in WAYS)])
    slow = [""] if with_peer else []
    p90 = (_text(measured.total(way.label, 90), 3) for way in WAYS)
    rows.append(["its 90th percentile", *slow, *p90])
    yield from table(["s per query", *peer, *(way.label for way in WAYS)], rows)


def _service_rows(measured: Measured) -> Iterator[list[str]]:
    for concurrency in CONCURRENCIES:
        yield [
            f"concurrency {concurrency}",
            _text(measured.served(concurrency, "latency_s", "p50"), 3),
            _text(measured.served(concurrency, "latency_s", "p90"), 3),
            _text(measured.served(concurrency, "throughput_qps"), 2),
        ]


def _accuracy_rows(bench: Bench, measured: Measured, *, with_peer: bool) -> Iterator[list[str]]:
    rows = {way.label: measured.accuracy(way.label) for way in WAYS}
    if with_peer:
        rows = {"peer": measured.peer_accuracy(), **rows}
    for label, found in rows.items():
        keypoints = "the same features" if label == "peer" else _text(measured.keypoints(label), 0)
        yield [
            label,
            f"{_text(found['localized'], 0)} of {bench.num_queries}",
            _text(found["5 cm, 5 deg"], 0),
            _text(found["25 cm, 2 deg"], 0),
            _text(found["median cm"], 2),
            _text(found["median deg"], 3),
            keypoints,
        ]


def _building_rows(measured: Measured) -> Iterator[list[str]]:
    if measured.peer:
        yield [
            "peer: map from features, less the start of its processes",
            _text(Spread.of(peer_map_seconds(entry) for entry in measured.peer), 2),
        ]
    parts = [landmark_seconds(built) for built in measured.builds]
    yield ["ours: landmarks from features", _text(Spread.of(part for part, _ in parts), 2)]
    yield ["ours: archive, written and verified", _text(Spread.of(part for _, part in parts), 2)]
    whole = Spread.of(sum(built["seconds"].values()) for built in measured.builds)
    yield ["ours: everything, with extraction and global descriptors", _text(whole, 1)]
    built = measured.builds[0]
    per_observation = built["bytes"] / built["counts"]["observations"]
    yield ["bytes of map per observation, all files", number(per_observation, 1)]


def _limits(bench: Bench, measured: Measured) -> Iterator[str]:
    network = NETWORKS.get(bench.features)
    rates = measured.best_rates()
    rows = [
        [
            what + (f" ({network.layer})" if name.startswith("convolution") and network else ""),
            f"{number(rates[name] / 1e9, 0)} {'GB/s' if name == 'copy' else 'GOP/s'}",
        ]
        for name, what in RATES.items()
        if name in rates
    ]
    yield from table(["best rate of this machine", "measured"], rows)
    least = measured.least_seconds(None if network is None else network.gflop_per_megapixel)
    rows = []
    for way in WAYS:
        about = measured.described[way.label]
        for stage, seconds in least[way.label].items():
            spent = measured.stage(way.label, stage).median
            rows.append(
                [
                    way.label,
                    stage.replace("_", " ")
                    + (f" ({about['computed_with']})" if stage == _EXTRACTION else ""),
                    number(seconds, 3),
                    number(spent, 3),
                    f"{number(100 * seconds / spent, 0)} %",
                ]
            )
    yield from table(["limit", "stage", "least s", "measured s", "of the limit"], rows)
    if network is not None:
        work = measured.described[DEFAULT]["megapixels"] * network.gflop_per_megapixel
        yield (
            f"`{bench.features}` takes {network.gflop_per_megapixel:g} GFLOP per megapixel: "
            f"{work:.1f} GFLOP for a query of `default`. The least time of a stage is that of its "
            "products at the best rate above in the same precision."
        )
        yield ""


def table(head: Sequence[str], rows: Iterator[list[str]] | Sequence[list[str]]) -> Iterator[str]:
    """A table in Markdown, and an empty line."""
    yield f"| {' | '.join(head)} |"
    yield f"|{'---|' * len(head)}"
    for row in rows:
        yield f"| {' | '.join(row)} |"
    yield ""


def _text(spread: Spread, digits: int) -> str:
    median, low, high = (number(v, digits) for v in (spread.median, spread.low, spread.high))
    return median if low == high else f"{median} ({low} to {high})"


def number(value: float, digits: int) -> str:
    """A number with so many digits after the point, or a dash."""
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"
