from __future__ import annotations

import errno
import io
import os
import random
import stat
import struct
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from visloc.archive import MapStore, verify_map
from visloc.archive import packed as packed_module
from visloc.archive.packed import MANIFEST, pack_map, unpack_map
from visloc.errors import InvalidInput, MapCorrupt, StorageFull, TooLarge, VislocError

Entries = dict[str, bytes]
LARGE = 2**30


@pytest.fixture(scope="session")
def packed(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    file = tmp_path_factory.mktemp("packed") / "room.zip"
    pack_map(MapStore(built_maps).folder("room"), file)
    return file.read_bytes()


def entries_of(packed: bytes) -> Entries:
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(entries: Entries, method: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return buffer.getvalue()


def start_of_list(packed: bytes) -> int:
    (start,) = struct.unpack_from("<I", packed, len(packed) - 6)
    return int(start)


def unpack(packed: bytes, folder: Path, max_bytes: int = LARGE) -> Path:
    file = folder / "upload.zip"
    file.write_bytes(packed)
    unpack_map(file, folder / "map", max_bytes)
    return folder / "map"


def refusal(packed: bytes, folder: Path, max_bytes: int = LARGE) -> VislocError:
    """The error, after a look that nothing lies outside the target."""
    with pytest.raises(VislocError) as caught:
        unpack(packed, folder, max_bytes)
    assert {path.name for path in folder.iterdir()} <= {"upload.zip", "map"}
    return caught.value


def files_in(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_packed_map_unpacks_to_the_same_files(
    packed: bytes, built_maps: Path, tmp_path: Path
) -> None:
    source = MapStore(built_maps).folder("room")

    unpacked = unpack(packed, tmp_path)

    assert files_in(unpacked) == files_in(source)
    assert verify_map(unpacked).manifest == verify_map(source).manifest


def test_equal_maps_are_packed_into_equal_bytes(
    packed: bytes, maps_dir: Path, tmp_path: Path
) -> None:
    folder = MapStore(maps_dir).folder("room")
    for path in folder.rglob("*"):
        path.chmod(0o700)
        os.utime(path, (1, 1))

    pack_map(folder, tmp_path / "again.zip")

    assert (tmp_path / "again.zip").read_bytes() == packed


def test_the_manifest_comes_first_so_that_a_reader_knows_soon_what_it_gets(packed: bytes) -> None:
    assert next(iter(entries_of(packed))) == MANIFEST


def test_only_a_whole_map_is_packed(maps_dir: Path, tmp_path: Path) -> None:
    folder = MapStore(maps_dir).folder("room")
    (folder / "landmarks.npy").unlink()

    with pytest.raises(MapCorrupt, match=r"landmarks\.npy"):
        pack_map(folder, tmp_path / "room.zip")


def test_files_that_the_manifest_does_not_list_are_not_packed(
    packed: bytes, maps_dir: Path, tmp_path: Path
) -> None:
    folder = MapStore(maps_dir).folder("room")
    (folder / "private.txt").write_text("not part of the map")

    pack_map(folder, tmp_path / "room.zip")

    assert (tmp_path / "room.zip").read_bytes() == packed


def test_an_archive_with_its_folders_and_other_times_is_read(packed: bytes, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.mkdir("global")
        for name, content in reversed(entries_of(packed).items()):
            archive.writestr(zipfile.ZipInfo(name, (2026, 1, 2, 3, 4, 6)), content)

    assert files_in(unpack(buffer.getvalue(), tmp_path)) == entries_of(packed)


def test_an_archive_with_numbers_of_64_bits_is_read(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 10)
    wide = zipped(entries_of(packed))

    assert b"PK\6\6" in wide
    assert files_in(unpack(wide, tmp_path)) == entries_of(packed)


@pytest.mark.parametrize(
    "name",
    [
        *("/etc/passwd", "../outside", "global/../../outside", "./landmarks.npy", "a//b"),
        *("\\outside", "global\\x", "C:x", "C:/x", ".hidden", "global/.hidden", "global/..", ".."),
        *("a" * 200, "a/b/c/d/e", "späße", "new\nline", "tab\t", "-option", " ", "a b", "~"),
    ],
)
def test_names_that_no_file_of_a_map_has_are_refused(
    packed: bytes, tmp_path: Path, name: str
) -> None:
    error = refusal(zipped({**entries_of(packed), name: b"x"}), tmp_path)

    assert error.code == "packed.entry"
    assert not (tmp_path / "map").exists()


def test_a_name_with_a_nul_is_refused(packed: bytes, tmp_path: Path) -> None:
    with_nul = zipped({**entries_of(packed), "landmarks_npy2": b"x"}).replace(
        b"landmarks_npy2", b"landmarks\0npy2"
    )

    assert refusal(with_nul, tmp_path).code == "packed.entry"


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFBLK, stat.S_IFDIR])
def test_links_and_special_files_are_refused(packed: bytes, tmp_path: Path, kind: int) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in entries_of(packed).items():
            entry = zipfile.ZipInfo(name)
            entry.external_attr = (
                0o644 | (kind if name == "landmarks.npy" else stat.S_IFREG)
            ) << 16
            archive.writestr(entry, content)

    error = refusal(buffer.getvalue(), tmp_path)

    assert (error.code, error.got) == ("packed.entry", "landmarks.npy")
    assert "link" in error.message


def test_an_entry_given_twice_is_refused(packed: bytes, tmp_path: Path) -> None:
    buffer = io.BytesIO(packed)
    with zipfile.ZipFile(buffer, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        archive.writestr("landmarks.npy", b"other")

    error = refusal(buffer.getvalue(), tmp_path)

    assert (error.code, error.got) == ("packed.entry", "landmarks.npy")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_compressed_entries_are_refused_whatever_size_they_tell(
    packed: bytes, tmp_path: Path, method: int
) -> None:
    error = refusal(zipped({**entries_of(packed), "bomb": bytes(10**6)}, method), tmp_path)

    assert error.code == "packed.entry"
    assert "compressed" in error.message


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("flags", 1, "encrypted"),
        ("flags", 1 << 6, "encrypted"),
        ("flags", 1 << 13, "encrypted"),
        ("flags", 1 << 3, "behind"),
        ("method", 99, "compressed"),
        ("packed", 1, "contradict"),
        ("size", 1, "contradict"),
        ("size", 0xFFFFFFFF, "contradict"),
        ("disk", 1, "contradict"),
        ("offset", 1, "overlap"),
        ("offset", 0xFFFFFFF0, "overlap"),
        ("name_length", 0, "Bad magic"),
        ("name_length", 0xFFFF, "name"),
        ("extra_length", 0xFFFF, "Corrupt extra"),
        ("comment_length", 1, "Bad magic"),
    ],
)
def test_lies_in_the_list_of_entries_are_refused(
    packed: bytes, tmp_path: Path, field: str, value: int, reason: str
) -> None:
    # offsets and formats within a record of the central directory
    places = {
        **{"flags": (8, "H"), "method": (10, "H"), "packed": (20, "I"), "size": (24, "I")},
        **{"name_length": (28, "H"), "extra_length": (30, "H"), "comment_length": (32, "H")},
        **{"disk": (34, "H"), "offset": (42, "I")},
    }
    place, kind = places[field]
    changed = bytearray(packed)
    struct.pack_into(f"<{kind}", changed, start_of_list(packed) + place, value)

    error = refusal(bytes(changed), tmp_path)

    assert error.code in ("packed.entry", "packed.format")
    assert reason in str(error)


@pytest.mark.parametrize(
    ("place", "kind"), [(6, "H"), (8, "H"), (18, "I"), (22, "I"), (26, "H"), (28, "H"), (30, "B")]
)
def test_a_header_that_contradicts_the_list_is_refused(
    packed: bytes, tmp_path: Path, place: int, kind: str
) -> None:
    changed = bytearray(packed)
    struct.pack_into(f"<{kind}", changed, place, 1)

    assert refusal(bytes(changed), tmp_path).code in ("packed.entry", "packed.format")


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda _: b"", id="empty"),
        pytest.param(lambda _: b"PK", id="two bytes"),
        pytest.param(lambda _: b"\0" * 100_000, id="zeros"),
        pytest.param(lambda whole: whole[: len(whole) // 2], id="half"),
        pytest.param(lambda whole: whole[:-1], id="last byte missing"),
        pytest.param(lambda whole: whole + b"\0", id="a byte more"),
        pytest.param(lambda whole: b"#!/bin/sh\n" + whole, id="something in front"),
        pytest.param(lambda whole: whole + whole, id="two archives"),
        pytest.param(lambda whole: whole[:-2] + b"\4\0test", id="comment"),
        pytest.param(lambda whole: whole[start_of_list(whole) :], id="list only"),
        pytest.param(lambda _: zipped({}), id="no entries"),
    ],
)
def test_what_is_not_one_whole_archive_is_refused(
    packed: bytes, tmp_path: Path, change: Callable[[bytes], bytes]
) -> None:
    error = refusal(change(packed), tmp_path)

    assert error.code in ("packed.format", "packed.files")
    assert not (tmp_path / "map").exists()


