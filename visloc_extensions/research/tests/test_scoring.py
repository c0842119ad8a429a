"""``localize evaluate`` against a script of its own, which shares no code with it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clients.cli.main import main
from clients.evaluation.pairs import of_photos
from visloc.errors import DatasetError, InvalidInput
from visloc_extensions.research.evaluation.pose_files import read_poses
from visloc_extensions.research.evaluation.scoring import read_conditions

Lines = dict[str, list[float]]
BINS = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))


def evaluate(*arguments: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["evaluate", *map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


def scene(seed: int, names: list[str]) -> tuple[Lines, Lines]:
    """True poses, and estimated ones from millimetres to metres off; each seventh is missing."""
    rng = np.random.default_rng(seed)
    truth: Lines = {}
    poses: Lines = {}
    for number, name in enumerate(names):
        rotation = Rotation.random(random_state=rng)
        center = rng.normal(scale=20.0, size=3)
        truth[name] = _line(rotation, center)
        if number % 7:
            size = 10.0 ** rng.uniform(-3, 1)
            turn = Rotation.from_rotvec(rng.normal(size=3) * np.radians(3.0) * size)
            # Quaternions of other tools are neither normalized nor of one sign.
            line = np.array(_line(turn * rotation, center + rng.normal(size=3) * size))
            line[:4] *= rng.choice([-3.0, 0.5])
            poses[name] = line.tolist()
    return truth, poses


def _line(rotation: Rotation, center: np.ndarray) -> list[float]:
    x, y, z, w = rotation.as_quat()
    return [float(value) for value in (w, x, y, z, *-rotation.apply(center))]


def write(path: Path, lines: Lines) -> Path:
    rows = (f"{name} {' '.join(map(repr, numbers))}\n" for name, numbers in lines.items())
    path.write_text("# poses\n\n" + "".join(rows))
    return path


def independent(poses: Path, truth: Path, only: Callable[[str], bool]) -> dict[str, Any]:
    """The same figures from the same files, by another way."""

    def read(path: Path) -> dict[str, tuple[Rotation, np.ndarray]]:
        rows = [line.split() for line in path.read_text().splitlines() if line[:1] not in ("", "#")]
        found = {}
        for name, w, x, y, z, *t in rows:
            rotation = Rotation.from_quat([float(v) for v in (x, y, z, w)])
            found[name] = rotation, -rotation.inv().apply([float(v) for v in t])
        return found

    given = read(poses)
    errors = []
    for name, (rotation, center) in read(truth).items():
        if only(name) and name in given:
            turn, place = given[name]
            difference = (turn * rotation.inv()).magnitude()
            errors.append((float(np.sqrt(((place - center) ** 2).sum())), np.degrees(difference)))
        elif only(name):
            errors.append((np.inf, np.inf))
    table = np.array(errors)
    known = table[np.isfinite(table[:, 0])]
    return {
        "photos": len(table),
        "with_pose": len(known),
        "recall": [float(np.mean((table[:, 0] <= m) & (table[:, 1] <= d))) for m, d in BINS],
        "medians": [float(np.median(known[:, 0])), float(np.median(known[:, 1]))],
        "of_all": [float(np.sort(table[:, i])[len(table) // 2]) for i in (0, 1)],  # odd numbers
    }


def same(figures: dict[str, Any], wanted: dict[str, Any]) -> None:
    assert figures["photos"] == wanted["photos"]
    assert figures["with_pose"] == wanted["with_pose"]
    assert [each["fraction"] for each in figures["recall"]] == wanted["recall"]
    medians = [figures["median_position_error_m"], figures["median_orientation_error_deg"]]
    of_all = [figures[f"median_{name}"] for name in _OF_ALL]
    assert medians == pytest.approx(wanted["medians"], rel=1e-11)
    assert of_all == pytest.approx(wanted["of_all"], rel=1e-11)


_OF_ALL = ("position_error_of_all_m", "orientation_error_of_all_deg")


def test_figures_equal_those_of_an_independent_script(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [
        [f"{c}/night/{i}.jpg" if i % 3 else f"{c}/day/{i}.jpg" for i in range(201)] for c in "ab"
    ]
    files = []
    for number, photos in enumerate(names):
        truth, poses = scene(number, photos)
        files.append(
            (
                write(tmp_path / f"poses{number}.txt", poses),
                write(tmp_path / f"truth{number}.txt", truth),
            )
        )
    report = tmp_path / "report.json"

    code = evaluate(
        *(poses for poses, _ in files),
        *(text for _, truth in files for text in ("--truth", truth)),
        *("--condition", "day=*/day/*", "--condition", "night=*/night/*", "--report", report),
    )

    assert code == 0
    figures = json.loads(report.read_bytes())
    parts = []
    for row, (poses, truth) in zip(figures["scenes"], files, strict=True):
        same(row, independent(poses, truth, lambda _: True))
        assert list(row["conditions"]) == ["day", "night"]
        for name, part in row["conditions"].items():
            wanted = independent(poses, truth, lambda photo, n=name: f"/{n}/" in photo)
            wanted.pop("of_all")
            parts.append(wanted)
            assert [each["fraction"] for each in part["recall"]] == wanted["recall"]
            assert part["median_position_error_m"] == pytest.approx(wanted["medians"][0], rel=1e-11)
    average = figures["average"]
    assert average["rows"] == 4
    means = np.mean([part["recall"] for part in parts], axis=0)
    assert [each["fraction"] for each in average["recall"]] == pytest.approx(means, rel=1e-14)
    assert average["recall_of_all_thresholds"] == pytest.approx(means.mean(), rel=1e-14)
    out = capsys.readouterr().out
    first = independent(*files[0], lambda _: True)
    assert f"{first['medians'][0]:.4f} m" in out
    assert f"{first['recall'][3]:.1%}" in out


def test_a_benchmark_and_the_poses_that_it_wrote_have_the_same_figures(
    http_url: str, make_dataset: Callable[..., Path], tmp_path: Path
) -> None:
    rng = np.random.default_rng(3)
    photos = {
        f"a/{i} b.jpg": json.dumps(
            {
                "rotation_wxyz": rng.normal(size=4).tolist(),
                "translation": rng.normal(size=3).tolist(),
            }
        ).encode()
        for i in range(9)
    }
    dataset = make_dataset(photos | {"a/lost.jpg": b"refuse"})
    asked = ["--map", "room", "--server", http_url]
    for command in (
        ["benchmark", "--report", str(tmp_path / "b.json"), "--poses", str(tmp_path / "poses.txt")],
        ["batch", "--output", str(tmp_path / "batch")],
    ):
        with pytest.raises(SystemExit):
            main([command[0], str(dataset), *asked, *command[1:]])
    wanted = json.loads((tmp_path / "b.json").read_bytes())["modes"]["single"]

    for poses in (tmp_path / "poses.txt", tmp_path / "batch"):
        report = tmp_path / "e.json"
        assert evaluate(poses, "--truth", dataset, "--report", report) == 0
        (found,) = json.loads(report.read_bytes())["scenes"]
        for name in ("recall", "position_error_m", "orientation_error_deg"):
            assert found[name] == wanted[name]
        # Only the answers have covariances.
        assert found["calibration"] == (wanted["calibration"] if poses.is_dir() else None)
    assert wanted["calibration"] is not None


def test_conditions_of_a_file_are_those_of_the_patterns(tmp_path: Path) -> None:
    listed = tmp_path / "conditions.txt"
    listed.write_text("# by hand\na/1.jpg, day\na/2.jpg night\nb/9.jpg night\n")
    photos = ["a/1.jpg", "a/2.jpg", "a/3.jpg"]

    split = read_conditions(["late=*[23].jpg"], listed).split(photos)

    assert split == {"late": ["a/2.jpg", "a/3.jpg"], "day": ["a/1.jpg"], "night": ["a/2.jpg"]}


def test_a_name_stands_for_the_photo_whose_path_ends_with_it() -> None:
    photos = ["db/a b.jpg", "night/rear/1.jpg", "night/left/1.jpg"]

    found, unknown = of_photos({"a%20b.jpg": 1, "rear/1.jpg": 2, "x.jpg": 3}, photos)

    assert (found, unknown) == ({"db/a b.jpg": 1, "night/rear/1.jpg": 2}, 1)
    with pytest.raises(DatasetError) as ambiguous:
        of_photos({"1.jpg": 1}, photos)
    assert ambiguous.value.code == "poses.ambiguous"
    with pytest.raises(DatasetError) as twice:
        of_photos({"rear/1.jpg": 1, "night/rear/1.jpg": 2}, photos)
    assert twice.value.code == "poses.duplicate"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("a b.jpg 1 0 0 0 0 0 0\n", "poses.line"),
        ("a.jpg 1 0 0 0 0 0\n", "poses.line"),
        ("a.jpg 1 0 0 x 0 0 0\n", "poses.line"),
        ("a.jpg 1 0 0 nan 0 0 0\n", "pose.rotation"),
        ("a.jpg 0 0 0 0 0 0 0\n", "pose.rotation"),
        ("a.jpg 1 0 0 0 0 inf 0\n", "pose.translation"),
        ("a.jpg 1 0 0 0 0 0 0\na.jpg 1 0 0 0 0 0 1\n", "poses.duplicate"),
        ("\xff", "poses.unreadable"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, text: str, code: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DatasetError) as caught:
        read_poses(path)
    assert caught.value.code == code
    assert str(path) in (caught.value.field or "")


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["missing.txt", "--truth", "truth.txt"], "poses.missing"),
        (["poses.txt", "--truth", "empty.txt"], "evaluation.no_truth"),
        (["poses.txt", "--truth", "others.txt"], "evaluation.names"),
        (["poses.txt", "poses.txt", "--truth", "truth.txt"], "evaluation.scenes"),
        (["poses.txt", "--truth", "truth.txt", "--condition", "day"], "conditions.syntax"),
        (["poses.txt", "--truth", "truth.txt", "--condition", "x=y*"], "conditions.empty"),
        (["poses.txt", "--truth", "truth.txt", "--conditions", "poses.txt"], "conditions.line"),
        (["poses.txt", "--truth", "truth.txt", "--conditions", "no.txt"], "conditions.unreadable"),
    ],
)
def test_what_cannot_be_scored_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write(Path("poses.txt"), {"a.jpg": [1, 0, 0, 0, 0, 0, 0]})
    write(Path("truth.txt"), {"a.jpg": [1, 0, 0, 0, 0, 0, 1]})
    write(Path("others.txt"), {"b.jpg": [1, 0, 0, 0, 0, 0, 1]})
    write(Path("empty.txt"), {})

    assert evaluate(*arguments) == 1
    assert f"[{code}]" in capsys.readouterr().err


def test_poses_without_a_finite_error_are_reported_as_wrong(tmp_path: Path) -> None:
    truth = write(tmp_path / "truth.txt", {n: [1.0, 0, 0, 0, 0, 0, 0] for n in ("a.jpg", "b.jpg")})
    far = write(tmp_path / "far.txt", {"a.jpg": [1.0, 0, 0, 0, 1e308, 1e308, 1e308]})
    report = tmp_path / "report.json"
    assert evaluate(far, "--truth", truth, "--report", report) == 0
    scene = json.loads(report.read_bytes())["scenes"][0]
    assert scene["position_error_m"] == {"p50": None, "p75": None, "p90": None, "max": None}
    assert [each["fraction"] for each in scene["recall"]] == [0.0] * 4


@pytest.mark.parametrize(("variance", "ratio"), [(0.0, None), (1e308, 0.0)])
def test_covariances_of_any_size_are_reported(
    tmp_path: Path, variance: float, ratio: float | None
) -> None:
    pose = {
        "cam_from_world": {"rotation_wxyz": [1.0, 0, 0, 0], "translation": [1.0, 0, 0]},
        "position": [-1.0, 0, 0],
        "orientation": [1.0, 0, 0, 0],
        "covariance": (variance * np.eye(6)).ravel().tolist(),
        "position_std": [0.0, 0, 0],
        "orientation_std_deg": [0.0, 0, 0],
    }
    line = {"name": "a.jpg", "status": "localized", "inliers": 30, "pose": pose}
    results = tmp_path / "results.jsonl"
    results.write_text(json.dumps(line) + "\n")
    truth = write(tmp_path / "truth.txt", {"a.jpg": [1.0, 0, 0, 0, 0, 0, 0]})
    report = tmp_path / "report.json"
    assert evaluate(results, "--truth", truth, "--report", report) == 0
    scene = json.loads(report.read_bytes())["scenes"][0]
    assert scene["calibration"]["median_ratio"] == ratio


def test_a_result_that_nests_too_deeply_is_named(tmp_path: Path) -> None:
    results = tmp_path / "results.jsonl"
    results.write_text("[" * 100_000 + "\n")
    with pytest.raises(DatasetError) as caught:
        read_poses(results)
    assert caught.value.code == "results.line"


def test_patterns_may_hold_an_equals_sign() -> None:
    assert read_conditions(["a=b=c*"], None).patterns == (("a", "b=c*"),)
    with pytest.raises(InvalidInput):
        read_conditions(["=b"], None)
