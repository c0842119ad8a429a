from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.speed.figures import Measured, Spread
from benchmarks.speed.limits import NETWORKS, megapixels
from benchmarks.speed.queries import DEFAULT, TORCH, WAYS
from benchmarks.speed.steps import Steps


def _answer(seconds: float, error: tuple[float, float] | None) -> dict[str, object]:
    stages = {"local_features": seconds / 2, "matching": seconds / 4}
    return {"total": seconds, "seconds": stages, "keypoints": 1000, "error": error}


def _round(ours_s: float, torch_s: float) -> dict[str, list[dict[str, object]]]:
    good, bad = (0.01, 0.5), (0.3, 3.0)
    return {
        way.label: [
            _answer(torch_s if way.label == TORCH else ours_s, error) for error in (good, bad, None)
        ]
        for way in WAYS
    }


def _peer_round(matching_s: float) -> dict[str, object]:
    per_query = {"query_matches": matching_s, "localize": 0.1}
    seconds = {"map_from_depth": 6.0, "query_matches": 99.0}
    starts = {"query_matches": 1.0, "localize": 0.5}
    result = {
        "per_query_s_less_process_start": per_query,
        "seconds": seconds,
        "process_start_s": starts,
    }
    return {"result": result, "errors": [(0.02, 1.0), None, None]}


@pytest.fixture
def measured() -> Measured:
    latency = {"1": {"latency_s": {"p50": 0.5}}}
    built = {
        "seconds": {"local features": 50.0, "depth": 0.5, "landmarks": 0.25, "archive": 0.25},
        "counts": {"observations": 2000, "images": 10},
    }
    rates = {
        "product_fp32": 5e8,
        "product_int8": 1e9,
        "convolution_fp32": 1e11,
        "convolution_int8": 4e11,
    }
    about = {"descriptor_dim": 128, "megapixels": 1.0}
    described = {
        way.label: {**about, "computed_with": "fp32" if way.label == TORCH else "int8"}
        for way in WAYS
    }
    return Measured(
        queries=[_round(0.4, 4.0), _round(0.8, 4.0), _round(0.4, 4.0)],
        service=[latency] * 3,
        peer=[_peer_round(1.9), _peer_round(3.9)],
        builds=[built] * 2,
        rates=[rates, {name: rate / 2 for name, rate in rates.items()}],
        described=described,
    )


def test_ratios_are_those_of_rounds_that_have_both(measured: Measured) -> None:
    ratios = measured.ratios()

    # (1.9 + 0.1 + 2.0) / 0.4 and (3.9 + 0.1 + 2.0) / 0.8
    whole = ratios["whole query, ours in process"]
    assert (whole.low, whole.median, whole.high) == pytest.approx((7.5, 8.75, 10.0))
    assert ratios["matching alone"].high == pytest.approx(19.5)
    assert ratios["map building without extraction"].median == pytest.approx(
        5.0
    )  # a second is the start


def test_accuracy_counts_each_round_and_leaves_failures_out_of_medians(measured: Measured) -> None:
    accuracy = measured.accuracy(DEFAULT)

    assert accuracy["localized"] == Spread(2, 2, 2)
    assert accuracy["5 cm, 5 deg"] == Spread(1, 1, 1)
    assert accuracy["median cm"].median == pytest.approx(15.5)
    assert measured.peer_accuracy()["localized"] == Spread(1, 1, 1)


def test_the_least_time_is_that_of_the_products_at_the_best_rate(measured: Measured) -> None:
    least = measured.least_seconds(features_gflop=200.0)

    # 1000 keypoints with 20 x 200 descriptors of 128 numbers
    assert least[DEFAULT]["matching"] == pytest.approx(2 * 1000 * 4000 * 128 / 1e9)
    assert least[DEFAULT]["local_features"] == pytest.approx(0.5)
    assert least[TORCH]["local_features"] == pytest.approx(2.0)


def test_six_levels_have_three_times_the_pixels_of_the_photo() -> None:
    scales = np.repeat(32 / 2 ** (-np.arange(6) / 4), 7).astype(np.float32)

    pixels = megapixels(NETWORKS["faster2d2"], 640, 480, scales)

    assert pixels == pytest.approx(0.3072 * (1 - 2**-3) / (1 - 2**-0.5), rel=1e-3)


def _counter() -> Callable[[], int]:
    calls: list[int] = []

    def measure() -> int:
        calls.append(1)
        return len(calls)

    return measure


def test_a_resumed_run_measures_only_what_is_missing(tmp_path: Path) -> None:
    measure = _counter()
    Steps(tmp_path, {"queries": 3}, resume=False).get("a", measure)

    again = Steps(tmp_path, {"queries": 3}, resume=True)

    assert (again.get("a", measure), again.get("b", measure)) == (1, 2)
    assert len(again.load_averages()) == 2
    assert Steps(tmp_path, {"queries": 3}, resume=False).get("a", measure) == 3


def test_a_run_with_other_settings_is_not_resumed(tmp_path: Path) -> None:
    Steps(tmp_path, {"queries": 3}, resume=False)

    with pytest.raises(ValueError, match="other settings"):
        Steps(tmp_path, {"queries": 4}, resume=True)
