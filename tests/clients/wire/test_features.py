from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients import Features
from clients.cli.main import main
from visloc.errors import InvalidInput
from visloc.kapture import write_global_features, write_local_features

Dataset = Callable[..., Path]
KEYPOINTS = np.array([[10.25, 20.5], [63.0, 47.5], [1.0, 1.0]], np.float32)
DESCRIPTORS = np.arange(12, dtype=np.float32).reshape(3, 4)
VECTOR = np.array([0.5, -0.25], np.float32)


def array_of(sent: dict[str, Any]) -> np.ndarray[Any, Any]:
    """The array that a service receives."""
    data = base64.b64decode(sent["data"])
    return np.frombuffer(data, np.dtype(sent["dtype"]).newbyteorder("<")).reshape(sent["shape"])


# The type


def test_arrays_are_kept_and_written_little_endian() -> None:
    features = Features(
        "x",
        KEYPOINTS.astype(">f4"),
        np.asfortranarray(DESCRIPTORS.astype(np.int8)),
        {"g": VECTOR.astype(np.float64)},
    )
    sent = features.as_json()

    assert json.loads(json.dumps(sent)) == sent
    assert [sent[part]["dtype"] for part in ("keypoints", "descriptors")] == ["float32", "int8"]
    np.testing.assert_array_equal(array_of(sent["keypoints"]), KEYPOINTS)
    np.testing.assert_array_equal(array_of(sent["descriptors"]), DESCRIPTORS)
    assert sent["global_descriptors"]["g"]["dtype"] == "float32"
    np.testing.assert_array_equal(array_of(sent["global_descriptors"]["g"]), VECTOR)


@pytest.mark.parametrize(
    ("change", "code", "field"),
    [
        ({"keypoints": KEYPOINTS.T}, "features.keypoints", "features.keypoints"),
        ({"keypoints": np.zeros(4)}, "features.keypoints", "features.keypoints"),
        ({"keypoints": np.zeros((3, 2), int)}, "features.dtype", "features.keypoints"),
        ({"keypoints": [["a", "b"]]}, "features.dtype", "features.keypoints"),
        ({"keypoints": None}, "features.dtype", "features.keypoints"),
        ({"descriptors": DESCRIPTORS[1:]}, "features.descriptors", "features.descriptors"),
        ({"descriptors": DESCRIPTORS[0]}, "features.descriptors", "features.descriptors"),
        ({"descriptors": DESCRIPTORS > 0}, "features.dtype", "features.descriptors"),
        (
            {"global_descriptors": {"g": VECTOR[None]}},
            *("features.global_descriptors", "features.global_descriptors.g"),
        ),
        (
            {"global_descriptors": {"g": VECTOR.astype(complex)}},
            *("features.dtype", "features.global_descriptors.g"),
        ),
    ],
)
def test_what_cannot_be_sent_is_refused_when_it_is_made(
    change: dict[str, Any], code: str, field: str
) -> None:
    good: dict[str, Any] = {"keypoints": KEYPOINTS, "descriptors": DESCRIPTORS}
    with pytest.raises(InvalidInput) as caught:
        Features("x", **(good | change))
    assert (caught.value.code, caught.value.field) == (code, field)


# The commands


@pytest.fixture
def ready_made(service: Any) -> Any:
    """The canned service with a map of ready-made features."""
    service.local_features = "kapture:r2d2"
    service.global_features = ("kapture:gem", "localvlad")
    return service


