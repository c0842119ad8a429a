from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clients.cli.main import main
from tests.docs_check import ROOT
from tests.test_tutorials import run_page
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc_extensions.ros.reading import open_bag
from visloc_extensions.ros.tests.rosbags_made import (
    BASE,
    BASE_FROM_OPTICAL,
    SECOND,
    Made,
    write_bag,
    write_messages,
)


@pytest.mark.parametrize("ros1", [True, False])
def test_a_bag_becomes_a_bag_of_poses(
    doors: tuple[str, str], sample: Path, tmp_path: Path, ros1: bool
) -> None:
    queries = read_dataset(sample / "query")
    bag, poses = tmp_path / "walk", tmp_path / ("poses.bag" if ros1 else "poses")
    write_bag(bag, queries, ros1=False, compressed=ros1, depth=False)
    first = queries.images[0].sensor_id
    truth = [queries.pose(r) for r in queries.images if r.sensor_id == first]

    with pytest.raises(SystemExit) as ended:
        main(
            [
                "bag",
                str(bag),
                "--map",
                "room",
                "--output",
                str(poses),
                *("--frame", BASE, "--server", doors[0]),
            ]
        )

    assert ended.value.code == 0
    with open_bag(poses) as opened:
        messages = [message for _, message in opened.messages(["/visloc/pose"])]
    assert len(messages) == len(truth)
    for number, (message, true) in enumerate(zip(messages, truth, strict=True)):
        assert true is not None
        base_in_map = true.inverse() @ BASE_FROM_OPTICAL.inverse()
        assert message.header.stamp.sec == number + 1
        at = message.pose.pose
        q = at.orientation
        position = (at.position.x, at.position.y, at.position.z)
        found = Pose.from_quaternion((q.w, q.x, q.y, q.z), position)
        np.testing.assert_allclose(found.translation, base_in_map.translation, atol=0.05)
        np.testing.assert_allclose(found.rotation, base_in_map.rotation, atol=0.05)
        assert np.linalg.eigvalsh(np.reshape(message.pose.covariance, (6, 6))).min() > 0


def test_one_broken_photo_of_a_bag_does_not_cost_the_others(
    doors: tuple[str, str], sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    queries, made = read_dataset(sample / "query"), Made(False)
    good = queries.path_of(queries.images[0]).read_bytes()
    kind = "sensor_msgs/msg/CompressedImage"
    files = [
        ("/c/compressed", kind, second, made.file(second * SECOND, "camera", file))
        for second, file in ((1, b"no photo"), (2, good))
    ]
    grey = made.image(SECOND, "thermal", np.zeros((4, 6), np.uint16), "mono16")
    files.append(("/thermal", "sensor_msgs/msg/Image", SECOND, grey))
    write_messages(tmp_path / "bag", made, files)
    asked = ["bag", str(tmp_path / "bag"), "--map", "room", "--server", doors[0]]

    with pytest.raises(SystemExit) as ended:
        main([*asked, "--output", str(tmp_path / "poses")])

    assert ended.value.code == 0
    told = capsys.readouterr().err
    assert "1 of 2 photos localized" in told
    assert "no answer      1 photos, the first: [image." in told
    assert "/thermal: left out, its encoding 'mono16' is not supported" in told
    for wrong, code in (
        (["--frame", "base_link"], "bag.frame"),
        (["--output", str(tmp_path / "no" / "poses")], "output.folder"),
        (["--output", str(tmp_path / "poses")], "bag.exists"),
        (["--topic", "/d"], "/d: no such topic"),
        (["--topic", "/thermal"], "/thermal: its encoding 'mono16'"),
    ):
        with pytest.raises(SystemExit) as ended:
            main([*asked, "--output", str(tmp_path / "other"), *wrong])
        assert ended.value.code == 1
        assert code in capsys.readouterr().err


def test_poses_of_two_cameras_need_a_frame(
    doors: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = Made(False)
    kind = "sensor_msgs/msg/CompressedImage"
    files = [(f"/{c}/compressed", kind, 1, made.file(SECOND, c, b"photo")) for c in "ab"]
    write_messages(tmp_path / "bag", made, files)

    with pytest.raises(SystemExit) as ended:
        main(
            [
                *("bag", str(tmp_path / "bag"), "--map", "room"),
                *("--output", str(tmp_path / "poses"), "--server", doors[0]),
            ]
        )
    assert ended.value.code == 1
    assert "bag.cameras" in capsys.readouterr().err


@pytest.mark.slow
def test_the_commands_of_the_page_run(demo: Path, tmp_path: Path) -> None:
    write_bag(tmp_path / "walk.bag", read_dataset(demo / "dataset" / "mapping"), ros1=True)
    run_page(ROOT / "visloc_extensions" / "ros" / "README.md", 2, demo, tmp_path)
