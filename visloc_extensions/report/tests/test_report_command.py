from __future__ import annotations

import base64
import json
import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mapping.cli import main as cli
from mapping.stages.work_folder import exclusive
from visloc.archive import Map, MapStore
from visloc.errors import Conflict, Unavailable
from visloc_extensions.report import command
from visloc_extensions.report.command import MAX_POINTS, summary_of_report, write_report

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run ``mapping report`` in this process; return exit status, stdout and stderr."""
    monkeypatch.delenv("VISLOC_MAPS_DIR", raising=False)

    def run_command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["mapping", "report", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            cli.main()
        out, err = capsys.readouterr()
        return int(left.value.code or 0), out, err

    return run_command


def _run(image: int, left_out: int, error: float | None) -> dict[str, Any]:
    return {
        "image": image,
        "left_out": left_out,
        "localized": error is not None,
        "position_error": error,
        "orientation_error_deg": None if error is None else 1.0,
    }


def _data(**changes: Any) -> dict[str, Any]:
    return {
        "map": {"id": "room", "version": "v1", "cameras": ["cam: PINHOLE"]},
        "up": {"direction": [0.0, 0.0, 1.0], "source": "gravity"},
        "images": [{"name": "a.jpg"}, {"name": "[b].jpg"}, {"name": "c.jpg"}],
        "held_out": [
            *(_run(0, 1, 0.01), _run(0, 5, None)),
            *(_run(1, 1, None), _run(1, 5, None)),
            *(_run(2, 1, 0.2), _run(2, 5, 0.3)),
        ],
        "look_alikes": [{"told": "photos around a.jpg look like those around [b].jpg"}],
        "look_alikes_asked": 6,
        "coverage": {
            "within": {"position": 0.05, "orientation_deg": 5.0},
            "cell": 0.3,
            "cells": [{"probability": [1.0, 0.9, 0.5, 0.05]}],
            "weak_spots": [
                {
                    "position": [1.0, 2.0, 0.5],
                    "direction_deg": 180,
                    "probability": 0.05,
                    "why": "few landmarks [there]",
                }
            ],
        },
    } | changes


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A report that is computed at once; holds how it was asked for."""
    asked: dict[str, Any] = {}

    def make(opened: object, work: object, **options: Any) -> dict[str, Any]:
        asked.update(options, opened=opened, work=work)
        options["progress"]("held-out runs", 3, 3)
        return _data()

    monkeypatch.setattr(command, "make_report_data", make)
    monkeypatch.setattr(command, "report_parts", lambda: ("script();", "body {}"))
    return asked


def test_the_file_carries_the_data_and_the_points(
    run: Run, computed: dict[str, Any], built_maps: Path, tmp_path: Path
) -> None:
    target = tmp_path / "new" / "room.html"
    status, _, err = run("room", "--maps-dir", built_maps, "--output", target, "--workers", 1)
    assert status == 0
    assert "held-out runs: 3/3" in err
    text = target.read_text("utf-8")
    data = json.loads(text.split('id="report">')[1].split("</script>")[0])
    points = base64.b64decode(data.pop("points"))
    assert data == _data()
    opened = MapStore(built_maps).open("room")
    magic, version, total, first, count = struct.unpack("<4s4I", points[:20])
    assert (magic, version, total, first) == (b"VLPT", 1, len(opened.landmarks), 0)
    assert count == min(total, MAX_POINTS)
    # Who gets the file need not know where its maker keeps things.
    assert computed["command"] == (
        f"mapping report room --maps-dir {built_maps.name} --output room.html --workers 1"
    )


@pytest.mark.usefixtures("computed")
def test_people_see_what_failed_where_it_is_weak_and_where_the_file_is(
    run: Run, built_maps: Path, tmp_path: Path
) -> None:
    target = tmp_path / "room.html"
    _, out, _ = run("room", "--maps-dir", built_maps, "--output", target, "--workers", 1)
    assert "photos localized without themselves, within 0.05 m and 5 degrees: 1 of 3" in out
    assert "not localized: [b].jpg\nnot localized: c.jpg\n" in out
    assert "90 % or more: 50 %; of less than 10 %: 25 %" in out
    assert "9 o'clock" in out
    assert "few landmarks [there]" in out
    assert "look-alikes: photos around a.jpg look like those around [b].jpg\n" in out
    assert out.endswith(f"report: {target}\n")


