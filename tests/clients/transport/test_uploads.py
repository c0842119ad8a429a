"""Packed maps as the clients read them."""

from __future__ import annotations

import asyncio
import json
import zipfile
from pathlib import Path
from typing import Any

import pytest

from clients.transport.uploads import pieces, pieces_async, upload_request
from visloc.errors import InvalidInput


def packed(path: Path, manifest: object, kind: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", kind) as archive:
        archive.writestr("manifest.json", json.dumps(manifest))
    return path


def test_names_that_are_not_given_are_those_of_the_file(tmp_path: Path) -> None:
    file = packed(tmp_path / "m.zip", {"id": "room", "version": "v1"})

    upload = upload_request(file, None, None)
    assert (upload.map_id, upload.version) == ("room", "v1")
    assert upload.size_bytes == file.stat().st_size
    upload = upload_request(file, None, "v2")
    assert (upload.map_id, upload.version) == ("room", "v2")


@pytest.mark.parametrize(
    "manifest", [{}, [], 3, "x", {"id": "room"}, {"id": 1, "version": 2}, {"id": None}]
)
def test_a_manifest_without_names_is_refused(manifest: Any, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput) as caught:
        upload_request(packed(tmp_path / "m.zip", manifest), None, None)
    assert caught.value.code == "packed.manifest"


@pytest.mark.parametrize("names", [("..", "v"), ("a/b", "v"), ("a", "../v"), ("", "v"), ("a", "")])
def test_names_that_are_paths_are_not_sent(names: tuple[str, str], tmp_path: Path) -> None:
    file = packed(tmp_path / "m.zip", {"id": names[0], "version": names[1]})
    with pytest.raises(InvalidInput) as caught:
        upload_request(file, None, None)
    assert caught.value.code == "map.id"


def test_a_manifest_of_any_size_is_not_read(tmp_path: Path) -> None:
    huge = {"id": "room", "version": "v", "notes": "x" * 17_000_000}
    with pytest.raises(InvalidInput) as caught:
        upload_request(packed(tmp_path / "m.zip", huge, zipfile.ZIP_DEFLATED), None, None)
    assert caught.value.code == "packed.manifest"
    assert caught.value.got == "a manifest of 17000043 bytes"


@pytest.mark.parametrize("content", [b"", b"PK", b"hello" * 1000])
def test_what_is_no_archive_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "m.zip").write_bytes(content)
    with pytest.raises(InvalidInput) as caught:
        upload_request(tmp_path / "m.zip", None, None)
    assert caught.value.code == "packed.manifest"


@pytest.mark.parametrize("name", ["missing.zip", "."])
def test_what_cannot_be_read_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput) as caught:
        upload_request(tmp_path / name, None, None)
    assert caught.value.code == "packed.unreadable"
    with pytest.raises(InvalidInput) as caught:
        upload_request(tmp_path / name, "room", "v1")
    assert caught.value.code == "packed.unreadable"


def test_all_pieces_together_are_the_file(tmp_path: Path) -> None:
    content = bytes(range(256)) * 5000
    (tmp_path / "m.zip").write_bytes(content)
    upload = upload_request(tmp_path / "m.zip", "room", "v1")
    sent: list[int] = []

    assert b"".join(pieces(upload, sent.append)) == content
    assert sum(sent) == len(content)

    async def collect() -> bytes:
        return b"".join([piece async for piece in pieces_async(upload, sent.append)])

    assert asyncio.run(collect()) == content
    assert sum(sent) == 2 * len(content)


def test_what_is_appended_meanwhile_is_not_sent(tmp_path: Path) -> None:
    file = tmp_path / "m.zip"
    file.write_bytes(b"x" * 1000)
    upload = upload_request(file, "room", "v1")
    file.write_bytes(b"x" * 2000)

    assert b"".join(pieces(upload, lambda _: None)) == b"x" * 1000


def test_a_large_map_has_more_time() -> None:
    from clients.transport.uploads import Upload

    assert Upload(Path(), "room", "v1", 0).verified_within_s(60) == 60
    assert Upload(Path(), "room", "v1", 10**9).verified_within_s(60) == pytest.approx(160)
    assert Upload(Path(), "room", "v1", 10**9).done_within_s(60) == pytest.approx(10_160)