def run(command: str, *arguments: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([command, *map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


def write_features(root: Path, name: str) -> None:
    write_local_features(root, "r2d2", name, KEYPOINTS, DESCRIPTORS, name="R2D2")
    write_global_features(root, "gem", name, VECTOR, name="AP-GeM")


def without_photos(dataset: Path) -> Path:
    for photo in (dataset / "sensors" / "records_data").iterdir():
        photo.unlink()
    return dataset


@pytest.mark.parametrize("features_dir", [False, True])
@pytest.mark.parametrize("origin", ["corner", "center"])
def test_a_batch_sends_the_features_of_a_dataset_without_its_photos(
    url: str,
    origin: str,
    features_dir: bool,
    ready_made: Any,
    make_dataset: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    dataset = without_photos(make_dataset({"a.jpg": b"", "b.jpg": b"", "c.jpg": b""}))
    elsewhere = tmp_path / "features"
    for name in ("a.jpg", "c.jpg"):
        write_features(elsewhere if features_dir else dataset, name)
    output = tmp_path / "out"
    more = ("--features-dir", elsewhere) if features_dir else ()
    command = (
        *("batch", dataset, "--map", "room", "--output", output, "--server", url),
        *("--pixel-origin", origin, *more),
    )

    assert run(*command) == 0

    shift = 0.5 if origin == "center" else 0.0
    assert len(ready_made.seen) == 2
    for seen in ready_made.seen:
        sent = seen["features"]
        assert sent["kind"] == "kapture:r2d2"
        np.testing.assert_array_equal(array_of(sent["keypoints"]), KEYPOINTS + shift)
        np.testing.assert_array_equal(array_of(sent["descriptors"]), DESCRIPTORS)
        assert sent["global_descriptors"].keys() == {"kapture:gem"}
        np.testing.assert_array_equal(array_of(sent["global_descriptors"]["kapture:gem"]), VECTOR)
        assert seen["camera"]["params"] == [60.0, 32.0 + shift, 24.0 + shift]
    lines = [json.loads(line) for line in (output / "results.jsonl").read_text().splitlines()]
    assert [line["status"] for line in lines] == ["localized", "error", "localized"]
    assert lines[1]["error"]["code"] == "kapture.feature_missing"
    assert "b.jpg" in lines[1]["error"]["field"]
    assert run(*command) == 0
    assert "3 of 3 are done already" in capsys.readouterr().err
    assert run(*command, "--pixel-origin", "corner" if shift else "center") == 1
    assert "batch.other_run" in capsys.readouterr().err


def test_a_benchmark_measures_features(
    url: str, ready_made: Any, make_dataset: Dataset, tmp_path: Path
) -> None:
    dataset = without_photos(make_dataset({"a.jpg": b""}))
    write_features(dataset, "a.jpg")
    report = tmp_path / "report.json"
    assert run("benchmark", dataset, "--map", "room", "--report", report, "--server", url) == 0
    figures = json.loads(report.read_text())
    assert (figures["localized"], figures["median_position_error_m"]) == (1, pytest.approx(0.0))
    assert figures["server"]["features"]["local"] == "kapture:r2d2"
    assert "features" in ready_made.seen[0]


@pytest.mark.parametrize("command", ["batch", "benchmark"])
@pytest.mark.parametrize("features_dir", [False, True])
def test_a_map_with_only_global_features_ready_made_takes_features(
    command: str,
    features_dir: bool,
    http_url: str,
    ready_made: Any,
    make_dataset: Dataset,
    tmp_path: Path,
) -> None:
    ready_made.local_features = "r2d2"
    dataset = make_dataset({"a.jpg": b"photo"})
    elsewhere = tmp_path / "features"
    write_features(elsewhere if features_dir else dataset, "a.jpg")
    target = ("--output" if command == "batch" else "--report", tmp_path / "out")
    more = ("--features-dir", elsewhere) if features_dir else ()
    assert run(command, dataset, "--map", "room", *target, "--server", http_url, *more) == 0
    (seen,) = ready_made.seen
    assert seen["features"]["kind"] == "r2d2"
    assert seen["features"]["global_descriptors"].keys() == {"kapture:gem"}


def test_descriptors_of_other_numbers_are_sent_as_float32_and_bytes_as_they_are(
    http_url: str, ready_made: Any, make_dataset: Dataset, tmp_path: Path
) -> None:
    dataset = make_dataset({"a.jpg": b""})
    for type_name, dtype in (("r2d2", np.uint8), ("other", np.float64), ("more", np.int32)):
        rows = DESCRIPTORS.astype(dtype)
        write_local_features(dataset, type_name, "a.jpg", KEYPOINTS, rows, name="x")
        ready_made.local_features = f"kapture:{type_name}"
        ready_made.global_features = ("localvlad",)
        report = tmp_path / "r.json"
        assert (
            run("benchmark", dataset, *("--map", "room", "--report", report), "--server", http_url)
            == 0
        )
    sent = [seen["features"]["descriptors"] for seen in ready_made.seen]
    assert [array["dtype"] for array in sent] == ["uint8", "float32", "float32"]
    for array in sent:
        np.testing.assert_array_equal(array_of(array), DESCRIPTORS)


def test_the_pixel_origin_counts_for_photos_and_lists_too(
    http_url: str, make_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    dataset = make_dataset({"a.jpg": b"photo"})
    photos = dataset / "sensors" / "records_data" / "list.txt"
    photos.write_text("a.jpg SIMPLE_PINHOLE 64 48 60 32 24\n")
    for number, source in enumerate((dataset, photos)):
        code = run(
            *("batch", source, "--map", "room", "--output", tmp_path / str(number)),
            *("--server", http_url, "--pixel-origin", "center"),
        )
        assert code == 0
    assert [s["camera"]["params"] for s in service.seen] == [[60.0, 32.5, 24.5]] * 2


@pytest.mark.parametrize("command", ["batch", "benchmark"])
@pytest.mark.parametrize(
    ("case", "code"),
    [
        ("list", "queries.no_features"),
        ("list, mixed map", "queries.no_features"),
        ("no features, mixed map", "kapture.no_features"),
        ("photo map", "queries.features_dir"),
        ("no features", "kapture.no_features"),
        ("no global features", "kapture.no_features"),
    ],
)
def test_what_cannot_be_asked_is_said_before_anything_is_sent(
    command: str,
    case: str,
    code: str,
    http_url: str,
    ready_made: Any,
    make_dataset: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source = make_dataset({"a.jpg": b"photo"})
    more: tuple[object, ...] = ()
    if case.endswith("mixed map"):
        ready_made.local_features = "xfeat"
    if case.startswith("list"):
        source = tmp_path / "list.txt"
        source.write_text("dataset/sensors/records_data/a.jpg\n")
    elif case == "photo map":
        ready_made.local_features, ready_made.global_features = "xfeat", ("densevlad",)
        more = ("--features-dir", tmp_path)
    elif case == "no global features":
        write_local_features(source, "r2d2", "a.jpg", KEYPOINTS, DESCRIPTORS, name="x")
    target = ("--output" if command == "batch" else "--report", tmp_path / "out")
    assert run(command, source, "--map", "room", *target, "--server", http_url, *more) == 1
    assert f"error [{code}]" in capsys.readouterr().err
    assert ready_made.seen == []
    assert not (tmp_path / "out").exists()


def test_a_dataset_without_intrinsics_fails_photo_by_photo(
    http_url: str, ready_made: Any, make_dataset: Dataset, tmp_path: Path
) -> None:
    dataset = make_dataset({"a.jpg": b""}, camera="UNKNOWN_CAMERA, 64, 48")
    write_features(dataset, "a.jpg")
    output = tmp_path / "out"
    assert run("batch", dataset, "--map", "room", "--output", output, "--server", http_url) == 0
    (line,) = (output / "results.jsonl").read_text().splitlines()
    assert json.loads(line)["error"]["code"] == "camera.required"
    assert ready_made.seen == []
