from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients import AsyncClient, Client
from clients.cli.main import main
from visloc.errors import Unavailable


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"photo")
    return path


def localize(*arguments: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([*map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


def test_the_matches_and_their_picture_come_with_the_answer(url: str, photo: Path) -> None:
    with Client(url) as client:
        debug = client.localize(photo, "room", debug=True).debug

    assert debug is not None
    np.testing.assert_array_equal(debug.keypoints, [[1.5, 2.0], [3.0, 0.1 + 0.2]])
    np.testing.assert_array_equal(debug.points, [[1.0, 2.0, 3.0], [1e6, -5e6, 1 / 3]])
    np.testing.assert_array_equal(debug.inliers, [True, False])
    assert debug.overlay == bytes(range(256))


def test_an_event_loop_gets_them_too(url: str, photo: Path) -> None:
    async def ask() -> Any:
        async with AsyncClient(url) as client:
            return await client.localize(photo, "room", debug=True)

    assert asyncio.run(ask()).debug.inliers.tolist() == [True, False]


def test_both_doors_give_the_same_answer(http_url: str, grpc_url: str, photo: Path) -> None:
    raw = []
    for address in (http_url, grpc_url):
        with Client(address) as client:
            raw.append(client.localize(photo, "room", request_id="a", debug=True).raw["debug"])

    assert raw[0] == raw[1]
    json.dumps(raw[1])


def test_matches_are_not_asked_for_unless_wanted(url: str, photo: Path, service: Any) -> None:
    with Client(url) as client:
        assert client.localize(photo, "room").debug is None
    assert "debug" not in service.seen[0]


def test_the_command_writes_the_picture_localized_or_not(
    url: str, photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for content, code in ((b"photo", 0), (b"refuse", 3)):
        photo.write_bytes(content)
        picture = tmp_path / f"{code}.jpg"

        found = localize("image", photo, "--map", "room", "--server", url, "--debug", picture)

        assert found == code
        assert picture.read_bytes() == bytes(range(256))
        assert picture.name in "".join(capsys.readouterr().out.split())


def test_a_picture_that_cannot_be_written_is_found_before_the_server_is_asked(
    http_url: str,
    photo: Path,
    tmp_path: Path,
    service: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:
    picture = tmp_path / "absent" / "picture.jpg"

    code = localize("image", photo, "--map", "room", "--server", http_url, "--debug", picture)

    assert code == 1
    assert capsys.readouterr().err.startswith("error [output.folder] ")
    assert service.seen == []


def test_a_server_that_does_not_draw_is_told(
    url: str, photo: Path, tmp_path: Path, service: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    service.draws = False
    picture = tmp_path / "picture.jpg"

    code = localize("image", photo, "--map", "room", "--server", url, "--debug", picture)

    assert code == 1
    assert "error [server.answer]" in capsys.readouterr().err
    assert not picture.exists()


@pytest.mark.parametrize(
    "damage",
    [{"overlay": "?"}, {"keypoints": [1.0]}, {"inliers": [True]}, {"points": None}],
)
def test_matches_that_do_not_fit_are_the_servers_fault(
    http_url: str,
    photo: Path,
    service: Any,
    monkeypatch: pytest.MonkeyPatch,
    damage: dict[str, Any],
) -> None:
    canned = service.localize

    def damaged(*given: Any) -> Any:
        answer = canned(*given)
        return answer | {"debug": answer["debug"] | damage}

    monkeypatch.setattr(service, "localize", damaged)
    with Client(http_url) as client, pytest.raises(Unavailable) as caught:
        client.localize(photo, "room", debug=True)

    assert caught.value.code == "server.answer"
