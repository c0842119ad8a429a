"""Coarse poses over both doors, and what becomes of them in a batch."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from clients import Client
from clients.cli.main import app
from clients.wire.rigs import RigImage
from visloc.errors import InvalidInput
from visloc.geometry import Pose, center_covariance
from visloc.types import RigSensor

# No pose has so many inliers.
REFUSED = {"min_inliers": 1_000_000, "read_as": "upright", "fallback": "coarse"}
NOT_COMPARED = ("seconds", "request_id")


@pytest.fixture(scope="module")
def served(two_rooms: Path, serve: Any) -> Iterator[Any]:
    with serve(two_rooms) as doors:
        yield doors


def test_both_doors_state_the_same_coarse_pose(served: Any, query: Any) -> None:
    answers = []
    for url in (served.url, f"grpc://127.0.0.1:{served.server.grpc_port}"):
        with Client(url) as client:
            result = client.localize(query.image, "room", query.camera, REFUSED)
            answers.append({k: v for k, v in result.raw.items() if k not in NOT_COMPARED})
            assert result.status == "coarse"
            assert not result.localized
            assert result.pose is None
            assert result.geopose is None
            assert result.refusal is not None
            assert result.coarse is not None
            assert result.coarse.method == "bdi"
            pose, covariance = result.coarse.cam_from_world, result.coarse.covariance
            np.testing.assert_allclose(result.coarse.position, pose.center, atol=1e-9)
            np.testing.assert_allclose(
                np.diag(center_covariance(pose, covariance))[3:],
                result.coarse.position_std**2,
                rtol=1e-6,
            )
            assert np.linalg.norm(pose.center - query.cam_from_world.center) < 1.0
    assert answers[0] == answers[1]


def test_a_localized_photo_has_none(served: Any, query: Any) -> None:
    with Client(served.url) as client:
        result = client.localize(query.image, "room", query.camera, {"fallback": "coarse"})
    assert result.status == "localized"
    assert result.coarse is None


def test_places_that_retrieval_cannot_tell_apart_give_none(served: Any, query: Any) -> None:
    with Client(served.url) as client:
        result = client.localize(query.image, ["room", "study"], query.camera, REFUSED)
    assert result.status == "not_localized"
    assert result.coarse is None


def test_rigs_and_sequences_have_none(served: Any, query: Any) -> None:
    image = RigImage("camera", query.image, query.camera)
    rig = {"camera": RigSensor(Pose.identity())}
    with Client(served.url) as client, pytest.raises(InvalidInput) as caught:
        client.localize_rig([image], "room", rig, options=REFUSED)
    assert caught.value.code == "options.fallback"
    with Client(served.url) as client, pytest.raises(InvalidInput) as caught:
        client.localize(query.image, "room", query.camera, {"fallback": "guess"})
    assert caught.value.code == "options.fallback"


def test_a_batch_keeps_coarse_poses_apart(served: Any, sample: Path, tmp_path: Path) -> None:
    options = [part for k, v in REFUSED.items() for part in ("--option", f"{k}={v}")]
    asked = ["batch", str(sample / "query"), "--map", "room", "--server", served.url]

    for _ in range(2):  # the second reads what the first wrote
        done = CliRunner().invoke(app, [*asked, "--output", str(tmp_path / "out"), *options])
        assert done.exit_code == 0, done.output

    lines = (tmp_path / "out/results.jsonl").read_text().splitlines()
    assert {json.loads(line)["status"] for line in lines} == {"coarse"}
    assert (tmp_path / "out/poses.txt").read_text() == ""
    coarse = (tmp_path / "out/poses_coarse.txt").read_text().splitlines()
    assert len(coarse) == len(lines) > 0
    first, told = coarse[0].split(), json.loads(lines[0])["coarse"]["cam_from_world"]
    assert [float(x) for x in first[1:]] == [*told["rotation_wxyz"], *told["translation"]]


def test_one_photo_is_printed_and_exits_as_not_localized(served: Any, query: Any) -> None:
    options = [part for k, v in REFUSED.items() for part in ("--option", f"{k}={v}")]
    asked = ["image", str(query.path), "--map", "room", "--server", served.url]
    done = CliRunner().invoke(app, [*asked, *options])
    assert done.exit_code == 3
    assert "told by retrieval alone" in done.output
