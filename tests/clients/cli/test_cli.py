from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from clients.cli.main import main
from tests.clients.conftest import POSE


def localize(*arguments: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([*map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"photo")
    return path


def test_a_photo_gives_a_readable_answer(
    url: str, photo: Path, capsys: pytest.CaptureFixture[str], service: Any
) -> None:
    code = localize(
        *("image", photo, "--map", "room", "--server", url),
        *("--camera", "PINHOLE,640,480,525,525,320,240", "--option", "read_as=stored"),
    )
    assert code == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["localized", "in", "room@v1"]
    answer = {line[:14].strip(): line[15:] for line in lines}
    assert answer["position"] == "1 0.3 -3.5 m, std 0.004 0.005 0.3333"
    assert answer["inliers"].startswith("311 of 700 correspondences (44%)")
    assert answer["retrieved 1"] == "seq/1.jpg  0.750  (densevlad 0.143)"
    assert answer["camera"] == "PINHOLE 640 x 480  525 525 320 240  (as given)"
    assert answer["orientation"].startswith("EXIF 6")
    assert "features 0.250" in answer["seconds"]
    assert service.seen[0]["options"] == {"read_as": "stored"}


def test_weights_are_names_and_numbers(http_url: str, photo: Path, service: Any) -> None:
    weights = "fusion_weights=densevlad=1, kapture:AP-GeM=0.5"
    code = localize("image", photo, "--map", "room", "--server", http_url, "--option", weights)

    assert code == 0
    assert service.seen[0]["options"] == {
        "fusion_weights": {"densevlad": 1.0, "kapture:AP-GeM": 0.5}
    }


def test_both_places_of_an_ambiguous_photo_are_printed(
    url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = tmp_path / "door.jpg"
    photo.write_bytes(b"refuse both")

    localize("image", photo, "--map", "room", "--server", url)

    lines = {line[:14].strip(): line[15:] for line in capsys.readouterr().out.splitlines()}
    assert lines["either"] == (
        "1 0.25 -3.5 in room@v1, turned 1 0 0 0: 60 inliers, most like door [1].jpg, "
        "preferred by +0.5 deviations"
    )
    assert lines["or"] == "9 0.25 -3.5 in shed@v1, turned 0 1 0 0: 40 inliers"


def test_a_photo_that_is_not_localized_has_its_own_exit_code_and_says_why(
    url: str, photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo.write_bytes(b"refuse")
    assert localize("image", photo, "--map", "room", "--server", url) == 3
    out = capsys.readouterr().out
    assert "not localized  3 [matches]" in out
    assert "matching (too_few_matches)" in out
    assert "position" not in out


@pytest.mark.parametrize(
    ("metric", "unit"), [(True, "m"), (False, "units of the map"), (None, "units of the map")]
)
def test_a_pose_is_printed_in_the_unit_that_its_answer_tells(
    metric: bool | None,
    unit: str,
    url: str,
    photo: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(POSE, "metric", metric)
    assert localize("image", photo, "--map", "room", "--server", url) == 0
    assert f"1 0.3 -3.5 {unit}, std" in capsys.readouterr().out


def test_json_is_the_answer_as_received(
    url: str, photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert localize("image", photo, "--map", "room", "--server", url, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "localized"
    assert answer["pose"]["position"] == [1.0, 0.1 + 0.2, -3.5]
    assert answer["refusal"] is None


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--camera", "PINHOLE,640,480,525"), "camera.param_count"),
        (("--camera", "PINHOLE"), "camera.syntax"),
        (("--camera", ""), "camera.syntax"),
        (("--map", "hall"), "map.unknown"),
        (("--map", ""), "map.id"),
        (("--server", "localhost:8000"), "server.url"),
        (("--server", "http://[:]:80"), "server.url"),
        (("--server", "http://a..b:80"), "server.url"),
        (("--server", "http://127.0.0.1:1"), "server.unreachable"),
        (("--server", "grpc://127.0.0.1:1"), "server.unreachable"),
        (("--option", "top_k=1.5"), "options.top_k"),
        *(
            (("--option", f"fusion_weights={text}"), "options.fusion_weights")
            for text in ("", "vlad", "vlad=", "=1", "a=1,", "a=1,a=2", "a=nan", "a=1=x", "a:1")
        ),
    ],
)
def test_an_error_is_one_clear_line(
    arguments: tuple[str, ...],
    code: str,
    http_url: str,
    photo: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert localize("image", photo, "--map", "room", "--server", http_url, *arguments) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"error [{code}] ")
    assert captured.err.count("\n") == 1


def test_text_from_elsewhere_cannot_paint_the_terminal(
    http_url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "\x1b[31mred [bold].jpg"
    assert localize("image", path, "--map", "room", "--server", http_url) == 1
    error = capsys.readouterr().err
    assert "\x1b" not in error
    assert "[bold].jpg" in error


@pytest.mark.parametrize("arguments", [("image",), ("sing",), ("batch", "x", "--concurrency", "0")])
def test_wrong_usage_exits_with_2(
    arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert localize(*arguments) == 2
    assert "Usage" in capsys.readouterr().err


def test_the_clients_load_no_vision_library() -> None:
    code = (
        "import sys, clients.cli.main\n"
        "print([m for m in ('torch', 'cv2', 'pycolmap', 'PIL', 'scipy') if m in sys.modules])"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
