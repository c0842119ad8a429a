"""The clients with the service as it is: rigs, sequences and modes."""

from __future__ import annotations

import asyncio
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from clients import AsyncClient, Client, Instant, Odometry, PoseSource, RigImage, RigSensor
from clients.cli.main import main
from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.geometry import Pose

READY = re.compile(r"ready: (http://127\.0\.0\.1:\d+) (grpc://127\.0\.0\.1:\d+)")
START = 1_700_000_000_000  # milliseconds


@pytest.fixture(scope="module")
def doors(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """The addresses of a service with the map ``room``."""
    log = tmp_path_factory.mktemp("service") / "log"
    with (
        log.open("wb") as stderr,
        subprocess.Popen(
            [
                *(sys.executable, "-m", "service", "--maps-dir", str(built_maps)),
                *("--http-port=0", "--grpc-port=0", "--workers=1", "--threads-per-worker=1"),
            ],
            stderr=stderr,
            env={name: value for name, value in os.environ.items() if "VISLOC" not in name},
        ) as process,
    ):
        try:
            deadline = time.monotonic() + 60
            while (ready := READY.search(log.read_text())) is None:
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < deadline, log.read_text()
                time.sleep(0.05)
            yield ready[1], ready[2]
        finally:
            process.kill()


@pytest.fixture
def rig(queries: list[Any]) -> dict[str, RigSensor]:
    """The queries of the sample as the cameras of one rig, which is at the world's origin."""
    return {f"cam{i}": RigSensor(q.cam_from_world, q.camera) for i, q in enumerate(queries)}


def test_a_rig_is_localized_alike_through_both_doors(
    doors: tuple[str, str], queries: list[Any], rig: dict[str, RigSensor]
) -> None:
    images = [RigImage(f"cam{i}", query.image, None, 5) for i, query in enumerate(queries)]
    texts = []
    for url in doors:
        with Client(url) as client:
            answer = client.localize_rig(images, "room", rig, request_id="same")
        assert answer.localized
        assert answer.pose is not None
        metres, degrees = pose_error(answer.pose.rig_from_world, Pose.identity())
        assert metres < 0.005
        assert degrees < 0.05
        texts.append(json.dumps({**answer.raw, "seconds": None}, sort_keys=True))
    assert texts[0] == texts[1]


def test_a_bad_photo_of_a_rig_fails_alone(
    doors: tuple[str, str], queries: list[Any], rig: dict[str, RigSensor]
) -> None:
    images = [RigImage("cam0", b"no photo"), RigImage("cam1", queries[1].image)]
    for url in doors:
        with Client(url) as client:
            answer = client.localize_rig(images, "room", rig)
        assert answer.localized
        assert [image.error is None for image in answer.images] == [False, True]
        assert isinstance(answer.images[0].error, InvalidInput)


def test_a_sequence_is_localized_alike_and_filled_where_a_photo_is_bad(
    doors: tuple[str, str], queries: list[Any]
) -> None:
    first, _, last = queries
    photos = [(first.image, first), (b"no photo", None), (last.image, last)]
    instants = [
        Instant(
            START + 400 * i,
            (RigImage("camera", image, None if query is None else query.camera),),
            None if query is None else Odometry(query.cam_from_world),
        )
        for i, (image, query) in enumerate(photos)
    ]

    async def ask(url: str) -> list[Any]:
        async with AsyncClient(url) as client:
            return [answer async for answer in client.localize_sequence(instants, "room")]

    texts = []
    for url in doors:
        with Client(url) as client:
            answers = list(client.localize_sequence(instants, "room", request_id="same"))
        assert [a.status for a in answers] == ["localized", "filled", "localized"]
        assert answers[1].source is PoseSource.INTERPOLATED
        assert [a.pose.photo_covariance is None for a in answers if a.pose] == [False, True, False]
        assert [a.status for a in asyncio.run(ask(url))] == ["localized", "filled", "localized"]
        texts.append(json.dumps([{**a.raw, "seconds": None} for a in answers], sort_keys=True))
    assert texts[0] == texts[1]


def test_priors_keep_a_photo_from_being_found_elsewhere(
    doors: tuple[str, str], queries: list[Any]
) -> None:
    query = queries[0]
    here = {"position": query.cam_from_world.center.tolist(), "radius": 5.0}
    elsewhere = {"position": [100.0, 100.0, 100.0], "radius": 5.0}
    for url in doors:
        with Client(url) as client:
            for prior, is_localized in ((here, True), (elsewhere, False)):
                answer = client.localize(
                    query.image, ["room"], query.camera, priors={"position": prior}
                )
                assert answer.localized is is_localized


def test_all_modes_of_a_benchmark(
    doors: tuple[str, str], queries: list[Any], tmp_path: Path
) -> None:
    sensors = tmp_path / "rig" / "sensors"
    (sensors / "records_data").mkdir(parents=True)
    rows: dict[str, list[str]] = {name: [] for name in ("sensors", "rigs", "records_camera")}
    for i, query in enumerate(queries):
        camera, pose = query.camera, query.cam_from_world
        params = ", ".join(map(repr, camera.params))
        numbers = ", ".join(repr(float(n)) for n in [*pose.rotation_wxyz, *pose.translation])
        rows["sensors"].append(
            f"cam{i}, , camera, {camera.model}, {camera.width}, {camera.height}, {params}"
        )
        rows["rigs"].append(f"rig, cam{i}, {numbers}")
        for t in range(2):
            name = f"cam{i}-{t}.jpg"
            rows["records_camera"].append(f"{START + t}, cam{i}, {name}")
            photo = b"no photo" if (i, t) == (0, 1) else query.image
            (sensors / "records_data" / name).write_bytes(photo)
    rows["trajectories"] = [f"{START + t}, rig, 1, 0, 0, 0, 0, 0, 0" for t in range(2)]
    for file, lines in rows.items():
        text = "\n".join(["# kapture format: 1.1", *lines]) + "\n"
        (sensors / f"{file}.txt").write_text(text)
    report = tmp_path / "report.json"
    with pytest.raises(SystemExit) as caught:
        main(
            [
                *("benchmark", str(sensors.parent), "--map", "room", "--report", str(report)),
                *("--server", doors[1], "--mode", "all", "--concurrency", "2"),
            ]
        )
    assert caught.value.code == 0
    modes = json.loads(report.read_bytes())["modes"]
    assert [m["localized"] + m["filled"] for m in modes.values()] == [5, 6, 6, 6, 6]
    assert modes["gp3p"]["instants"] == {"asked": 2, "localized": 2}
    for m in modes.values():
        assert m["position_error_m"]["max"] < 0.01
