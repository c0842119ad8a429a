"""A map as one file, for sending: a ZIP archive of a plain kind (docs/map-format.md, Packed).

The ZIP format leaves room for disagreement: names given twice, entries that overlap, sizes told in
three places, archives in front of or behind one another. Only what every reader understands alike
is read here, so that what was checked is what is written: stored entries without encryption that
follow one another without gaps, then one central directory, then the end.

Numbers are little-endian; section numbers are of PKWARE's APPNOTE.TXT 6.3.
"""

from __future__ import annotations

import os
import re
import stat
import struct
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from visloc.archive.checks import check_files, read_any_manifest
from visloc.archive.set_rules import AnyManifest
from visloc.archive.sets import SET_CODES
from visloc.archive.store import storage_errors
from visloc.errors import VislocError, refuse

MANIFEST = "manifest.json"

MAX_ENTRIES = 100_000
_MAX_DIRECTORY_BYTES = 16 * 2**20
# Of a manifest, which lists the files and tells how the map was made.
_MAX_MANIFEST_BYTES, _MAX_MANIFEST_BYTES_PER_FILE = 2**20, 512
# That of a set lists its tiles too.
_MAX_SET_MANIFEST_BYTES = 16 * 2**20
# Names that files of a map have: on every system a path below the map, and nothing else.
FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}(/[A-Za-z0-9][A-Za-z0-9._-]{0,127}){0,3}")
_BLOCK_BYTES = 2**20
_EARLIEST = (1980, 1, 1, 0, 0, 0)

_LOCAL = struct.Struct("<4s5H3I2H")  # 4.3.7
_CENTRAL = struct.Struct("<4s6H3I5H2I")  # 4.3.12
_END = struct.Struct("<4s4H2IH")  # 4.3.16
_END64 = struct.Struct("<4sQ2H2I4Q")  # 4.3.14
_LOCATOR64 = struct.Struct("<4sIQI")  # 4.3.15
_IN_EXTRA = 0xFFFFFFFF  # the number is in the extra field of 64 bits, 4.5.3


def pack_map(folder: Path, output: Path) -> AnyManifest:
    """Write a map into one file. Equal maps make equal files, byte by byte.

    Args:
        folder: the map, of which only presence and size of the files are checked.
        output: the file, which must not exist.

    Raises:
        MapCorrupt: when it is not a map.
    """
    manifest = read_any_manifest(folder)
    check_files(folder, manifest)
    with zipfile.ZipFile(output, "x", zipfile.ZIP_STORED) as archive:
        for name in (MANIFEST, *sorted(manifest.files)):
            entry = zipfile.ZipInfo(name, _EARLIEST)
            entry.create_system = 3  # Unix, wherever this runs
            entry.external_attr = (stat.S_IFREG | 0o644) << 16
            entry.file_size = (folder / name).stat().st_size
            with (folder / name).open("rb") as source, archive.open(entry, "w") as target:
                while block := source.read(_BLOCK_BYTES):
                    target.write(block)
    return manifest


def unpack_map(file: Path, target: Path, max_bytes: int) -> AnyManifest:
    """Write the files of a packed map into a new folder.

    Nothing is written outside ``target``, and memory stays small whatever the file says. Whether
    the bytes are those of the manifest is for ``verify_any``, before the map is used.

    Args:
        file: the packed map.
        target: the folder, which must not exist. On an error some files may lie there.
        max_bytes: largest map.

    Raises:
        InvalidInput: ``packed.format``: not such an archive, or not a whole one; ``packed.entry``:
            an entry that a packed map cannot have; ``packed.files``: other entries than the
            manifest lists.
        TooLarge: ``packed.too_large``.
        MapCorrupt: when the manifest is damaged or too new.
        StorageFull: ``maps.storage_full``.
    """
    with file.open("rb") as source, storage_errors(target):
        entries = _read_entries(source, max_bytes)
        target.mkdir()
        _write_file(source, entries[MANIFEST], target / MANIFEST)
        manifest = read_any_manifest(target)
        _check_listed(entries, manifest)
        for name, entry in entries.items():
            if entry.is_folder or name == MANIFEST:
                continue
            path = target / name
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_file(source, entry, path)
    return manifest


@dataclass(frozen=True, slots=True)
class _Entry:
    """One entry of the archive; ``start``: of its header as listed, of its bytes once checked."""

    name: str
    size: int
    start: int

    @property
    def is_folder(self) -> bool:
        return self.name.endswith("/")


