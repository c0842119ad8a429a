from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from mapping import cli
from visloc.archive import MapStore, open_map

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command in this process; return exit status, stdout and stderr."""
    monkeypatch.delenv("VISLOC_MAPS_DIR", raising=False)
    monkeypatch.delenv("VISLOC_WEIGHTS_DIR", raising=False)

    def run_command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["mapping", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            cli.main()
        out, err = capsys.readouterr()
        return int(left.value.code or 0), out, err

    return run_command


def error_of(outcome: tuple[int, str, str]) -> str:
    """The only line of a command that failed."""
    status, out, err = outcome
    assert status == 1
    assert out == ""
    assert err.count("\n") == 1
    return err


def test_inspect_gives_json_for_programs(run: Run, built_maps: Path) -> None:
    status, out, err = run("inspect", "room", "--maps-dir", built_maps, "--json")
    assert (status, err) == (0, "")
    opened = MapStore(built_maps).open("room")
    summary = json.loads(out)
    assert summary["id"] == "room"
    assert summary["version"] == opened.manifest.version
    assert summary["counts"] == {
        "images": 8,
        "landmarks": len(opened.landmarks),
        "observations": len(opened.observation_landmarks),
    }
    assert summary["local_features"]["fingerprint"]["name"] == "sift"
    assert [g["fingerprint"]["name"] for g in summary["global_features"]] == [
        *("densevlad", "localvlad"),
    ]
    assert summary["size_bytes"] == opened.size_bytes
    assert summary["world"]["extent"]["min"] < summary["world"]["extent"]["max"]
    assert summary["method"]["name"] == "rgbd"


@pytest.mark.parametrize("by", ["id", "version", "folder"])
def test_inspect_shows_people_what_a_map_holds(run: Run, built_maps: Path, by: str) -> None:
    opened = MapStore(built_maps).open("room")
    ref = {"id": "room", "version": opened.ref, "folder": str(opened.path)}[by]
    status, out, err = run("inspect", ref, "--maps-dir", built_maps)
    assert (status, err) == (0, "")
    for shown in (
        *(opened.ref, "8 by 2 cameras", str(len(opened.landmarks)), "sift, 128 dimensions"),
        *(str(len(opened.observation_landmarks)), "densevlad", "localvlad", " m", "MiB"),
    ):
        assert shown in out


def test_the_folder_of_maps_can_come_from_the_environment(
    run: Run, built_maps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VISLOC_MAPS_DIR", str(built_maps))
    assert run("inspect", "room")[0] == 0


def test_verify_passes_a_map_as_published(run: Run, built_maps: Path) -> None:
    status, out, err = run("verify", "room", "--maps-dir", built_maps)
    assert (status, err) == (0, "")
    assert "15 files, every byte as published" in out
    assert "sift, densevlad, localvlad: the same features as here" in out


@pytest.mark.parametrize(
    "name", ["landmarks.npy", "observation_descriptors.npy", "images.json", "manifest.json"]
)
def test_verify_names_the_file_in_which_one_bit_was_flipped(
    run: Run, maps_dir: Path, name: str
) -> None:
    path = MapStore(maps_dir).folder("room") / name
    content = bytearray(path.read_bytes())
    # In the middle of a manifest may be the name of another file.
    at = content.index(b'"created": "') + 14 if name == "manifest.json" else len(content) // 2
    content[at] ^= 1
    path.write_bytes(content)
    error = error_of(run("verify", "room", "--maps-dir", maps_dir))
    assert error.startswith("error [map.")
    assert str(path) in error


def test_verify_tells_that_the_features_of_a_map_are_others(
    run: Run, maps_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dataclasses import replace

    from visloc.features.sift import SiftExtractor

    other = replace(SiftExtractor.fingerprint, revision=2)
    monkeypatch.setattr(SiftExtractor, "fingerprint", other)
    status, out, err = run("verify", "room", "--maps-dir", maps_dir)
    assert status == 1
    assert "every byte as published" in out
    assert "the same features" not in out
    assert "[map.features]" in err
    assert "expected revision 1, got revision 2" in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("inspect", "kitchen"), "[map.unknown] map: no such map (expected one of: room, got"),
        (("inspect", "room@v9"), "[map.version] map: map 'room' has no such version"),
        (("verify", "../room"), "[map.id] map: not a map name"),
        (("build", "nowhere", "--map", "new"), "[kapture.no_dataset] sensors/sensors.txt: nowhere"),
        (("build", "nowhere", "--map", "room"), "[map.exists] --map: map 'room' exists"),
        (
            ("build", "nowhere", "--map", "new", "--local-features", "surf"),
            "[features.unknown] local_features: unknown feature (expected one of faster2d2, r2d2,",
        ),
        (
            ("build", "nowhere", "--map", "new", "--local-features", "r2d2"),
            "[weights.missing] weights_dir: the weights of R2D2 are not part of this software: "
            "download r2d2_WASF_N16.pt",
        ),
        (("export-features", "nowhere", "--output", "out"), "[kapture.no_dataset]"),
    ],
)
def test_an_error_is_one_line_with_its_code(
    run: Run,
    built_maps: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VISLOC_MAPS_DIR", str(built_maps))
    assert f"error {said}" in error_of(run(*arguments))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--size", "640"), "[sample.size] --size: not a size (expected WxH"),
        (("--size", "8x8"), "[sample.size] --size: cannot make photos of this size"),
        (("--images", "1"), "[sample.images] --images"),
        (("--seed", "-1"), "[sample.seed] --seed"),
    ],
)
def test_sample_refuses_what_it_cannot_make(
    run: Run, tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    assert f"error {said}" in error_of(run("sample", tmp_path / "sample", *arguments))
    assert not list(tmp_path.iterdir())


def test_sample_does_not_touch_a_folder_that_holds_something(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    error = error_of(run("sample", tmp_path))
    assert f"error [sample.exists] {tmp_path}" in error
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_what_the_system_refuses_is_one_line_too(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    target = tmp_path / "file" / "sample"
    error = error_of(run("sample", target, "--images", "2", "--size", "64x48"))
    assert error.startswith("error [system] ")
    assert "Not a directory" in error


@pytest.mark.parametrize("command", ["", "build", "inspect", "verify", "export-features", "sample"])
def test_every_command_has_help(run: Run, command: str) -> None:
    status, out, err = run(*command.split(), "--help")
    assert (status, err) == (0, "")
    assert f"mapping {command}".strip() in out  # whatever started the tests comes before it


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("build",), "Missing"),
        (("inspect",), "Missing argument 'MAP'"),
        (("raze", "room"), "No such command 'raze'"),
        (("inspect", "room", "--yaml"), "No such option"),
        (
            ("build", "dataset", "--map", "m", "--max-keypoints", "many"),
            "'--max-keypoints'",
        ),
        (
            ("build", "dataset", "--map", "m", "--max-keypoints", "0"),
            "'--max-keypoints'",
        ),
    ],
)
def test_wrong_usage_exits_with_2(run: Run, arguments: tuple[str, ...], said: str) -> None:
    status, out, err = run(*arguments)
    assert (status, out) == (2, "")
    assert said in err


def test_build_shows_each_stage_and_what_was_made(run: Run, sample: Path, tmp_path: Path) -> None:
    status, out, err = run(
        *("build", sample / "mapping", "--map", "room", "--maps-dir", tmp_path),
        *("--local-features", "sift", "--global-features", "localvlad"),
    )
    assert status == 0
    stages = [re.fullmatch(r"([a-z ]+): (\d+)/\2 in [\d.]+ s", line) for line in err.splitlines()]
    assert [stage and stage[1] for stage in stages] == [
        *("photos", "local features", "localvlad words", "localvlad", "depth", "landmarks"),
        "archive",
    ]
    opened = open_map(MapStore(tmp_path).folder("room"))
    assert opened.ref in out
    assert "peak memory" in out
    assert list(opened.global_descriptors) == ["localvlad"]


def test_ctrl_c_ends_a_build_with_130_and_says_that_it_resumes(
    sample: Path, tmp_path: Path
) -> None:
    # A shell starts what it runs in the background with SIGINT ignored, tests perhaps too.
    heed_sigint = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    run = f"{heed_sigint}; from mapping.cli import main; main()"
    command = [sys.executable, "-c", run, "build", str(sample / "mapping")]
    process = subprocess.Popen(
        [*command, "--map=room", f"--maps-dir={tmp_path}", "--local-features=sift"],
        stderr=subprocess.PIPE,
        text=True,
        env={name: value for name, value in os.environ.items() if "VISLOC" not in name},
    )
    with process:
        assert process.stderr is not None
        first = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert first.startswith("photos: 8/8")
    assert process.returncode == 130
    assert rest.splitlines()[-1] == "stopped; the same command resumes where it was"
    assert "Traceback" not in rest
    assert MapStore(tmp_path).ids() == []
