from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clients.cli.main import main

Dataset = Callable[..., Path]


def batch(*arguments: object) -> int:
    """Run ``localize batch`` and return its exit code."""
    with pytest.raises(SystemExit) as caught:
        main(["batch", *map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


def lines_of(output: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (output / "results.jsonl").read_bytes().splitlines()]


def asked(service: Any) -> list[bytes]:
    return [request["image"] for request in service.seen]


@pytest.mark.parametrize("concurrency", [1, 4])
def test_a_dataset_gives_results_and_poses_in_its_order(
    url: str, concurrency: int, make_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    service.slow_s = 0.1
    names = [f"{i}.jpg" for i in range(8)]
    photos = dict.fromkeys(names, b"photo") | {"0.jpg": b"slow", "3.jpg": b"refuse"}
    output = tmp_path / "out" / "new"

    code = batch(
        *(make_dataset(photos), "--map", "room", "--output", output, "--server", url),
        *("--concurrency", concurrency, "--option", "top_k=5", "--seed", 3),
    )

    assert code == 0
    lines = lines_of(output)
    assert [line["name"] for line in lines] == names
    assert [line["status"] for line in lines].count("localized") == 7
    assert lines[3]["refusal"]["reason"] == "too_few_matches"
    poses = (output / "poses.txt").read_text().splitlines()
    assert [line.split()[0] for line in poses] == [n for n in names if n != "3.jpg"]
    assert all(len(line.split()) == 8 for line in poses)
    assert {request["map"] for request in service.seen} == {"room@v1"}
    assert service.seen[0]["options"] == {"top_k": 5, "seed": 3}
    assert service.seen[0]["camera"]["params"] == [60.0, 32.0, 24.0]


def test_a_list_is_localized_with_the_cameras_that_it_has(
    http_url: str, tmp_path: Path, service: Any
) -> None:
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / name).write_bytes(name.encode())
    photos = tmp_path / "photos.txt"
    photos.write_text("b.jpg SIMPLE_PINHOLE 64 48 60 32 24\na.jpg\n")
    output = tmp_path / "out"
    assert batch(photos, "--map", "room", "--output", output, "--server", http_url) == 0
    assert [line["name"] for line in lines_of(output)] == ["b.jpg", "a.jpg"]
    assert [request["camera"] is None for request in service.seen] == [False, True]


def test_a_bad_photo_fails_alone(
    url: str, make_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = {"a": b"photo", "b": b"broken", "c": b"crash", "d": b"x", "e": b"huge", "f": b"photo"}
    dataset = make_dataset(photos)
    (dataset / "sensors" / "records_data" / "d").unlink()
    output = tmp_path / "out"

    assert batch(dataset, "--map", "room", "--output", output, "--server", url) == 0

    lines = {line["name"]: line for line in lines_of(output)}
    assert [lines[name]["status"] for name in "abcdef"] == [
        *("localized", "error", "error", "error", "error", "localized")
    ]
    assert lines["b"]["error"]["code"] == "image.undecodable"
    assert lines["b"]["error"]["expected"] == "JPEG"
    assert lines["d"]["error"]["code"] == "image.unreadable"
    assert len((output / "poses.txt").read_text().splitlines()) == 2
    captured = capsys.readouterr()
    assert "2 of 6 localized, 0 not localized, 4 without an answer" in captured.out
    assert "image.undecodable" in captured.err


def test_a_photo_that_takes_too_long_fails_alone(
    http_url: str, make_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    service.slow_s = 4.0
    dataset = make_dataset({"a": b"slow", "b": b"photo"})
    output = tmp_path / "out"
    code = batch(
        dataset, "--map", "room", "--output", output, "--server", http_url, "--timeout", 1.5
    )
    assert code == 0
    assert [line["status"] for line in lines_of(output)] == ["error", "localized"]


def test_an_overloaded_server_is_asked_again(
    http_url: str, make_dataset: Dataset, tmp_path: Path
) -> None:
    output = tmp_path / "out"
    dataset = make_dataset({"a": b"busy"})
    assert batch(dataset, "--map", "room", "--output", output, "--server", http_url) == 0
    assert [line["status"] for line in lines_of(output)] == ["localized"]


def test_a_rerun_asks_only_for_what_is_missing(
    url: str, make_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    photos = {name: name.encode() for name in "abcd"}
    dataset, output = make_dataset(photos), tmp_path / "out"
    command = (dataset, "--map", "room", "--output", output, "--server", url)
    assert batch(*command) == 0
    results = (output / "results.jsonl").read_bytes()
    poses = (output / "poses.txt").read_bytes()
    # As a kill leaves it: two whole lines and a half.
    torn = results.splitlines(keepends=True)
    (output / "results.jsonl").write_bytes(torn[0] + torn[2] + torn[3][:100])
    (output / "poses.txt").unlink()
    service.seen.clear()

    assert batch(*command) == 0

    assert asked(service) == [b"b", b"d"]
    assert (output / "results.jsonl").read_bytes() == results
    assert (output / "poses.txt").read_bytes() == poses
    service.seen.clear()
    assert batch(*command) == 0
    assert asked(service) == []


def test_a_rerun_asks_again_where_the_server_failed_and_keeps_one_line_per_photo(
    url: str, make_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    names = ["a", "b", "c"]
    dataset = make_dataset(dict(zip(names, [b"photo", b"broken", b"crash"], strict=True)))
    output = tmp_path / "out"
    command = (dataset, "--map", "room", "--output", output, "--server", url)
    assert batch(*command) == 0
    service.seen.clear()

    assert batch(*command) == 0
    assert asked(service) == [b"crash"]
    assert [line["name"] for line in lines_of(output)] == names

    (dataset / "sensors" / "records_data" / "c").write_bytes(b"photo")
    assert batch(*command) == 0
    assert [line["status"] for line in lines_of(output)] == ["localized", "error", "localized"]
    assert len((output / "poses.txt").read_text().splitlines()) == 2
    service.seen.clear()
    assert batch(*command) == 0
    assert asked(service) == []


@pytest.mark.parametrize("kind", ["Unavailable", "Overloaded"])
def test_a_stored_error_of_an_unavailable_server_is_not_final(
    kind: str, http_url: str, make_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    output = tmp_path / "out"
    dataset = make_dataset({"a": b"photo"})
    command = (dataset, "--map", "room", "--output", output, "--server", http_url)
    assert batch(*command) == 0
    entry = {"name": "a", "status": "error", "error": {"kind": kind, "code": "x"}}
    (output / "results.jsonl").write_text(json.dumps(entry) + "\n")
    service.seen.clear()
    assert batch(*command) == 0
    assert asked(service) == [b"photo"]


@pytest.mark.parametrize("change", ["version", "option", "dataset", "run.json"])
def test_results_of_another_run_are_not_mixed(
    change: str,
    http_url: str,
    make_dataset: Dataset,
    tmp_path: Path,
    service: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:
    dataset, output = make_dataset({"a": b"photo"}), tmp_path / "out"
    command = [dataset, "--map", "room", "--output", output, "--server", http_url]
    assert batch(*command) == 0
    before = (output / "results.jsonl").read_bytes()
    match change:
        case "version":
            service.version = "v2"
        case "option":
            command += ["--seed", 4]
        case "dataset":
            command[0] = dataset.rename(tmp_path / "other")
        case "run.json":
            (output / "run.json").write_text("{")
    capsys.readouterr()

    assert batch(*command) == 1

    message = capsys.readouterr().err
    assert "batch.other_run" in message
    assert "--restart" in message
    assert "Traceback" not in message
    assert (output / "results.jsonl").read_bytes() == before
    assert batch(*command, "--restart") == 0
    assert batch(*command) == 0


def test_a_damaged_result_is_named_and_nothing_is_lost(
    http_url: str, make_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset, output = make_dataset({"a": b"photo", "b": b"photo"}), tmp_path / "out"
    command = (dataset, "--map", "room", "--output", output, "--server", http_url)
    assert batch(*command) == 0
    damaged = (output / "results.jsonl").read_bytes().replace(b'"status": "', b'"status": "un', 1)
    (output / "results.jsonl").write_bytes(damaged)
    assert batch(*command) == 1
    assert "results.jsonl:1" in capsys.readouterr().err
    assert (output / "results.jsonl").read_bytes() == damaged


@pytest.mark.parametrize(
    ("photos", "arguments", "code"),
    [
        ({"a": b"photo", "b": b"gone", "c": b"photo"}, (), "map.unknown"),
        ({"a": b"photo", "b": b"weights"}, (), "weights.missing"),
        ({"a": b"photo", "b": b"preset"}, (), "options.preset"),
        ({"a": b"photo"}, ("--map", "hall"), "map.unknown"),
        ({"a": b"photo"}, ("--option", "speed=9"), "request.unknown_field"),
        ({"a": b"photo"}, ("--option", "speed"), "options.syntax"),
        ({"a": b"photo"}, ("--option", "top_k=many"), "options.top_k"),
        ({"a": b"photo"}, ("--server", "http://127.0.0.1:1"), "server.unreachable"),
        ({}, (), "queries.empty"),
    ],
)
def test_what_makes_going_on_pointless_ends_the_run_in_one_line(
    photos: dict[str, bytes],
    arguments: tuple[str, ...],
    code: str,
    http_url: str,
    make_dataset: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    output = tmp_path / "out"
    command = ("--map", "room", "--output", output, "--server", http_url, *arguments)
    assert batch(make_dataset(photos), *command) == 1
    error = capsys.readouterr().err
    assert f"error [{code}]" in error
    assert "Traceback" not in error
    if len(photos) > 1:
        assert [line["name"] for line in lines_of(output)] == ["a"]


def test_an_output_that_cannot_be_made_is_one_line(
    http_url: str, make_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "file"
    output.touch()
    dataset = make_dataset({"a": b"photo"})
    assert batch(dataset, "--map", "room", "--output", output, "--server", http_url) == 1
    assert str(output) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_a_stopped_run_keeps_what_is_done_and_goes_on_later(
    number: int, code: int, url: str, make_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    photos = {name: name.encode() for name in "abcdef"} | {"d": b"slow"}
    dataset, output = make_dataset(photos), tmp_path / "out"
    service.slow_s = 120.0
    command = (dataset, "--map", "room", "--output", output, "--server", url, "--concurrency", 2)
    # A shell starts what it runs in the background with SIGINT ignored, tests perhaps too.
    heed_sigint = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    run = f"{heed_sigint}; from clients.cli.main import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", run, "batch", *map(str, command)],
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONFAULTHANDLER": ""},
    )
    results = output / "results.jsonl"
    deadline = time.monotonic() + 20
    while not (results.exists() and results.read_bytes().count(b"\n") == 5):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(number)
    _, error = process.communicate(timeout=60)  # the photo under way takes 120

    assert process.returncode == code
    assert b"Traceback" not in error
    assert sorted(line["name"] for line in lines_of(output)) == list("abcef")
    assert not (output / "poses.txt").exists()
    service.hurry.set()
    service.seen.clear()
    assert batch(*command) == 0
    assert asked(service) == [b"slow"]
    assert [line["name"] for line in lines_of(output)] == list("abcdef")
