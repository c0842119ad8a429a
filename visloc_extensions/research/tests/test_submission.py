from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from clients.cli.main import main
from visloc.errors import DatasetError
from visloc_extensions.research.evaluation.pose_files import read_poses
from visloc_extensions.research.evaluation.submission import Benchmark, make_submission

HERE = {"rotation_wxyz": [1.0, 0.0, 0.0, 0.0], "translation": [1.0, 2.0, 3.0]}
# The canned service retrieves seq/1.jpg first.
MAPPING = "seq/1.jpg 0.5 0.5 0.5 0.5 7 8 9\nseq/2.jpg 1 0 0 0 0 0 0\n"


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([*map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


@pytest.fixture
def results(http_url: str, make_dataset: Callable[..., Path], tmp_path: Path) -> Path:
    photos = {
        "night/rear/1.jpg": json.dumps(HERE).encode(),
        "night/rear/2.jpg": b"refuse",
        "night/left/3.jpg": b"broken",
    }
    output = tmp_path / "results"
    dataset = make_dataset(photos)
    assert run("batch", dataset, "--map", "room", "--output", output, "--server", http_url) == 0
    return output


@pytest.mark.parametrize(
    ("benchmark", "names"),
    [
        ("aachen", ["1.jpg", "2.jpg"]),
        ("cmu", ["1.jpg", "2.jpg"]),
        ("robotcar", ["rear/1.jpg", "rear/2.jpg"]),
    ],
)
def test_names_are_the_benchmarks_and_refused_photos_are_filled_and_counted(
    results: Path,
    tmp_path: Path,
    benchmark: str,
    names: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    mapping, output = tmp_path / "mapping.txt", tmp_path / "submission.txt"
    mapping.write_text(MAPPING)

    asked = ["--set", benchmark, "--mapping", mapping, "--output", output]
    assert run("submit", results, *asked) == 0

    lines = [line.split() for line in output.read_text().splitlines()]
    assert [line[0] for line in lines] == names
    assert [float(number) for number in lines[0][1:]] == [1, 0, 0, 0, 1, 2, 3]
    assert [float(number) for number in lines[1][1:]] == [0.5, 0.5, 0.5, 0.5, 7, 8, 9]
    assert (
        "3 photos: 1 localized, 0 filled from other photos, 1 filled from the first retrieved "
        "photo, 1 without a pose" in capsys.readouterr().out
    )


def test_without_mapping_poses_nothing_is_filled(results: Path) -> None:
    made = make_submission(results, Benchmark.INLOC, {})
    assert list(made.poses) == ["1.jpg"]
    assert made.counts == {"localized": 1, "missing": 2}


@pytest.mark.parametrize(
    ("lines", "benchmark", "code"),
    [
        ([], "aachen", "submission.results"),
        (["a/1.jpg", "b/1.jpg"], "aachen", "submission.names"),
        (["1.jpg"], "robotcar", "submission.camera"),
        (["a/1.jpg"], "robotcar", "submission.mapping"),
    ],
)
def test_what_cannot_be_submitted_is_refused(
    tmp_path: Path, lines: list[str], benchmark: str, code: str, results: Path
) -> None:
    refused = [
        json.loads(line)
        for line in (results / "results.jsonl").read_text().splitlines()
        if json.loads(line)["status"] == "not_localized"
    ]
    path = tmp_path / "results.jsonl"
    path.write_text("".join(json.dumps(refused[0] | {"name": name}) + "\n" for name in lines))
    mapping = tmp_path / "mapping.txt"
    mapping.write_text("other.jpg 1 0 0 0 0 0 0\n" if code.endswith("mapping") else MAPPING)
    with pytest.raises(DatasetError) as caught:
        make_submission(path, Benchmark(benchmark), read_poses(mapping))
    assert caught.value.code == code