def _read_entries(source: BinaryIO, max_bytes: int) -> dict[str, _Entry]:
    """The checked entries by name, each with the start of its bytes."""
    count, start, stop = _read_end(source)
    entries: dict[str, _Entry] = {}
    position = 0
    for listed in _read_directory(source, count, start, stop):
        if listed.name in entries:
            raise _bad_entry(listed.name, "is there twice")
        if listed.start != position:
            raise _bad_format("its entries overlap, have gaps or are not in order")
        data = _read_local(source, listed)
        entries[listed.name] = _Entry(listed.name, listed.size, data)
        position = data + listed.size
        if position > start:
            raise _bad_entry(listed.name, "is longer than the archive")
    if position != start:
        raise _bad_format("bytes that belong to no entry")
    total = sum(entry.size for entry in entries.values())
    if total > max_bytes:
        raise refuse(
            "packed.too_large",
            field="map",
            expected=f"at most {max_bytes} bytes",
            got=f"{total} bytes",
        )
    if MANIFEST not in entries:
        raise refuse(
            "packed.files",
            "the file is not a packed map: it has no manifest",
            field="map",
            expected=f"an entry {MANIFEST}",
        )
    limit = _MAX_MANIFEST_BYTES + _MAX_MANIFEST_BYTES_PER_FILE * len(entries)
    if SET_CODES in entries:
        limit = _MAX_SET_MANIFEST_BYTES
    if entries[MANIFEST].size > limit:
        raise refuse(
            "packed.too_large",
            "the manifest is too large",
            field=MANIFEST,
            expected=f"at most {limit} bytes for {len(entries)} entries",
            got=f"{entries[MANIFEST].size} bytes",
        )
    return entries


def _read_end(source: BinaryIO) -> tuple[int, int, int]:
    """Number of entries, start and stop of the central directory."""
    size = source.seek(0, os.SEEK_END)
    stop = size - _END.size
    if stop < 0:
        raise _bad_format("too short")
    signature, *parts, count, length, start, comment = _END.unpack(_read(source, stop, _END.size))
    if signature != b"PK\5\6" or comment:
        raise _bad_format("the end is missing: truncated, or followed by something else")
    locator = stop - _LOCATOR64.size
    if locator >= _END64.size and _read(source, locator, 4) == b"PK\6\7":
        narrow, stop = (count, length, start), locator - _END64.size
        _, part, place, num_parts = _LOCATOR64.unpack(_read(source, locator, _LOCATOR64.size))
        signature, record, _, _, *parts, count, length, start = _END64.unpack(
            _read(source, stop, _END64.size)
        )
        if (
            (signature, record, place) != (b"PK\6\6", _END64.size - 12, stop)
            or (part, num_parts) != (0, 1)
            or narrow != (min(count, 0xFFFF), min(length, _IN_EXTRA), min(start, _IN_EXTRA))
        ):
            raise _bad_format("the end of 64 bits is damaged")
    if parts != [0, 0, count]:
        raise _bad_format("it has several parts")
    if start + length != stop:
        raise _bad_format("the list of its entries is not where it should be")
    if count > MAX_ENTRIES or length > _MAX_DIRECTORY_BYTES:
        raise refuse(
            "packed.too_large",
            "the archive has too many entries",
            field="map",
            expected=f"at most {MAX_ENTRIES} in {_MAX_DIRECTORY_BYTES} bytes",
            got=f"{count} in {length} bytes",
        )
    return count, start, stop


def _read_directory(source: BinaryIO, count: int, start: int, stop: int) -> Iterator[_Entry]:
    directory = memoryview(_read(source, start, stop - start))
    position = 0
    for _ in range(count):
        if position + _CENTRAL.size > len(directory):
            raise _bad_format("the list of its entries is cut off")
        header = _CENTRAL.unpack_from(directory, position)
        signature, _, _, flags, method, _, _, _, packed, size, *lengths, disk, _, mode, offset = (
            header
        )
        name_length, extra_length, comment_length = lengths
        position += _CENTRAL.size
        end = position + name_length + extra_length + comment_length
        if signature != b"PK\1\2" or end > len(directory):
            raise _bad_format("the list of its entries is damaged")
        name = _checked_name(bytes(directory[position : position + name_length]))
        extra = bytes(directory[position + name_length : position + name_length + extra_length])
        size, packed, offset = _of_64_bits(name, extra, size, packed, offset)
        _check_kind(name, flags, method, mode >> 16)
        if packed != size or disk or (name.endswith("/") and size):
            raise _bad_entry(name, "has sizes that contradict each other")
        position = end
        yield _Entry(name, size, offset)
    if position != len(directory):
        raise _bad_format("the list of its entries has more than it says")


