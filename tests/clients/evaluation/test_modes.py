"""The modes of ``localize batch`` and ``localize benchmark``, with exact geometry."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients.cli.main import main
from clients.evaluation.instants import instants_of_dataset
from clients.evaluation.modes import Mode, arrange, parse_modes
from clients.evaluation.queries import read_queries
from visloc.errors import DatasetError, InvalidInput, NotFound, VislocError
from visloc.evaluation import pose_error
from visloc.geometry import Pose
from visloc.sequences.filling import TimeUnit, TracedPose
from visloc.types import PoseSource, Uncertainty
from visloc_api.words.maps import MapInfo, RigInfo

Dataset = Callable[..., Path]
HERE, LOST, BROKEN = None, b"refuse", b"broken"
# Unix times in milliseconds; the rig drives 10 m/s and turns 10 degrees/s.
START = 1_700_000_000_000
INFO = MapInfo(
    id="room",
    version="v1",
    created="",
    metric=True,
    method="rgbd",
    local_features="xfeat",
    global_features=(),
    images=1,
    landmarks=1,
    observations=1,
    extent=((0.0,), (0.0,)),
    size_bytes=1,
    down=None,
    rigs=(RigInfo(id="stereo", sensors=("left", "right")),),
    anchor=None,
    place=None,
    current=True,
    versions=(),
    content_hash="",
)


def localize(*arguments: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([*map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


def lines_of(output: Path) -> dict[str, dict[str, Any]]:
    lines = [json.loads(line) for line in (output / "results.jsonl").read_bytes().splitlines()]
    return {line["name"]: line for line in lines}


def poses_of(path: Path) -> dict[str, Pose]:
    rows = [line.split() for line in path.read_text().splitlines()]
    return {
        name: Pose.from_quaternion(list(map(float, numbers[:4])), list(map(float, numbers[4:])))
        for name, *numbers in rows
    }


def truth_of(dataset: Path) -> dict[str, Pose]:
    photos = read_queries(dataset).photos
    return {query.name: query.truth for query in photos if query.truth is not None}


def instants(*rows: tuple[bytes | None, bytes | None]) -> dict[tuple[int, str], bytes | None]:
    """The photos of the left and right camera, every 400 ms."""
    return {
        (START + 400 * i, sensor): content
        for i, row in enumerate(rows)
        for sensor, content in zip(("left", "right"), row, strict=True)
    }


# Words and arrangement


@pytest.mark.parametrize(
    ("texts", "modes"),
    [
        ([], [Mode.SINGLE]),
        (["gp3p"], [Mode.GP3P]),
        (["rig+seq,single", "rig"], [Mode.RIG_SEQ, Mode.SINGLE, Mode.RIG]),
        (["gp3p", "all"], [Mode.GP3P, Mode.SINGLE, Mode.RIG, Mode.SEQ, Mode.RIG_SEQ]),
    ],
)
def test_modes_are_words_with_commas(texts: list[str], modes: list[Mode]) -> None:
    assert parse_modes(texts) == modes


@pytest.mark.parametrize("text", ["", "single,", "Rig", "seq+rig", "single rig"])
def test_an_unknown_mode_is_told_with_those_there_are(text: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        parse_modes([text])
    assert caught.value.code == "mode.unknown"
    assert "rig+seq" in str(caught.value)


def test_photos_of_one_rig_and_time_are_an_instant_and_other_cameras_are_alone(
    make_rig_dataset: Dataset,
) -> None:
    photos = {(1, "left"): HERE, (1, "right"): HERE, (1, "hand"): HERE, (2, "right"): HERE}
    queries = read_queries(make_rig_dataset(photos))
    found = instants_of_dataset(queries)
    assert [[query.name for query in instant.photos] for instant in found] == [
        ["hand-1.jpg"],
        ["left-1.jpg", "right-1.jpg"],
        ["right-2.jpg"],
    ]
    hand, stereo, right = (instant.rig for instant in found)
    assert not isinstance(hand, str)
    assert not isinstance(stereo, str)
    assert list(hand) == ["hand"]
    assert list(stereo) == ["left", "right"]
    np.testing.assert_array_equal(stereo["right"].cam_from_rig.translation, [-0.5, 0, 0])
    assert right is stereo


def test_the_outermost_of_nested_rigs_counts(make_rig_dataset: Dataset) -> None:
    photos = {(1, "left"): HERE, (1, "right"): HERE, (1, "roof"): HERE}
    rigs = (
        "car, pair, 1, 0, 0, 0, 0, 0, 2\ncar, roof, 1, 0, 0, 0, 0, 0, 0\n"
        "pair, left, 1, 0, 0, 0, 0, 0, 0\npair, right, 1, 0, 0, 0, -0.5, 0, 0\n"
    )
    (instant,) = instants_of_dataset(read_queries(make_rig_dataset(photos, rigs=rigs)))
    assert len(instant.photos) == 3
    assert not isinstance(instant.rig, str)
    np.testing.assert_array_equal(instant.rig["right"].cam_from_rig.translation, [-0.5, 0, 2])


LEFT = "a, left, 1, 0, 0, 0, 0, 0, 0\n"


@pytest.mark.parametrize(
    ("rigs", "code", "said"),
    [
        ("", "queries.no_rigs", "rigs.txt"),
        ("a, up, 1, 0, 0, 0, 0, 0, 0\n", "queries.no_rigs", "rigs.txt"),
        (LEFT + "b, left, 1, 0, 0, 0, 0, 0, 0\n", "queries.rig_ambiguous", "a, b"),
        (LEFT + "a, right, , , , , , , \n", "queries.rig_transform", "calibrate-rig"),
    ],
)
@pytest.mark.parametrize("mode", [Mode.RIG, Mode.RIG_SEQ, Mode.GP3P])
def test_rigs_that_cannot_be_used_are_told(
    rigs: str, code: str, said: str, mode: Mode, make_rig_dataset: Dataset
) -> None:
    queries = read_queries(make_rig_dataset(instants((HERE, HERE)), rigs=rigs))
    with pytest.raises(DatasetError) as caught:
        arrange(queries, [mode], INFO)
    assert caught.value.code == code
    assert said in str(caught.value)
    assert ("--rig" in str(caught.value)) is (mode is Mode.GP3P and code == "queries.no_rigs")
    assert arrange(queries, [Mode.SINGLE, Mode.SEQ], INFO).time_unit is TimeUnit.MS


@pytest.mark.parametrize("mode", [Mode.SEQ, Mode.RIG_SEQ])
def test_timestamps_of_no_known_unit_need_one(mode: Mode, make_rig_dataset: Dataset) -> None:
    queries = read_queries(make_rig_dataset({(100, "left"): HERE, (300, "left"): HERE}))
    with pytest.raises(DatasetError) as caught:
        arrange(queries, [mode], INFO)
    assert caught.value.code == "queries.time_unit"
    assert "--time-unit" in str(caught.value)
    assert "100 to 300" in str(caught.value)
    known = arrange(queries, [mode], INFO, time_unit=TimeUnit.MS)
    assert known.time_unit is TimeUnit.MS


@pytest.mark.parametrize(
    ("mode", "code"),
    [("rig", "queries.no_rigs"), ("gp3p", "queries.no_rigs"), ("seq", "queries.no_timestamps")],
)
def test_a_list_of_photos_has_neither_rigs_nor_times(
    mode: str, code: str, http_url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos.txt").write_text("a.jpg\n")
    command = ("--map", "room", "--output", tmp_path / "out", "--server", http_url)
    assert localize("batch", tmp_path / "photos.txt", *command, "--mode", mode) == 1
    assert f"error [{code}]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("rig_id", "kind", "code"),
    [("mono", NotFound, "rig.unknown"), ("stereo", DatasetError, "queries.no_rigs")],
)
def test_a_rig_of_the_map_must_be_known_and_have_taken_photos(
    rig_id: str, kind: type[VislocError], code: str, make_rig_dataset: Dataset
) -> None:
    queries = read_queries(make_rig_dataset({(1, "hand"): HERE}, rigs=""))
    with pytest.raises(kind) as caught:
        arrange(queries, [Mode.GP3P], INFO, rig_id=rig_id)
    assert caught.value.code == code


def test_filling_keeps_nanoseconds_apart(make_rig_dataset: Dataset) -> None:
    times = [1_700_000_000_000_000_000 + 100 * i for i in range(3)]
    queries = read_queries(make_rig_dataset({(time, "left"): HERE for time in times}))
    arrangement = arrange(queries, [Mode.SEQ], INFO)
    ends = [Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 1.0)]
    first, last = (
        TracedPose(p, 1e-6 * np.eye(6), PoseSource.ESTIMATED, Uncertainty.WHOLE, 50) for p in ends
    )
    poses = arrangement.fill(Mode.SEQ, [first, None, last])
    assert poses[1] is not None
    assert poses[1].source is PoseSource.INTERPOLATED
    np.testing.assert_allclose(poses[1].pose.translation, [0.5, 0.0, 0.0], atol=1e-9)


# localize batch


def run_batch(dataset: Path, output: Path, url: str, mode: str, *more: object) -> int:
    command = ("--map", "room", "--output", output, "--server", url, "--mode", mode)
    return localize("batch", dataset, *command, *more)


def test_mode_rig_fills_a_camera_from_the_other_one_exactly(
    url: str, make_rig_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = make_rig_dataset(instants((HERE, LOST), (LOST, LOST), (BROKEN, HERE)))
    output = tmp_path / "out"
    assert run_batch(dataset, output, url, "rig", "--concurrency", 3) == 0

    lines, truth = list(lines_of(output).values()), truth_of(dataset)
    assert [line["status"] for line in lines] == [
        *("localized", "filled", "not_localized", "not_localized", "filled", "localized")
    ]
    assert [line["source"] for line in lines] == [
        *("estimated", "rig", None, None, "rig", "estimated")
    ]
    assert lines[1]["refusal"]["reason"] == "too_few_matches"
    # It covers what the pose that it was filled from covers; nobody judged it.
    assert lines[1]["pose"]["uncertainty"] == lines[0]["pose"]["uncertainty"]
    assert lines[1]["pose"]["probability"] is None
    assert lines[1]["pose"]["photo_covariance"] == []
    assert lines[4]["error"]["code"] == "image.undecodable"
    assert lines[2]["pose"] is None
    # A filled pose is less certain than what it was filled from.
    for axis in range(3):
        assert lines[4]["pose"]["orientation_std_deg"][axis] > 0
        assert lines[1]["pose"]["covariance"][7 * (3 + axis)] > 0
    poses, filled = (poses_of(output / f"{file}.txt") for file in ("poses", "poses_filled"))
    assert list(poses) == [lines[i]["name"] for i in (0, 5)]
    assert list(filled) == [lines[i]["name"] for i in (1, 4)]
    for name, pose in (poses | filled).items():
        assert pose_error(pose, truth[name]) == pytest.approx((0.0, 0.0), abs=1e-6)
    said = capsys.readouterr().out
    assert "2 of 6 localized, 2 filled (2 from another camera of the rig), 2 not localized" in said


def test_mode_seq_fills_between_instants_and_never_beyond_the_gap(
    http_url: str, make_rig_dataset: Dataset, tmp_path: Path
) -> None:
    rows = [HERE, LOST, HERE, LOST, LOST, LOST, LOST]
    photos = {(START + 400 * i, "left"): content for i, content in enumerate(rows)}
    dataset, output = make_rig_dataset(photos), tmp_path / "out"
    assert run_batch(dataset, output, http_url, "seq") == 0

    lines = list(lines_of(output).values())
    # 0.4 s and 0.8 s after the last one; 1.2 s are beyond one second.
    sources = ["estimated", "interpolated", "estimated", "nearest", "nearest", None, None]
    assert [line["source"] for line in lines] == sources
    assert list(poses_of(output / "poses.txt")) == [lines[i]["name"] for i in (0, 2)]
    truth, poses = truth_of(dataset), poses_of(output / "poses_filled.txt")
    assert list(poses) == [lines[i]["name"] for i in (1, 3, 4)]
    name = lines[1]["name"]
    metres, degrees = pose_error(poses[name], truth[name])
    # Straight on, at an even pace, evenly turning: interpolation is exact.
    assert metres < 1e-5
    assert degrees < 1e-5
    assert lines[1]["pose"]["position_std"][0] > lines[0]["pose"]["position_std"][0]


def test_a_longer_gap_can_be_allowed_and_none_at_all(
    http_url: str, make_rig_dataset: Dataset, tmp_path: Path
) -> None:
    photos = {(t, "left"): content for t, content in ((0, HERE), (2000, LOST), (4000, HERE))}
    dataset = make_rig_dataset(photos)
    for number, (more, source) in enumerate(
        [
            (("--max-gap", 1), None),
            (("--max-gap", 4), "interpolated"),
            (("--max-gap", 2), "nearest"),
            (("--max-gap", 0), None),
        ]
    ):
        output = tmp_path / str(number)
        more = (*more, "--time-unit", "ms")
        assert run_batch(dataset, output, http_url, "seq", *more) == 0
        assert list(lines_of(output).values())[1]["source"] == source


def test_mode_rig_seq_fills_from_the_rig_first(
    http_url: str, make_rig_dataset: Dataset, tmp_path: Path
) -> None:
    dataset = make_rig_dataset(instants((HERE, LOST), (LOST, LOST), (LOST, HERE)))
    output = tmp_path / "out"
    assert run_batch(dataset, output, http_url, "rig+seq") == 0
    assert [line["source"] for line in lines_of(output).values()] == [
        *("estimated", "rig", "interpolated", "interpolated", "rig", "estimated")
    ]
    truth = truth_of(dataset)
    poses = poses_of(output / "poses_filled.txt")
    assert len(poses) == 4
    for name, pose in poses.items():
        # The right camera sits half a metre off the turning point: a chord instead of an arc.
        assert pose_error(pose, truth[name])[0] < 2e-3


def test_mode_gp3p_gives_each_photo_the_pose_of_the_rig(
    url: str, make_rig_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    photos = instants((HERE, b"dark"), (b"dark", HERE), (b"dark", b"dark"), (BROKEN, HERE))
    photos[START + 1600, "hand"] = HERE
    dataset, output = make_rig_dataset(photos), tmp_path / "out"
    assert run_batch(dataset, output, url, "gp3p", "--concurrency", 2) == 0

    lines = list(lines_of(output).values())
    assert [line["status"] for line in lines] == [
        *("localized", "localized", "localized", "localized", "not_localized", "not_localized"),
        *("filled", "localized", "localized"),
    ]
    assert [line["source"] for line in lines[4:7]] == [None, None, "rig"]
    assert lines[6]["error"]["code"] == "image.undecodable"
    for pose in (line["pose"] for line in lines[:4]):
        assert (pose["uncertainty"], pose["probability"]) == ("whole", 0.75)
        part = np.array(pose["covariance"]) / 4
        assert pose["photo_covariance"] == pytest.approx(part, abs=1e-12)
    assert [line["name"] for line in lines] == [q.name for q in read_queries(dataset).photos]
    poses, filled = (poses_of(output / f"{file}.txt") for file in ("poses", "poses_filled"))
    truth = truth_of(dataset)
    assert len(poses) == 6
    assert list(filled) == [lines[6]["name"]]
    for name, pose in (poses | filled).items():
        assert pose_error(pose, truth[name]) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert len(service.seen) == 5
    first = next(r for r in service.seen if r["timestamp"] == START)
    assert [image["sensor"] for image in first["images"]] == ["left", "right"]
    assert first["images"][0]["camera"]["params"] == [60.0, 32.0, 24.0]
    assert {image["timestamp"] for image in first["images"]} == {START}


def test_in_gp3p_a_photo_that_contributed_nothing_has_a_pose_that_is_filled(
    url: str, make_rig_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = instants((HERE, b"blank"), (BROKEN, HERE), (HERE, HERE))
    dataset, output = make_rig_dataset(photos), tmp_path / "out"
    assert run_batch(dataset, output, url, "gp3p") == 0

    lines, truth = list(lines_of(output).values()), truth_of(dataset)
    assert [(line["status"], line["source"]) for line in lines] == [
        *(("localized", "estimated"), ("filled", "rig"), ("filled", "rig")),
        *[("localized", "estimated")] * 3,
    ]
    blank, broken = lines[1], lines[2]
    assert (blank["inliers"], blank["correspondences"]) == (0, 700)
    assert blank["refusal"]["reason"] == "no_inliers"
    assert broken["error"]["code"] == "image.undecodable"
    for line, own in ((blank, lines[0]), (broken, lines[3])):
        stds = (np.array(of["pose"]["orientation_std_deg"]) for of in (line, own))
        # 0.2 degrees for the calibration.
        np.testing.assert_allclose(next(stds) ** 2 - next(stds) ** 2, 0.04, rtol=1e-6)
    poses, filled = (poses_of(output / f"{file}.txt") for file in ("poses", "poses_filled"))
    assert list(poses) == [lines[i]["name"] for i in (0, 3, 4, 5)]
    assert list(filled) == [blank["name"], broken["name"]]
    for name, pose in (poses | filled).items():
        assert pose_error(pose, truth[name]) == pytest.approx((0.0, 0.0), abs=1e-6)
    said = capsys.readouterr().out
    assert "4 of 6 localized, 2 filled (2 from another camera of the rig), 0 not" in said
    # The same command changes nothing.
    files = [output / name for name in ("results.jsonl", "poses.txt", "poses_filled.txt")]
    before = [file.read_bytes() for file in files]
    assert run_batch(dataset, output, url, "gp3p") == 0
    assert [file.read_bytes() for file in files] == before


def test_filled_poses_have_a_file_where_there_can_be_some(
    http_url: str, make_rig_dataset: Dataset, tmp_path: Path
) -> None:
    dataset = make_rig_dataset(instants((HERE, HERE)))
    for mode, has_file in (("single", False), ("rig", True), ("seq", True), ("gp3p", False)):
        output = tmp_path / mode
        assert run_batch(dataset, output, http_url, mode) == 0
        assert len(poses_of(output / "poses.txt")) == 2
        assert (output / "poses_filled.txt").exists() is has_file


def test_a_pose_of_a_rig_that_rests_on_no_photo_is_the_servers_fault(
    url: str, make_rig_dataset: Dataset, tmp_path: Path, service: Any, monkeypatch: Any
) -> None:
    answer = service.localize_instant

    def without_inliers(*asked: Any) -> Any:
        raw = answer(*asked)
        return raw | {"images": [image | {"inliers": 0} for image in raw["images"]]}

    monkeypatch.setattr(service, "localize_instant", without_inliers)
    dataset = make_rig_dataset(instants((HERE, HERE)))
    assert run_batch(dataset, tmp_path / "out", url, "gp3p") == 1


def test_a_photo_of_the_rig_that_is_missing_does_not_hinder_the_others(
    url: str, make_rig_dataset: Dataset, tmp_path: Path
) -> None:
    photos = instants((HERE, HERE), (HERE, HERE))
    del photos[START, "left"]
    dataset, output = make_rig_dataset(photos), tmp_path / "out"
    for name in (f"left-{START + 400}.jpg",):
        (dataset / "sensors" / "records_data" / name).unlink()
    assert run_batch(dataset, output, url, "gp3p") == 0
    lines = list(lines_of(output).values())
    assert [line["status"] for line in lines] == ["localized", "filled", "localized"]
    assert lines[1]["error"]["code"] == "image.unreadable"
    # Where a camera of a rig of the map sits is told with the answers to its photos only.
    output = tmp_path / "named"
    assert run_batch(dataset, output, url, "gp3p", "--rig", "stereo") == 0
    lines = list(lines_of(output).values())
    assert [line["status"] for line in lines] == ["localized", "error", "localized"]


def test_a_rig_of_the_map_stands_in_for_one_of_the_dataset(
    url: str, make_rig_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    dataset = make_rig_dataset(instants((HERE, b"blank")), rigs="")
    output = tmp_path / "out"
    assert run_batch(dataset, output, url, "gp3p", "--rig", "stereo") == 0
    assert [request["rig"] for request in service.seen] == ["stereo"]
    truth = truth_of(dataset)
    poses, filled = (poses_of(output / f"{file}.txt") for file in ("poses", "poses_filled"))
    assert (len(poses), len(filled)) == (1, 1)
    for name, pose in (poses | filled).items():
        assert pose_error(pose, truth[name]) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_an_instant_is_asked_about_again_when_one_of_its_photos_has_no_line(
    http_url: str, make_rig_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    dataset = make_rig_dataset(instants((HERE, HERE), (HERE, HERE), (HERE, b"crash")))
    output = tmp_path / "out"
    assert run_batch(dataset, output, http_url, "gp3p") == 0
    results = (output / "results.jsonl").read_bytes()
    poses = (output / "poses.txt").read_bytes()
    assert [line["status"] for line in lines_of(output).values()] == ["localized"] * 4 + [
        "error",
        "error",
    ]
    torn = results.splitlines(keepends=True)
    (output / "results.jsonl").write_bytes(b"".join(torn[:3]) + torn[4] + torn[5][:50])
    service.seen.clear()

    assert run_batch(dataset, output, http_url, "gp3p") == 0

    # The torn instant, and the one that the server failed on.
    assert [r["timestamp"] for r in service.seen] == [START + 400, START + 800]
    assert (output / "results.jsonl").read_bytes() == results
    assert (output / "poses.txt").read_bytes() == poses


def test_a_rerun_fills_anew_from_what_was_measured(
    http_url: str, make_rig_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    dataset, output = make_rig_dataset(instants((HERE, LOST))), tmp_path / "out"
    assert run_batch(dataset, output, http_url, "rig") == 0
    results = (output / "results.jsonl").read_bytes()
    service.seen.clear()
    assert run_batch(dataset, output, http_url, "rig") == 0
    assert service.seen == []
    assert (output / "results.jsonl").read_bytes() == results
    # Without the giver there is nothing to fill from.
    first, second = results.splitlines(keepends=True)
    entry = {"name": json.loads(first)["name"], "status": "not_localized", "pose": None}
    (output / "results.jsonl").write_bytes(json.dumps(entry).encode() + b"\n" + second)
    assert run_batch(dataset, output, http_url, "rig") == 0
    again = list(lines_of(output).values())[1]
    assert (again["status"], again["source"], again["pose"]) == ("not_localized", None, None)
    assert again["refusal"] == json.loads(second)["refusal"]
    assert (output / "poses.txt").read_bytes() == b""
    assert (output / "poses_filled.txt").read_bytes() == b""


def test_results_of_another_mode_are_not_mixed(
    http_url: str, make_rig_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset, output = make_rig_dataset(instants((HERE, LOST))), tmp_path / "out"
    assert run_batch(dataset, output, http_url, "seq") == 0
    for mode, more in (("single", ()), ("gp3p", ()), ("seq", ("--max-gap", 2))):
        assert run_batch(dataset, output, http_url, mode, *more) == 1
        assert "batch.other_run" in capsys.readouterr().err


# localize benchmark


def run_benchmark(dataset: Path, report: Path, url: str, *more: object) -> dict[str, Any]:
    command = ("--map", "room", "--report", report, "--server", url)
    assert localize("benchmark", dataset, *command, *more) == 0
    figures: dict[str, Any] = json.loads(report.read_bytes())
    return figures


def test_one_run_prints_all_modes_side_by_side(
    url: str,
    make_rig_dataset: Dataset,
    tmp_path: Path,
    service: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:
    dataset = make_rig_dataset(instants((HERE, LOST), (LOST, LOST), (HERE, HERE)))
    figures = run_benchmark(dataset, tmp_path / "r.json", url, "--mode", "all", "--concurrency", 2)

    modes = figures["modes"]
    assert list(modes) == ["single", "rig", "seq", "rig+seq", "gp3p"]
    assert [m["localized"] for m in modes.values()] == [3, 3, 3, 3, 4]
    assert [m["filled"] for m in modes.values()] == [0, 1, 3, 3, 0]
    assert [m["recall"][0]["fraction"] for m in modes.values()] == pytest.approx(
        [3 / 6, 4 / 6, 4 / 6, 1.0, 4 / 6]
    )
    counts = {
        mode: {source: of["poses"] for source, of in m["sources"].items()}
        for mode, m in modes.items()
    }
    assert counts["rig+seq"] == {"estimated": 3, "rig": 1, "interpolated": 2}
    assert counts["seq"] == {"estimated": 3, "interpolated": 1, "nearest": 2}
    stds = {source: of["median_position_std_m"] for source, of in modes["seq"]["sources"].items()}
    assert stds["interpolated"] > stds["estimated"]
    assert modes["gp3p"]["instants"] == {"asked": 3, "localized": 2}
    assert modes["single"]["instants"] is None
    for m in modes.values():
        percentiles = list(m["position_error_m"].values())
        assert list(m["position_error_m"]) == ["p50", "p75", "p90", "max"]
        assert percentiles == sorted(percentiles)
        assert m["position_error_m"]["p50"] == m["median_position_error_m"]
        assert m["latency_s"]["p50"] > 0
    # At the top, the first mode; each photo was asked about once on its own, and once in a rig.
    assert figures["localized"] == 3
    assert figures["recall"] == modes["single"]["recall"]
    assert sum("images" not in request for request in service.seen) == 6
    assert sum("images" in request for request in service.seen) == 3

    out = capsys.readouterr().out
    header = next(line for line in out.splitlines() if "gp3p" in line)
    assert all(mode in header for mode in modes)
    assert "3 of 6 localized (single)" in out
    assert "2 of 3" in out
    assert all(len(line) <= 80 for line in out.splitlines()[1:])
    assert "within 0.05 m, 5°" in out
    assert "an instant" in out


def test_only_what_is_needed_is_asked_about(
    http_url: str, make_rig_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    dataset = make_rig_dataset(instants((HERE, HERE)))
    figures = run_benchmark(dataset, tmp_path / "r.json", http_url, "--mode", "gp3p")
    assert list(figures["modes"]) == ["gp3p"]
    assert figures["queries"] == 2
    assert figures["throughput_qps"] > 0
    assert figures["stage_seconds"] == {"features": 0.5, "pose": 0.25}
    assert len(service.seen) == 1
    service.seen.clear()
    poses = tmp_path / "poses.txt"
    run_benchmark(
        *(dataset, tmp_path / "r.json", http_url, "--mode", "rig", "--mode", "single"),
        *("--poses", poses),
    )
    assert len(service.seen) == 2
    assert len(poses_of(poses)) == 2


def test_the_poses_of_a_benchmark_are_those_that_were_measured(
    url: str, make_rig_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = make_rig_dataset(instants((HERE, b"blank"), (BROKEN, HERE), (LOST, LOST)))
    poses = tmp_path / "poses.txt"
    for mode in ("gp3p", "seq"):
        more = ("--mode", f"{mode},rig", "--poses", poses)
        figures = run_benchmark(dataset, tmp_path / "r.json", url, *more)["modes"][mode]
        assert len(poses_of(poses)) == figures["localized"]
        assert figures["filled"] > 0
        if mode == "gp3p":
            counts = {source: of["poses"] for source, of in figures["sources"].items()}
            assert counts == {"estimated": 2, "rig": 2}
            assert figures["instants"] == {"asked": 3, "localized": 2}
            assert figures["recall"][0]["fraction"] == pytest.approx(4 / 6)
            assert "filled, rig" in capsys.readouterr().out


def test_no_answer_at_all_is_no_figure(
    http_url: str, make_rig_dataset: Dataset, tmp_path: Path
) -> None:
    dataset = make_rig_dataset(instants((BROKEN, BROKEN)))
    figures = run_benchmark(dataset, tmp_path / "r.json", http_url, "--mode", "all")
    for m in figures["modes"].values():
        assert m["position_error_m"] is None
        assert m["median_position_error_m"] is None
        assert m["sources"] == {}
    assert figures["modes"]["gp3p"]["instants"] == {"asked": 1, "localized": 0}


def test_a_wrong_mode_is_refused_before_anything_runs(
    http_url: str,
    make_rig_dataset: Dataset,
    tmp_path: Path,
    service: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:
    dataset = make_rig_dataset({(0, "left"): HERE, (1, "left"): HERE}, rigs="")
    command = ("--map", "room", "--report", tmp_path / "r.json", "--server", http_url, "--mode")
    for mode, code in (("pnp", "mode.unknown"), ("all", "queries.no_rigs"), ("seq", "time_unit")):
        assert localize("benchmark", dataset, *command, mode) == 1
        assert code in capsys.readouterr().err
    assert service.seen == []
