from __future__ import annotations

import json
import logging
import multiprocessing
import stat
from pathlib import Path
from typing import Any

import pytest

from service.keys import main
from service.security.key_file import Key, Scope, edited_keys, new_key, read_keys, split_token
from service.security.key_ring import KeyRing
from visloc.errors import InvalidInput


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "keys.json"


def run(capsys: pytest.CaptureFixture[str], path: Path, *arguments: str) -> str:
    main(["--file", str(path), *arguments])
    return capsys.readouterr().out.strip()


def stored(path: Path, *keys: Key) -> None:
    with edited_keys(path) as all_keys:
        all_keys.extend(keys)


def test_a_new_key_fits_its_own_secret_and_no_other() -> None:
    key, token = new_key("robot", frozenset({Scope.LOCALIZE}))
    parts = split_token(token)

    assert parts is not None
    id_, secret = parts
    assert (key.id, key.name, key.scopes) == (id_, "robot", frozenset({Scope.LOCALIZE}))
    assert key.fits(secret)
    assert not key.fits(secret[:-1] + ("A" if secret[-1] != "A" else "B"))
    assert not key.fits("")


def test_neither_secret_nor_token_is_in_the_file_and_nobody_else_may_read_it(path: Path) -> None:
    key, token = new_key("robot", frozenset(Scope), rate=2.5, burst=4, concurrency=3)
    stored(path, key)

    parts = split_token(token)
    assert parts is not None
    assert parts[1] not in path.read_text()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_keys(path) == (key,)
    assert [file.name for file in path.parent.iterdir()] == ["keys.json"]


FILE = """\
{
  "format": 1,
  "keys": [
    {
      "id": "7502a7f782ac",
      "name": "robot",
      "scopes": [
        "localize",
        "read"
      ],
      "created": "2026-11-22T23:03:00+00:00",
      "salt": "33ae4d00283e84ab155af03d593fcce1",
      "sha256": "52b1db749002e3246ea4ad795e83e7e985cedcf9b602d9b6287fb08bb193006f",
      "rate": 2.5,
      "burst": 4,
      "concurrency": null
    }
  ]
}
"""


def test_the_format_of_the_file_stays(path: Path) -> None:
    path.write_text(FILE)
    path.chmod(0o600)
    (robot,) = read_keys(path)
    copy = path.with_name("copy.json")
    stored(copy, robot)

    assert (robot.id, robot.scopes) == ("7502a7f782ac", {Scope.LOCALIZE, Scope.READ})
    assert (robot.rate, robot.burst, robot.concurrency) == (2.5, 4, None)
    assert (len(robot.salt), robot.sha256[:2]) == (16, b"\x52\xb1")
    assert copy.read_text() == FILE


def test_a_file_saved_by_an_editor_with_a_byte_order_mark_is_read(path: Path) -> None:
    key, _ = new_key("robot", frozenset({Scope.LOCALIZE}))
    stored(path, key)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert read_keys(path) == (key,)


def test_equal_secrets_would_have_different_hashes() -> None:
    (first, _), (second, _) = (new_key("robot", frozenset(Scope)) for _ in range(2))

    assert first.salt != second.salt
    assert first.sha256 != second.sha256
    assert first.id != second.id


@pytest.mark.parametrize(
    "token",
    ["", "visloc__", "visloc_0123456789ab_short", "Bearer x", f"visloc_{'AB' * 6}_{'a' * 43}"],
)
def test_what_has_not_the_form_of_a_key_is_none(token: str) -> None:
    assert split_token(token) is None


def test_the_command_makes_lists_limits_and_removes_keys(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    admin = run(capsys, path, "init")
    arguments = ["--scope", "localize", "--rate", "5", "--concurrency", "2"]
    robot = run(capsys, path, "add", "robot-1", *arguments)
    ring = KeyRing(path)

    known = ring.find(admin)
    assert known is not None
    assert (known.name, known.scopes, known.rate) == ("admin", frozenset(Scope), None)
    known = ring.find(robot)
    assert known is not None
    assert (known.rate, known.burst, known.concurrency) == (5.0, 5, 2)

    listed = run(capsys, path, "list")
    assert "admin" in listed
    assert "robot-1  localize  5/s, burst 5  2 at once" in listed
    assert admin not in listed
    run(capsys, path, "limit", "robot-1", "--rate", "0.5", "--burst", "10")
    known = ring.find(robot)
    assert known is not None
    assert (known.rate, known.burst, known.concurrency) == (0.5, 10, None)
    run(capsys, path, "remove", "robot-1")
    assert ring.find(robot) is None
    assert ring.find(admin) is not None


def test_init_makes_one_key_and_a_second_time_none(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    token = run(capsys, path, "init")
    before = path.read_bytes()

    assert "nothing was changed" in run(capsys, path, "init")
    assert path.read_bytes() == before
    assert split_token(token) is not None


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["add", "admin", "--scope", "read"], "a key with this name exists"),
        (["add", "a b", "--scope", "read"], "the name of the key is not valid"),
        (["add", "x", "--scope", "read", "--rate", "0"], "the limits of the key are out of range"),
        (
            ["add", "x", "--scope", "read", "--rate", "nan"],
            "the limits of the key are out of range",
        ),
        (["add", "x", "--scope", "read", "--burst", "3"], "the limits of the key are out of range"),
        (
            ["add", "x", "--scope", "read", "--concurrency", "-1"],
            "the limits of the key are out of range",
        ),
        (["limit", "nobody"], "no such key"),
        (["remove", "nobody"], "no such key"),
    ],
)
def test_what_cannot_be_is_one_line_and_changes_nothing(
    arguments: list[str], complaint: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, path, "init")
    before = path.read_bytes()
    with pytest.raises(SystemExit) as caught:
        run(capsys, path, *arguments)

    assert str(caught.value).startswith("visloc-keys: ")
    assert complaint in str(caught.value)
    assert path.read_bytes() == before