def _read_local(source: BinaryIO, entry: _Entry) -> int:
    """Check the header in front of an entry's bytes; return where these start."""
    header = _read(source, entry.start, _LOCAL.size)
    signature, _, flags, method, _, _, _, packed, size, name_length, extra_length = _LOCAL.unpack(
        header
    )
    if signature != b"PK\3\4":
        raise _bad_format("an entry is not where the list says")
    rest = _read(source, entry.start + _LOCAL.size, name_length + extra_length)
    size, packed = _of_64_bits(entry.name, rest[name_length:], size, packed)
    _check_kind(entry.name, flags, method, 0)
    if rest[:name_length] != entry.name.encode() or not packed == size == entry.size:
        raise _bad_entry(entry.name, "has another name or size than in the list")
    return entry.start + _LOCAL.size + len(rest)


def _of_64_bits(name: str, extra: bytes, *numbers: int) -> tuple[int, ...]:
    """Replace the numbers that had no room in 32 bits; in the order of 4.5.3."""
    if _IN_EXTRA not in numbers:
        return numbers
    position = 0
    while position + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, position)
        position += 4
        if kind == 1:
            found = [number for number in numbers if number == _IN_EXTRA]
            if length < 8 * len(found) or position + length > len(extra):
                break
            wide = iter(struct.unpack_from(f"<{len(found)}Q", extra, position))
            return tuple(next(wide) if number == _IN_EXTRA else number for number in numbers)
        position += length
    raise _bad_entry(name, "does not tell its size")


def _check_kind(name: str, flags: int, method: int, mode: int) -> None:
    if flags & 0b1000001 or flags & 0x2000:
        raise _bad_entry(name, "is encrypted")
    if flags & 0b1000:
        raise _bad_entry(name, "tells its size behind its bytes only")
    if method != zipfile.ZIP_STORED:
        raise _bad_entry(name, "is compressed; pack it without (zip -0)")
    kind = stat.S_IFMT(mode)
    if kind not in (0, stat.S_IFDIR if name.endswith("/") else stat.S_IFREG):
        raise _bad_entry(name, "is a link or another special file")


def _checked_name(raw: bytes) -> str:
    name = raw.decode("ascii", "backslashreplace")
    if not FILE_NAME.fullmatch(name.removesuffix("/")):
        raise _bad_entry(name, "has a name that no file of a map has")
    return name


def _check_listed(entries: dict[str, _Entry], manifest: AnyManifest) -> None:
    """The archive has the files of the manifest, in their sizes, and no folder beyond theirs."""
    files = {name: entry.size for name, entry in entries.items() if not entry.is_folder}
    del files[MANIFEST]
    listed = {name: entry.size for name, entry in manifest.files.items()}
    for name in sorted(files.keys() ^ listed.keys()):
        raise refuse(
            "packed.files",
            "the archive does not have this file of the manifest"
            if name in listed
            else "the manifest does not list this file",
            field=name,
        )
    for name, size in files.items():
        if size != listed[name]:
            raise refuse(
                "packed.files",
                "the file does not have the size in the manifest",
                field=name,
                expected=f"{listed[name]} bytes",
                got=f"{size} bytes",
            )
    folders = {str(parent) for name in files for parent in PurePosixPath(name).parents}
    for name in entries:
        if name.rstrip("/") in folders and not name.endswith("/"):
            raise _bad_entry(name, "is a file and a folder")
        if name.endswith("/") and name.rstrip("/") not in folders:
            raise _bad_entry(name, "is a folder without a file")


def _write_file(source: BinaryIO, entry: _Entry, path: Path) -> None:
    source.seek(entry.start)
    remaining = entry.size
    with path.open("xb") as target:
        while remaining:
            block = source.read(min(remaining, _BLOCK_BYTES))
            if not block:
                raise _bad_format("it was cut off while it was read")
            target.write(block)
            remaining -= len(block)
        target.flush()
        os.fsync(target.fileno())


def _read(source: BinaryIO, start: int, length: int) -> bytes:
    source.seek(start)
    data = source.read(length)
    if len(data) != length:
        raise _bad_format("it is cut off")
    return data


def _bad_format(why: str) -> VislocError:
    return refuse("packed.format", field="map", got=why)


def _bad_entry(name: str, why: str) -> VislocError:
    return refuse("packed.entry", field="map", got=name, why=why)
