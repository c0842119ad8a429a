"""The commands as a user types them: build, serve, localize, over both doors."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import httpx
import numpy as np
import pytest

from clients import Client
from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose

READY = re.compile(r"ready: (http://127\.0\.0\.1:\d+) (grpc://127\.0\.0\.1:\d+), maps: (.*)")
ENVIRONMENT = {name: value for name, value in os.environ.items() if "VISLOC" not in name}
DOORS = ("http", "grpc")


class Query(Protocol):
    path: Path
    image: bytes
    camera: Camera
    cam_from_world: Pose


@dataclass(frozen=True)
class Service:
    """A service of its own process."""

    process: subprocess.Popen[bytes]
    http: str
    grpc: str
    log: Path

    def door(self, name: str) -> str:
        return {"http": self.http, "grpc": self.grpc}[name]


@contextmanager
def serving(maps_dir: Path, log: Path) -> Iterator[Service]:
    with log.open("wb") as stderr:
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "service", "--maps-dir", str(maps_dir)),
                *("--http-port=0", "--grpc-port=0", "--workers=1", "--threads-per-worker=1"),
            ],
            stderr=stderr,
            env=ENVIRONMENT,
        )
    with process:
        try:
            deadline = time.monotonic() + 60
            while (ready := READY.search(log.read_text())) is None:
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < deadline, log.read_text()
                time.sleep(0.05)
            yield Service(process, ready[1], ready[2], log)
        finally:
            process.kill()


@pytest.fixture(scope="module")
def service(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The service with the map ``room``."""
    with serving(built_maps, tmp_path_factory.mktemp("service") / "log") as service:
        yield service