@pytest.mark.usefixtures("computed")
def test_programs_get_json(run: Run, built_maps: Path, tmp_path: Path) -> None:
    target = tmp_path / "room.html"
    _, out, _ = run("room", "--maps-dir", built_maps, "--output", target, "--json", "--workers", 1)
    assert json.loads(out) == summary_of_report(_data()) | {"output": str(target)}


@pytest.mark.usefixtures("computed")
def test_the_file_is_named_after_the_map_and_replaces_an_older_one(
    run: Run,
    built_maps: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room-report.html").write_text("old")
    status, _, _ = run("room", "--maps-dir", built_maps, "--workers", 1)
    assert status == 0
    assert (tmp_path / "room-report.html").read_text("utf-8").startswith("<!doctype html>")
    assert [path.name for path in tmp_path.iterdir()] == ["room-report.html"]


def test_a_folder_is_not_overwritten(
    run: Run, computed: dict[str, Any], built_maps: Path, tmp_path: Path
) -> None:
    status, out, err = run("room", "--maps-dir", built_maps, "--output", tmp_path)
    assert (status, out) == (1, "")
    assert err.startswith("error [report.output] --output: the path is a folder")
    assert computed == {}


@pytest.mark.parametrize("below", ["file/room.html", "file/new/room.html", f"{'x' * 300}.html"])
def test_an_output_that_cannot_be_written_is_told_before_the_long_work(
    below: str, run: Run, computed: dict[str, Any], built_maps: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    status, out, err = run("room", "--maps-dir", built_maps, "--output", tmp_path / below)
    assert (status, out, computed) == (1, "", {})
    assert err.startswith("error [report.output] --output: the report cannot be written there")
    assert "a file in a folder that can be written" in err


def test_a_folder_of_maps_that_cannot_be_written_is_told_before_the_long_work(
    run: Run, computed: dict[str, Any], maps_dir: Path, tmp_path: Path
) -> None:
    shutil.rmtree(maps_dir / ".report", ignore_errors=True)  # of other tests
    (maps_dir / ".report").touch()
    status, out, err = run("room", "--maps-dir", maps_dir, "--output", tmp_path / "room.html")
    assert (status, out, computed) == (1, "", {})
    assert err.startswith("error [report.work]")
    assert "a writable --maps-dir" in err
    assert [path.name for path in tmp_path.iterdir() if path != maps_dir] == []


def test_of_a_map_given_as_a_folder_the_work_is_beside_the_report(
    run: Run,
    computed: dict[str, Any],
    built_maps: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = MapStore(built_maps).folder("room")
    status, _, _ = run(folder, "--output", tmp_path / "out" / "room.html", "--workers=1")
    assert status == 0
    assert computed["work"].root == tmp_path / "out" / ".report" / "room"
    assert computed["command"] == f"mapping report {folder.name} --output room.html --workers=1"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.usefixtures("computed")
def test_people_are_told_when_up_is_a_guess(
    run: Run,
    built_maps: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = ("room", "--maps-dir", built_maps, "--output", tmp_path / "room.html")
    assert "--gravity" not in run(*asked)[1]
    guessed = _data(up={"direction": [0.0, 1.0, 0.0], "source": "cameras"})
    monkeypatch.setattr(command, "make_report_data", lambda *_, **__: guessed)
    out = run(*asked)[1]
    assert "straight down" in out
    assert "--gravity" in out


@pytest.mark.usefixtures("computed")
def test_no_look_alikes_and_none_that_can_be_tested_are_told_apart(
    run: Run, built_maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = ("room", "--maps-dir", built_maps, "--output", tmp_path / "room.html")
    for number, said in ((6, "none, of 6 photos asked"), (0, "not testable")):
        data = _data(look_alikes=[], look_alikes_asked=number)
        monkeypatch.setattr(command, "make_report_data", lambda *_, data=data, **__: data)
        assert f"look-alikes: {said}" in run(*asked)[1]


@pytest.mark.parametrize(
    ("cell", "shown"),
    [(0.3, "1.23, 0.04, 100.00"), (1e-4, "1.23400, 0.03600"), (50.0, "1, 0, 100")],
)
def test_places_are_shown_as_finely_as_the_map_is(
    cell: float,
    shown: str,
    run: Run,
    built_maps: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = _data()
    data["coverage"]["cell"] = cell
    data["coverage"]["weak_spots"][0]["position"] = [1.234, 0.036, 100.0]
    monkeypatch.setattr(command, "make_report_data", lambda *_, **__: data)
    _, out, _ = run("room", "--maps-dir", built_maps, "--output", tmp_path / "room.html")
    assert shown in out


def test_an_unbuilt_viewer_is_told_before_the_long_work(
    run: Run,
    computed: dict[str, Any],
    built_maps: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def absent() -> tuple[str, str]:
        raise Unavailable("page.not_built", "the files of the page are missing")

    monkeypatch.setattr(command, "report_parts", absent)
    status, _, err = run("room", "--maps-dir", built_maps, "--output", tmp_path / "room.html")
    assert (status, computed) == (1, {})
    assert err.startswith("error [page.not_built]")


@pytest.mark.usefixtures("computed")
def test_what_was_computed_stays_when_it_is_interrupted(
    run: Run,
    maps_dir: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(_: object, work: Any, **__: object) -> None:
        (work.root / "kept").touch()
        raise Unavailable("build.worker_died", "a worker died")

    with monkeypatch.context() as patch:
        patch.setattr(command, "make_report_data", interrupted)
        status, _, _ = run("room", "--maps-dir", maps_dir, "--output", tmp_path / "room.html")
    assert status == 1
    assert not (tmp_path / "room.html").exists()
    (kept,) = maps_dir.rglob("kept")
    status, _, _ = run("room", "--maps-dir", maps_dir, "--output", tmp_path / "room.html")
    assert status == 0
    assert not kept.parent.exists()
    assert MapStore(maps_dir).ids() == ["room"]


@pytest.mark.usefixtures("computed")
def test_two_reports_of_a_map_at_once_are_refused(run: Run, maps_dir: Path, tmp_path: Path) -> None:
    with exclusive(maps_dir / ".report" / "room.lock"):
        status, _, err = run("room", "--maps-dir", maps_dir, "--output", tmp_path / "room.html")
    assert status == 1
    assert err.startswith("error [report.running]")


def test_photos_count_by_the_run_that_left_out_the_fewest() -> None:
    summary = summary_of_report(_data())
    assert summary["held_out"] == 3
    assert summary["failed"] == ["[b].jpg", "c.jpg"]  # refused; too far off
    assert (summary["likely"], summary["unlikely"]) == (0.5, 0.25)


def test_a_map_of_one_photo_has_a_summary() -> None:
    within = {"position": 1.0, "orientation_deg": 5.0}
    empty = {"within": within, "cell": 0.3, "cells": [], "weak_spots": []}
    summary = summary_of_report(_data(held_out=[], coverage=empty))
    assert summary["held_out"] == 0
    assert summary["likely"] is None


def test_a_map_without_landmarks_is_refused(bare: Map, tmp_path: Path) -> None:
    with pytest.raises(Conflict) as caught:
        write_report(
            *(bare, tmp_path / "r.html", tmp_path), workers=1, command="", progress=lambda *_: None
        )
    assert caught.value.code == "map.no_landmarks"


def test_a_real_map_is_reported_on_with_numbers_that_hold_together(
    run: Run, built_maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "report_parts", lambda: ("script();", "body {}"))
    target = tmp_path / "room.html"
    status, out, err = run(
        *("room", "--maps-dir", built_maps, "--output", target, "--json", "--workers", 1)
    )
    assert status == 0, err
    summary = json.loads(out)
    data = json.loads(target.read_text("utf-8").split('id="report">')[1].split("</script>")[0])
    assert summary["held_out"] == len({run["image"] for run in data["held_out"]}) == 8
    assert 0 <= summary["likely"] + summary["unlikely"] <= 1
    directions = data["coverage"]["directions_deg"]
    assert all(len(cell["probability"]) == len(directions) for cell in data["coverage"]["cells"])
    assert {image["name"] for image in data["images"]} >= set(summary["failed"])