def test_a_scope_that_there_is_none_of_is_wrong_usage(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--file", str(path), "add", "x", "--scope", "everything"])

    assert caught.value.code == 2
    assert "localize" in capsys.readouterr().err


def changed(path: Path, change: dict[str, Any]) -> str:
    key, _ = new_key("robot", frozenset(Scope))
    stored(path, key)
    content = json.loads(path.read_text())
    content["keys"][0] |= change
    return json.dumps(content)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "[]",
        "{",
        '{"format": 2, "keys": []}',
        '{"format": 1, "keys": {}}',
        '{"format": 1, "keys": [1]}',
        '{"format": 1, "keys": [{}]}',
        "[" * 100_000,
        "\xff",
    ],
)
def test_a_file_that_is_none_of_keys_is_refused_by_name(path: Path, text: str) -> None:
    path.write_text(text, encoding="latin-1")
    path.chmod(0o600)

    with pytest.raises(InvalidInput) as caught:
        read_keys(path)
    assert caught.value.code == "keys.file"
    assert str(caught.value.field).startswith(str(path))


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"id": "../etc"}, "keys.file"),
        ({"name": "two\nlines"}, "keys.name"),
        ({"name": 3}, "keys.file"),
        ({"scopes": []}, "keys.scopes"),
        ({"scopes": ["all"]}, "keys.file"),
        ({"scopes": [["read"]]}, "keys.file"),
        ({"scopes": "read"}, "keys.file"),
        ({"salt": ""}, "keys.file"),
        ({"sha256": "00"}, "keys.file"),
        ({"sha256": "x" * 64}, "keys.file"),
        ({"rate": 1.0}, "keys.limit"),
        ({"rate": "1", "burst": 1}, "keys.limit"),
        ({"rate": float("nan"), "burst": 1}, "keys.limit"),
        ({"concurrency": 0}, "keys.limit"),
        ({"concurrency": True}, "keys.limit"),
        ({"comment": "mine"}, "keys.file"),
    ],
)
def test_an_entry_that_cannot_be_is_refused_by_its_place(
    path: Path, change: dict[str, Any], code: str
) -> None:
    path.write_text(changed(path, change))

    with pytest.raises(InvalidInput) as caught:
        read_keys(path)
    assert caught.value.code == code
    assert caught.value.field == f"{path}: keys[0]"


def test_the_same_key_or_name_twice_is_refused(path: Path) -> None:
    key, _ = new_key("robot", frozenset(Scope))
    stored(path, key)
    content = json.loads(path.read_text())
    content["keys"] *= 2
    path.write_text(json.dumps(content))

    with pytest.raises(InvalidInput, match="each id once"):
        read_keys(path)


def test_a_file_that_others_may_write_is_refused_and_the_way_out_is_told(path: Path) -> None:
    stored(path, new_key("robot", frozenset(Scope))[0])
    path.chmod(0o620)

    with pytest.raises(InvalidInput, match="chmod go-w") as caught:
        read_keys(path)
    assert caught.value.code == "keys.permissions"


def test_a_file_that_is_not_there_is_refused_with_how_to_make_one(path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"service\.keys init"):
        KeyRing(path)


def test_a_file_that_breaks_leaves_the_keys_good_and_says_so_once(
    path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    token = run(capsys, path, "init")
    ring = KeyRing(path)
    for spoil in (lambda: path.write_text("{"), path.unlink):
        spoil()
        caplog.clear()
        with caplog.at_level(logging.ERROR):
            assert ring.find(token) is not None
            assert ring.find(token) is not None
        assert [record.levelname for record in caplog.records] == ["ERROR"]
        assert str(path) in caplog.text
        assert token not in caplog.text


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored(path, new_key("robot", frozenset(Scope))[0])
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        stored(path, new_key("other", frozenset(Scope))[0])
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["keys.json"]


def _add(path: Path, name: str) -> None:
    for i in range(5):
        stored(path, new_key(f"{name}-{i}", frozenset(Scope))[0])


def test_keys_that_several_people_make_at_once_are_all_there(path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_add, args=(path, name)) for name in "ab"]
    for process in processes:
        process.start()
    for process in processes:
        process.join()

    assert len(read_keys(path)) == 10