def test_bytes_hidden_between_entries_are_refused(packed: bytes, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in entries_of(packed).items():
            archive.writestr(zipfile.ZipInfo(name), content)
        archive.fp.seek(archive.start_dir)  # type: ignore[union-attr]
        archive.fp.write(b"hidden")  # type: ignore[union-attr]
        archive.start_dir += 6

    assert "belong to no entry" in str(refusal(buffer.getvalue(), tmp_path))


def test_entries_that_are_not_those_of_the_manifest_are_refused(
    packed: bytes, tmp_path: Path
) -> None:
    entries = entries_of(packed)

    error = refusal(zipped({**entries, "surplus.npy": b"x"}), tmp_path)
    assert (error.code, error.field) == ("packed.files", "surplus.npy")
    assert list((tmp_path / "map").iterdir()) == [tmp_path / "map" / MANIFEST]


def test_an_entry_that_is_missing_is_refused(packed: bytes, tmp_path: Path) -> None:
    entries = entries_of(packed)
    del entries["landmarks.npy"]

    error = refusal(zipped(entries), tmp_path)

    assert (error.code, error.field) == ("packed.files", "landmarks.npy")


def test_an_archive_without_a_manifest_is_refused(packed: bytes, tmp_path: Path) -> None:
    entries = entries_of(packed)
    del entries[MANIFEST]

    error = refusal(zipped(entries), tmp_path)

    assert (error.code, error.expected) == ("packed.files", "an entry manifest.json")


def test_an_entry_of_another_size_is_refused_before_it_is_written(
    packed: bytes, tmp_path: Path
) -> None:
    entries = {**entries_of(packed), "landmarks.npy": b"x"}

    error = refusal(zipped(entries), tmp_path)

    assert (error.code, error.field, error.got) == ("packed.files", "landmarks.npy", "1 bytes")


@pytest.mark.parametrize("name", ["other/", "global/deeper/", "landmarks.npy/"])
def test_folders_without_files_are_refused(packed: bytes, tmp_path: Path, name: str) -> None:
    error = refusal(zipped({**entries_of(packed), name: b""}), tmp_path)

    assert (error.code, error.got) == ("packed.entry", name)


def test_a_file_named_like_a_folder_is_refused(packed: bytes, tmp_path: Path) -> None:
    error = refusal(zipped({**entries_of(packed), "global": b""}), tmp_path)

    assert error.code == "packed.files"


def test_a_damaged_manifest_is_refused(packed: bytes, tmp_path: Path) -> None:
    error = refusal(zipped({**entries_of(packed), MANIFEST: b"{}"}), tmp_path)

    assert error.code == "map.manifest"


def test_a_manifest_that_is_too_large_for_its_files_is_not_read(
    packed: bytes, tmp_path: Path
) -> None:
    error = refusal(zipped({**entries_of(packed), MANIFEST: b"[" * 2**21}), tmp_path)

    assert isinstance(error, TooLarge)
    assert (error.code, error.field) == ("packed.too_large", MANIFEST)


def test_a_map_larger_than_allowed_is_refused_before_anything_is_written(
    packed: bytes, tmp_path: Path
) -> None:
    total = sum(len(content) for content in entries_of(packed).values())

    error = refusal(packed, tmp_path, total - 1)

    assert isinstance(error, TooLarge)
    assert (error.expected, error.got) == (f"at most {total - 1} bytes", f"{total} bytes")
    assert not (tmp_path / "map").exists()
    assert unpack(packed, tmp_path, total).is_dir()


def test_too_many_entries_are_refused_before_the_list_is_read(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packed_module, "MAX_ENTRIES", 3)

    error = refusal(packed, tmp_path)

    assert isinstance(error, TooLarge)
    assert error.expected is not None
    assert "at most 3" in error.expected


def test_a_list_of_entries_as_large_as_the_file_takes_no_memory(
    tmp_path: Path,
) -> None:
    # 1 GiB of zeros (a sparse file) that says it is all one list of entries
    file = tmp_path / "upload.zip"
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 60_000, 60_000, 2**30, 0, 0)
    with file.open("wb") as target:
        target.seek(2**30)
        target.write(end)

    tracemalloc.start()
    try:
        with pytest.raises(TooLarge):
            unpack_map(file, tmp_path / "map", LARGE)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("told", [1, 3])
