from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest

from clients import Client
from clients.evaluation.queries import Query
from clients.evaluation.results import (
    check_can_be_written,
    copy_lines,
    drop_torn_line,
    read_results,
    result_line,
    write_poses,
    write_whole,
)
from clients.evaluation.run import Outcome
from visloc.errors import DatasetError, InvalidInput
from visloc.geometry import Pose
from visloc.sequences.filling import TracedPose
from visloc.types import PoseSource, Uncertainty


def outcome_of(name: str, url: str, image: bytes = b"photo") -> Outcome:
    with Client(url) as client:
        result = client.localize(image, "room")
    return Outcome(Query(name, Path(name), None, None), result, None, 0.1)


@pytest.mark.parametrize(
    ("content", "kept"),
    [
        (b"", b""),
        (b"{}", b""),
        (b"a\n", b"a\n"),
        (b"a\nb", b"a\n"),
        (b"a\n" + b"b" * 200_000, b"a\n"),
        (b"a" * 200_000 + b"\n" + b"b" * 70_000, b"a" * 200_000 + b"\n"),
    ],
)
def test_a_torn_line_is_dropped_and_nothing_else(
    content: bytes, kept: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "results.jsonl"
    path.write_bytes(content)
    drop_torn_line(path)
    assert path.read_bytes() == kept


def test_results_come_back_with_every_bit_of_the_pose(url: str, tmp_path: Path) -> None:
    outcome = outcome_of("seq 1/ä\u2028.jpg", url)
    path = tmp_path / "results.jsonl"
    path.write_text(result_line(outcome), encoding="utf-8")
    (stored,) = read_results(path)
    assert stored.name == "seq 1/ä\u2028.jpg"
    assert stored.status == "localized"
    assert stored.pose is not None
    assert outcome.result is not None
    assert outcome.result.pose is not None
    assert stored.pose.rotation_wxyz == outcome.result.pose.rotation_wxyz
    assert json.loads(path.read_bytes())["inliers"] == 311


def test_an_error_is_stored_with_all_its_parts(tmp_path: Path) -> None:
    error = InvalidInput("image.format", "not a photo", field="image", expected="JPEG", got="x")
    line = result_line(Outcome(Query("a", Path("a"), None, None), None, error, 0.1))
    assert json.loads(line) == {
        "name": "a",
        "status": "error",
        "error": {
            "kind": "InvalidInput",
            "code": "image.format",
            "message": "not a photo",
            "field": "image",
            "expected": "JPEG",
            "got": "x",
        },
        "source": None,
    }
    path = tmp_path / "results.jsonl"
    path.write_text(line)
    assert [(r.name, r.status, r.pose) for r in read_results(path)] == [("a", "error", None)]


@pytest.mark.parametrize(
    "line",
    [
        b"nonsense",
        b"[]",
        b"\xff",
        b"{}",
        b'{"name": 1, "status": "not_localized"}',
        b'{"name": "a", "status": "error"}',
        b'{"name": "a", "status": "error", "error": "x"}',
        b'{"name": "a", "status": "maybe"}',
        b'{"name": "a", "status": "localized", "pose": null}',
        b'{"name": "a", "status": []}',
        b"",
    ],
)
def test_a_damaged_line_is_named_by_file_and_line(line: bytes, tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    path.write_bytes(b'{"name": "z", "status": "not_localized"}\n' + line + b"\n")
    with pytest.raises(DatasetError) as caught:
        list(read_results(path))
    assert caught.value.code == "results.line"
    assert caught.value.field == f"{path}:2"


def test_lines_can_be_brought_into_another_order_in_place(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    lines = [b'{"name": "%s", "status": "not_localized"}\n' % name for name in (b"b", b"ccc", b"a")]
    path.write_bytes(b"".join(lines))
    b, c, a = read_results(path)
    copy_lines(path, [a, b, c], path)
    assert path.read_bytes() == lines[2] + lines[0] + lines[1]


def test_poses_are_written_as_received(http_url: str, grpc_url: str, tmp_path: Path) -> None:
    written = []
    for url in (http_url, grpc_url):
        result = outcome_of("a b.jpg", url).result
        assert result is not None
        assert result.pose is not None
        write_poses(tmp_path / "poses.txt", [("a b.jpg", result.pose)])
        written.append((tmp_path / "poses.txt").read_text())
    assert (
        written
        == [
            "a%20b.jpg 0.9298410554097046 0.01755162593 0.31931803130557 0.1819987554486438 "
            "0.24164110554685916 -0.0 1e-17\n"
        ]
        * 2
    )


@pytest.mark.parametrize("name", ["a b.jpg", "50%.jpg", "a%20b.jpg", "\u00a0\u3000.jpg", "ä/é.jpg"])
def test_every_name_is_one_field_of_a_pose_line_and_comes_back(
    name: str, url: str, tmp_path: Path
) -> None:
    result = outcome_of(name, url).result
    assert result is not None
    assert result.pose is not None
    write_poses(tmp_path / "poses.txt", [(name, result.pose)])

    written, *numbers = (tmp_path / "poses.txt").read_text(encoding="utf-8").split()

    assert unquote(written) == name
    assert len(numbers) == 7


def test_a_file_that_cannot_be_finished_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_bytes(b"old")

    def parts() -> Any:
        yield b"new"
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_whole(path, parts())
    assert path.read_bytes() == b"old"


def test_an_output_that_cannot_be_written_is_found_before_the_run(tmp_path: Path) -> None:
    check_can_be_written([tmp_path / "report.json"])
    for path in (tmp_path, tmp_path / "none" / "report.json"):
        with pytest.raises(InvalidInput) as caught:
            check_can_be_written([path])
        assert caught.value.code == "output.folder"


COARSE = {
    "cam_from_world": {"rotation_wxyz": [1.0, 0.0, 0.0, 0.0], "translation": [0.1, 0.2, 0.3]},
    "position": [-0.1, -0.2, -0.3],
    "orientation": [1.0, 0.0, 0.0, 0.0],
    "covariance": np.eye(6).ravel().tolist(),
    "position_std": [1.0, 1.0, 1.0],
    "orientation_std_deg": [9.0, 9.0, 9.0],
    "method": "bdi",
}


def test_a_coarse_pose_stays_one_when_the_photo_is_filled_and_no_longer_filled(
    tmp_path: Path,
) -> None:
    path = tmp_path / "results.jsonl"
    line = {"name": "a", "status": "coarse", "pose": None, "source": None, "inliers": 3}
    path.write_text(json.dumps({**line, "coarse": COARSE}) + "\n")
    (stored,) = read_results(path)
    assert (stored.status, stored.pose, stored.is_final) == ("coarse", None, True)
    assert stored.coarse is not None
    assert stored.coarse.translation == (0.1, 0.2, 0.3)

    beside = TracedPose(Pose.identity(), np.eye(6), PoseSource.RIG, Uncertainty.WHOLE)
    copy_lines(path, [stored], path, {"a": beside})
    assert json.loads(path.read_text())["status"] == "filled"
    (filled,) = read_results(path)
    assert (filled.status, filled.filled is None, filled.coarse is None) == ("coarse", False, False)

    copy_lines(path, [filled], path)
    assert json.loads(path.read_text()) == {**line, "coarse": COARSE}