def localize(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the ``localize`` command."""
    return subprocess.run(
        [sys.executable, "-m", "clients", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=ENVIRONMENT,
    )


def benchmark(
    service: Service, sample: Path, folder: Path, door: str, *more: object
) -> tuple[dict[str, Any], bytes, str]:
    """Return the report, the poses and what was printed."""
    report, poses = folder / f"{door}.json", folder / f"{door}.txt"
    done = localize(
        *("benchmark", sample / "query", "--map", "room", "--server", service.door(door)),
        *("--report", report, "--poses", poses, *more),
    )
    assert done.returncode == 0, done.stderr
    return json.loads(report.read_text()), poses.read_bytes(), done.stdout


def read_poses(text: str) -> dict[str, Pose]:
    poses = {}
    for line in text.splitlines():
        name, *fields = line.split()
        numbers = [float(field) for field in fields]
        poses[name] = Pose.from_quaternion(numbers[:4], numbers[4:])
    return poses


def test_both_doors_give_the_same_poses_byte_for_byte_and_the_right_ones(
    service: Service, sample: Path, queries: list[Query], tmp_path: Path
) -> None:
    _, over_http, _ = benchmark(service, sample, tmp_path, "http", "--seed", 5)
    _, over_grpc, _ = benchmark(service, sample, tmp_path, "grpc", "--seed", 5, "--concurrency", 3)
    assert over_http == over_grpc
    found = read_poses(over_http.decode())
    assert len(found) == len(queries) == 3
    for query in queries:
        name = query.path.relative_to(sample / "query" / "sensors" / "records_data").as_posix()
        position_m, orientation_deg = pose_error(found[name], query.cam_from_world)
        assert position_m < 0.003
        assert orientation_deg < 0.1


def test_the_report_holds_what_it_promises(service: Service, sample: Path, tmp_path: Path) -> None:
    report, _, printed = benchmark(service, sample, tmp_path, "http")
    assert set(report) == {
        *("queries", "localized", "median_position_error_m", "median_orientation_error_deg"),
        *("recall", "latency_s", "throughput_qps", "stage_seconds", "server", "modes"),
    }
    assert list(report["modes"]) == ["single"]
    assert report["queries"] == report["localized"] == 3
    assert 0 < report["median_position_error_m"] < 0.003
    assert 0 < report["median_orientation_error_deg"] < 0.1
    assert report["recall"] == [
        {
            "max_position_error_m": position_m,
            "max_orientation_error_deg": orientation_deg,
            "fraction": 1.0,
        }
        for position_m, orientation_deg in ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
    ]
    assert set(report["latency_s"]) == {"p50", "p90", "p99"}
    assert 0 < report["latency_s"]["p50"] <= report["latency_s"]["p90"]
    assert report["latency_s"]["p90"] <= report["latency_s"]["p99"]
    assert report["throughput_qps"] > 0
    assert set(report["stage_seconds"]) == {
        *("queued", "open_map", "decode", "local_features", "global_features"),
        *("retrieval", "matching", "pose"),
    }
    with Client(service.http) as client:
        assert report["server"] == {
            "version": client.server_info().version,
            "map": client.map("room").ref,
            "features": {"local": "sift", "global": ["densevlad", "localvlad"]},
        }
    for shown in ("3 of 3 localized", "100.0%", "latency p50", "answers per second"):
        assert shown in printed


def test_thresholds_of_the_table_can_be_chosen(
    service: Service, sample: Path, tmp_path: Path
) -> None:
    report, _, _ = benchmark(
        *(service, sample, tmp_path, "http", "--threshold", "0.00001/5", "--threshold", "1/2")
    )
    assert [row["fraction"] for row in report["recall"]] == [0.0, 1.0]


@pytest.mark.parametrize("door", DOORS)
def test_a_batch_is_taken_up_where_it_was(
    service: Service, sample: Path, tmp_path: Path, door: str
) -> None:
    output = tmp_path / "batch"
    command = [
        *("batch", sample / "query", "--map", "room", "--output", output),
        *("--server", service.door(door)),
    ]
    first = localize(*command)
    assert (first.returncode, first.stdout) == (
        0,
        "3 of 3 localized, 0 not localized, 0 without an answer\n",
    )
    poses = (output / "poses.txt").read_bytes()
    _, expected, _ = benchmark(service, sample, tmp_path, "http")
    assert poses == expected
    lines = (output / "results.jsonl").read_text().splitlines(keepends=True)
    assert [json.loads(line)["status"] for line in lines] == ["localized"] * 3

    # As a kill leaves it: one line whole, one torn, the poses not written yet.
    (output / "results.jsonl").write_text(lines[0] + lines[1][:50])
    (output / "poses.txt").unlink()
    again = localize(*command)
    assert again.returncode == 0
    assert "1 of 3 are done already" in again.stderr
    assert (output / "poses.txt").read_bytes() == poses
    kept, *redone = (output / "results.jsonl").read_text().splitlines(keepends=True)
    assert kept == lines[0]
    assert [json.loads(line)["name"] for line in redone] == [
        json.loads(line)["name"] for line in lines[1:]
    ]


def test_a_batch_goes_on_past_photos_of_another_place_and_broken_ones(
    service: Service, query: Query, photos_of_another_room: list[Path], tmp_path: Path
) -> None:
    shutil.copy(query.path, tmp_path / "here.jpg")
    shutil.copy(photos_of_another_room[0], tmp_path / "elsewhere.jpg")
    (tmp_path / "broken.jpg").write_bytes(query.image[:1000])
    camera = query.camera
    words = " ".join(map(str, (camera.model, camera.width, camera.height, *camera.params)))
    (tmp_path / "list.txt").write_text(
        f"# photos\nelsewhere.jpg {words}\nbroken.jpg\nhere.jpg {words}\n"
    )
    done = localize(
        *("batch", tmp_path / "list.txt", "--map", "room", "--output", tmp_path / "out"),
        *("--server", service.http),
    )
    assert done.returncode == 0
    assert "1 of 3 localized, 1 not localized, 1 without an answer" in done.stdout
    elsewhere, broken, here = (
        json.loads(line) for line in (tmp_path / "out" / "results.jsonl").read_text().splitlines()
    )
    assert (elsewhere["name"], elsewhere["status"], elsewhere["pose"]) == (
        *("elsewhere.jpg", "not_localized"),
        None,
    )
    assert elsewhere["refusal"]["stage"] == "gate"
    assert elsewhere["refusal"]["reason"] == "too_few_inliers"
    assert (broken["status"], broken["error"]["code"]) == ("error", "image.undecodable")
    assert here["status"] == "localized"
    assert list(read_poses((tmp_path / "out" / "poses.txt").read_text())) == ["here.jpg"]


@pytest.mark.parametrize("door", DOORS)
def test_one_photo_by_hand(service: Service, query: Query, door: str) -> None:
    camera = query.camera
    words = ",".join(map(str, (camera.model, camera.width, camera.height, *camera.params)))
    command = ["image", query.path, "--map", "room", "--server", service.door(door)]

    shown = localize(*command, "--camera", words)
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.startswith("localized")
    assert "std" in shown.stdout
    assert "as given" in shown.stdout

    for_programs = localize(*command, "--camera", words, "--json")
    answer = json.loads(for_programs.stdout)
    assert answer["status"] == "localized"
    assert answer["refusal"] is None
    assert answer["camera"]["source"] == "given"
    position = np.array(answer["pose"]["position"])
    assert np.linalg.norm(position - query.cam_from_world.center) < 0.003


@pytest.mark.parametrize("door", DOORS)
def test_a_photo_of_another_place_exits_with_3_and_has_no_pose(
    service: Service, photos_of_another_room: list[Path], door: str
) -> None:
    photo = photos_of_another_room[0]
    command = ["image", photo, "--map", "room", "--server", service.door(door)]
    shown = localize(*command)
    assert shown.returncode == 3
    assert shown.stdout.startswith("not localized")
    assert "gate (too_few_inliers)" in shown.stdout
    assert "that of the map's own photos" in shown.stdout
    answer = json.loads(localize(*command, "--json").stdout)
    assert (answer["status"], answer["pose"]) == ("not_localized", None)
    assert (answer["refusal"]["stage"], answer["refusal"]["reason"]) == ("gate", "too_few_inliers")
    assert answer["refusal"]["message"]


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"map": "kitchen"}, "error [map.unknown]"),
        ({"photo": "list.txt"}, "error [image.format]"),
        ({"photo": "absent.jpg"}, "error [image."),
        ({"camera": "PINHOLE,640,360,500,500,320,180"}, "error [camera.size_mismatch]"),
        ({"option": "top_k=0"}, "error [options.top_k]"),
    ],
    ids=["map", "format", "absent", "camera", "option"],
)
def test_an_error_exits_with_1_and_one_line(
    service: Service, query: Query, tmp_path: Path, door: str, changes: dict[str, str], said: str
) -> None:
    (tmp_path / "list.txt").write_text("not an image")
    photo = tmp_path / changes["photo"] if "photo" in changes else query.path
    options = {"map": "room"} | {k: v for k, v in changes.items() if k != "photo"}
    arguments = [word for name, value in options.items() for word in (f"--{name}", value)]
    failed = localize("image", photo, "--server", service.door(door), *arguments)
    assert failed.returncode == 1
    assert failed.stdout == ""
    assert failed.stderr.startswith(said)
    assert failed.stderr.count("\n") == 1


def test_a_version_published_while_it_runs_is_served_and_sigterm_ends_it_with_0(
    sample: Path, maps_dir: Path, query: Query, tmp_path: Path
) -> None:
    with serving(maps_dir, tmp_path / "log") as service:
        ready = httpx.get(f"{service.http}/readyz")
        before = MapStore(maps_dir).current_version("room")
        assert (ready.status_code, ready.json()["maps"]) == (200, [f"room@{before}"])
        with Client(service.http) as over_http, Client(service.grpc) as over_grpc:
            clients = (over_http, over_grpc)
            assert all(client.ready() for client in clients)
            for client in clients:
                result = client.localize(query.image, "room", query.camera)
                assert (result.localized, result.map.version) == (True, before)

            built = subprocess.run(
                [
                    *(sys.executable, "-m", "mapping.cli.main", "build", str(sample / "mapping")),
                    *("--map=room", f"--maps-dir={maps_dir}", "--local-features=sift"),
                    *("--voxel-size=0.02", "--force"),
                ],
                capture_output=True,
                text=True,
                check=False,
                env=ENVIRONMENT,
            )
            assert built.returncode == 0, built.stderr
            after = MapStore(maps_dir).current_version("room")
            assert after != before
            # The version before answers until this one is warm.
            deadline = time.monotonic() + 30
            while f"room@{after}" not in httpx.get(f"{service.http}/readyz").json()["maps"]:
                assert time.monotonic() < deadline
                time.sleep(0.05)
            for client in clients:
                result = client.localize(query.image, "room", query.camera)
                assert (result.localized, result.map.version) == (True, after)
                assert client.map("room").ref == f"room@{after}"
                # The version before can still be asked for by name.
                result = client.localize(query.image, f"room@{before}", query.camera)
                assert (result.localized, result.map.version) == (True, before)

        service.process.send_signal(signal.SIGTERM)
        assert service.process.wait(30) == 0
    assert "Traceback" not in service.log.read_text()