def test_the_list_has_as_many_entries_as_the_end_says(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: int
) -> None:
    changed = bytearray(packed)
    struct.pack_into("<2H", changed, len(packed) - 14, told, told)
    monkeypatch.setattr(packed_module, "MAX_ENTRIES", told + 1 if told == 1 else LARGE)

    error = refusal(bytes(changed), tmp_path)

    assert error.code == "packed.format"
    assert "than it says" in str(error)
    assert not (tmp_path / "map").exists()


def test_memory_does_not_grow_with_the_files(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packed_module, "_BLOCK_BYTES", 2**12)
    largest = max(len(content) for content in entries_of(packed).values())
    (tmp_path / "upload.zip").write_bytes(packed)
    tracemalloc.start()
    try:
        unpack_map(tmp_path / "upload.zip", tmp_path / "map", LARGE)
        assert tracemalloc.get_traced_memory()[1] < largest / 2
    finally:
        tracemalloc.stop()


def test_an_existing_folder_is_not_written_into(packed: bytes, tmp_path: Path) -> None:
    (tmp_path / "upload.zip").write_bytes(packed)
    (tmp_path / "map").mkdir()

    with pytest.raises(FileExistsError):
        unpack_map(tmp_path / "upload.zip", tmp_path / "map", LARGE)


