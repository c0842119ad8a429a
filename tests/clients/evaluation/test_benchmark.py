from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients.cli.main import main
from clients.evaluation.benchmark import parse_threshold
from visloc.errors import InvalidInput
from visloc.evaluation import Threshold

Dataset = Callable[..., Path]
TRUTH_WXYZ = [0.9298410554097046, 0.01755162593, 0.31931803130557, 0.1819987554486438]
TRUTH_TRANSLATION = [0.24164110554685916, 0.0, 1e-17]


def benchmark(*arguments: object) -> int:
    """Run ``localize benchmark`` and return its exit code."""
    with pytest.raises(SystemExit) as caught:
        main(["benchmark", *map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


def off_by(metres: float) -> bytes:
    """A photo that the canned service localizes this far from the truth, straight ahead."""
    return json.dumps(
        {
            "rotation_wxyz": TRUTH_WXYZ,
            "translation": (np.array(TRUTH_TRANSLATION) - [0.0, 0.0, metres]).tolist(),
        }
    ).encode()


@pytest.mark.parametrize("concurrency", [1, 3])
def test_the_report_holds_what_was_measured(
    url: str, concurrency: int, make_dataset: Dataset, tmp_path: Path
) -> None:
    errors_m = [0.01, 0.04, 0.2, 0.3]
    photos = {f"{i}.jpg": off_by(metres) for i, metres in enumerate(errors_m)}
    photos |= {"lost.jpg": b"refuse", "bad.jpg": b"broken"}
    report = tmp_path / "report.json"

    code = benchmark(
        *(make_dataset(photos), "--map", "room", "--report", report, "--server", url),
        *("--concurrency", concurrency),
    )

    assert code == 0
    figures = json.loads(report.read_bytes())
    assert list(figures) == [
        "queries",
        "localized",
        "median_position_error_m",
        "median_orientation_error_deg",
        "recall",
        "latency_s",
        "throughput_qps",
        "stage_seconds",
        "server",
        "modes",
    ]
    assert list(figures["modes"]) == ["single"]
    assert figures["queries"] == 6
    assert figures["localized"] == 4
    assert figures["median_position_error_m"] == pytest.approx(0.12)
    assert figures["median_orientation_error_deg"] == pytest.approx(0.0, abs=1e-6)
    rows = [tuple(row.values()) for row in figures["recall"]]
    assert rows == [
        (0.05, 5.0, pytest.approx(2 / 6)),
        (0.25, 2.0, pytest.approx(3 / 6)),
        (0.5, 5.0, pytest.approx(4 / 6)),
        (5.0, 10.0, pytest.approx(4 / 6)),
    ]
    assert list(figures["recall"][0]) == [
        *("max_position_error_m", "max_orientation_error_deg", "fraction")
    ]
    single = figures["modes"]["single"]
    assert single["uncertainty"] == "whole"
    assert single["probability"] == dict.fromkeys(("p50", "p10", "min"), pytest.approx(1 / 3))
    latency = figures["latency_s"]
    assert 0 < latency["p50"] <= latency["p90"] <= latency["p99"] < 5
    assert figures["throughput_qps"] > 0
    # Five answers: four with 0.25 s of features and a refusal with 0.75 s.
    assert figures["stage_seconds"] == {"features": pytest.approx(0.35), "pose": 0.0}
    assert figures["server"] == {
        "version": "1.2.3",
        "map": "room@v1",
        "features": {"local": "xfeat", "global": ["densevlad", "localvlad"]},
    }


def test_without_true_poses_accuracy_is_null(
    http_url: str, make_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    dataset = make_dataset({"a": b"photo"}, truth=False)
    assert benchmark(dataset, "--map", "room", "--report", report, "--server", http_url) == 0
    figures = json.loads(report.read_bytes())
    assert figures["localized"] == 1
    assert figures["recall"] is None
    assert figures["median_position_error_m"] is None
    assert figures["median_orientation_error_deg"] is None
    assert "no ground truth" in capsys.readouterr().out


def test_without_any_answer_nothing_is_made_up(
    http_url: str, make_dataset: Dataset, tmp_path: Path
) -> None:
    report = tmp_path / "report.json"
    dataset = make_dataset({"a": b"broken"})
    assert benchmark(dataset, "--map", "room", "--report", report, "--server", http_url) == 0
    figures = json.loads(report.read_bytes())
    assert figures["queries"] == 1
    assert figures["localized"] == 0
    assert figures["latency_s"] == {"p50": None, "p90": None, "p99": None}
    assert [row["fraction"] for row in figures["recall"]] == [0.0] * 4
    assert figures["median_position_error_m"] is None
    assert figures["throughput_qps"] == 0.0
    assert figures["stage_seconds"] == {}
    single = figures["modes"]["single"]
    assert (single["uncertainty"], single["probability"]) == (None, None)


def test_both_transports_write_the_same_poses(
    http_url: str, grpc_url: str, make_dataset: Dataset, tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    photos = {
        f"{i}.jpg": json.dumps(
            {
                "rotation_wxyz": rng.normal(size=4).tolist(),
                "translation": rng.normal(size=3).tolist(),
            }
        ).encode()
        for i in range(10)
    }
    dataset = make_dataset(photos)
    for name, url in (("http", http_url), ("grpc", grpc_url)):
        code = benchmark(
            *(dataset, "--map", "room", "--report", tmp_path / "r.json", "--server", url),
            *("--poses", tmp_path / f"{name}.txt", "--concurrency", 4, "--seed", 1),
        )
        assert code == 0
    poses = (tmp_path / "http.txt").read_bytes()
    assert poses == (tmp_path / "grpc.txt").read_bytes()
    assert [line.split()[0] for line in poses.decode().splitlines()] == list(photos)


def test_thresholds_can_be_chosen(http_url: str, make_dataset: Dataset, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    code = benchmark(
        *(make_dataset({"a": off_by(0.5)}), "--map", "room", "--report", report),
        *("--server", http_url, "--threshold", "0.4/1", "--threshold", "0.6/1"),
    )
    assert code == 0
    assert [row["fraction"] for row in json.loads(report.read_bytes())["recall"]] == [0.0, 1.0]


def test_a_threshold_is_metres_and_degrees() -> None:
    assert parse_threshold("0.25/2") == Threshold(0.25, 2.0)
    assert parse_threshold("0/0") == Threshold(0.0, 0.0)


@pytest.mark.parametrize(
    "text", ["", "1", "1/2/3", "1,2", "a/b", "nan/1", "1/nan", "-1/2", "inf/5", "1/-0.1"]
)
def test_a_bad_threshold_is_refused_before_anything_runs(
    text: str, http_url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InvalidInput):
        parse_threshold(text)
    report = tmp_path / "report.json"
    code = benchmark(
        *(tmp_path, "--map", "room", "--report", report, "--server", http_url),
        f"--threshold={text}",
    )
    assert code == 1
    assert "evaluation.threshold" in capsys.readouterr().err


def test_a_report_that_cannot_be_written_is_found_before_anything_runs(
    http_url: str, make_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    report = tmp_path / "none" / "report.json"
    dataset = make_dataset({"a": b"photo"})
    assert benchmark(dataset, "--map", "room", "--report", report, "--server", http_url) == 1
    assert service.seen == []