def test_a_full_disk_is_told_as_such(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)

    error = refusal(packed, tmp_path)

    assert isinstance(error, StorageFull)
    assert error.code == "maps.storage_full"


def test_every_random_change_is_refused_or_leaves_a_map_that_verification_judges(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: None)  # three hundred times, for the test's time
    rng = random.Random(0)
    directory = start_of_list(packed)
    headers = (info.header_offset for info in zipfile.ZipFile(io.BytesIO(packed)).infolist())
    structure = [
        *(place for start in headers for place in range(start, start + 60)),
        *range(directory, len(packed)),
    ]
    for number in range(300):
        changed = bytearray(packed)
        for _ in range(rng.randint(1, 3)):
            changed[rng.choice(structure)] = rng.choice((0, 1, 0x7F, 0xFF, rng.randrange(256)))
        folder = tmp_path / str(number)
        folder.mkdir()
        try:
            unpacked = unpack(bytes(changed), folder)
        except (InvalidInput, MapCorrupt):
            assert {path.name for path in folder.iterdir()} <= {"upload.zip", "map"}
            continue
        assert files_in(unpacked).keys() == entries_of(packed).keys()


@pytest.mark.parametrize("stop", [30, 1000, 10_000])
def test_an_archive_that_shrinks_while_it_is_read_is_refused(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int
) -> None:
    file = tmp_path / "upload.zip"
    file.write_bytes(packed)
    checked = packed_module._read_entries

    def shrinking(*given: Any) -> object:
        entries = checked(*given)
        os.truncate(file, stop)
        return entries

    monkeypatch.setattr(packed_module, "_read_entries", shrinking)

    with pytest.raises((InvalidInput, MapCorrupt)):
        unpack_map(file, tmp_path / "map", LARGE)
