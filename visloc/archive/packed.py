"""A map as one file, for sending: a ZIP archive of a plain kind (docs/map-format.md, Packed).

The ZIP format leaves room for disagreement: names given twice, entries that overlap, sizes told in
three places, archives in front of or behind one another. Only archives that every reader
understands alike are read here: stored entries without encryption that follow one another without
gaps, then one list of them, then the end. ``zipfile`` reads the list and the entries; the checks
around it come before anything large is read.

Numbers are little-endian; section numbers are of PKWARE's APPNOTE.TXT 6.3.
"""

from __future__ import annotations

import os
import shutil
import stat
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from visloc.archive.backends.base import MANIFEST
from visloc.archive.backends.folder import storage_errors
from visloc.archive.checks import MAX_MANIFEST_BYTES, check_files, read_any_manifest
from visloc.archive.npz import zip_errors
from visloc.archive.schema import FILE_NAME
from visloc.archive.set_rules import AnyManifest
from visloc.archive.set_schema import SET_OFFSETS
from visloc.errors import VislocError, refuse

MAX_ENTRIES = 100_000
_MAX_DIRECTORY_BYTES = 16 * 2**20
# Limits on the manifest of a map, which lists the files and how the map was made. The manifest of a
# set also lists its tiles and may be as large as any manifest.
_MAX_MAP_MANIFEST_BYTES, _MAX_MANIFEST_BYTES_PER_FILE = 2**20, 512
_BLOCK_BYTES = 2**20
_EARLIEST = (1980, 1, 1, 0, 0, 0)

_LOCAL = struct.Struct("<4s5H3I2H")  # 4.3.7
_END = struct.Struct("<4s4H2IH")  # 4.3.16
_END64 = struct.Struct("<4sQ2H2I4Q4sIQI")  # 4.3.14, and the locator that follows it, 4.3.15
_WIDE = 0xFFFFFFFF  # in place of a number that is in the extra field of 64 bits, 4.5.3
_ENCRYPTED, _SIZE_BEHIND = 0x2041, 0x8  # bits of an entry's flags, 4.4.4


def pack_map(folder: Path, output: Path) -> AnyManifest:
    """Write a map into one file. Equal maps make equal files, byte by byte.

    Args:
        folder: the map, of which only presence and size of the files are checked.
        output: the file, which must not exist.
    """
    manifest = read_any_manifest(folder)
    check_files(folder, manifest)
    with zipfile.ZipFile(output, "x") as archive:
        for name in (MANIFEST, *sorted(manifest.files)):
            entry = zipfile.ZipInfo(name, _EARLIEST)
            entry.create_system = 3  # Unix, wherever this runs
            entry.external_attr = (stat.S_IFREG | 0o644) << 16
            entry.file_size = (folder / name).stat().st_size
            with (folder / name).open("rb") as source, archive.open(entry, "w") as target:
                shutil.copyfileobj(source, target, _BLOCK_BYTES)
    return manifest


def unpack_map(file: Path, target: Path, max_bytes: int) -> AnyManifest:
    """Write the files of a packed map into a new folder.

    Nothing is written outside ``target``, and memory stays small whatever the file says. Whether
    the bytes are those of the manifest is for ``verify_any``, before the map is used.

    Args:
        target: the folder, which must not exist. On an error some files may lie there.
        max_bytes: largest map.
    """
    with file.open("rb") as source, storage_errors(target), _format_errors():
        count = _check_end(source)
        with zipfile.ZipFile(source) as archive:
            entries = _read_entries(archive, source, count, max_bytes)
            target.mkdir()
            _write_file(archive, entries[MANIFEST], target / MANIFEST)
            manifest = read_any_manifest(target)
            _check_listed(entries, manifest)
            for name, entry in entries.items():
                if not entry.is_dir() and name != MANIFEST:
                    (target / name).parent.mkdir(parents=True, exist_ok=True)
                    _write_file(archive, entry, target / name)
    return manifest


def _check_end(source: BinaryIO) -> int:
    """Check the end of the archive; return the number of entries.

    ``zipfile`` reads the whole list of entries whatever their number, so that both are bounded
    here.
    """
    stop = source.seek(0, os.SEEK_END) - _END.size
    if stop < 0:
        raise _bad_format("too short")
    signature, *parts, count, length, start, comment = _END.unpack(_read(source, stop, _END.size))
    if signature != b"PK\5\6" or comment:
        raise _bad_format("the end is missing: truncated, or followed by something else")
    if stop >= _END64.size:
        wide = _END64.unpack(_read(source, stop - _END64.size, _END64.size))
        if wide[10] == b"PK\6\7":
            narrow, stop = (count, length, start), stop - _END64.size
            signature, record, _, _, *parts, count, length, start, _, part, place, num_parts = wide
            if (
                (signature, record, place) != (b"PK\6\6", 44, stop)
                or (part, num_parts) != (0, 1)
                or narrow != (min(count, 0xFFFF), min(length, _WIDE), min(start, _WIDE))
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
    if _read(source, start, length).count(b"PK\1\2") > MAX_ENTRIES:
        raise _bad_format("the list of its entries has more than it says")
    return int(count)


def _read_entries(
    archive: zipfile.ZipFile, source: BinaryIO, count: int, max_bytes: int
) -> dict[str, zipfile.ZipInfo]:
    """The checked entries by name."""
    entries: dict[str, zipfile.ZipInfo] = {}
    position = 0
    for entry in archive.infolist():
        name = _checked_name(entry)
        if name in entries:
            raise _bad_entry(name, "is there twice")
        _check_kind(name, entry.flag_bits, entry.compress_type, entry.external_attr >> 16)
        size = entry.file_size
        if entry.compress_size != size or entry.volume or (entry.is_dir() and size):
            raise _bad_entry(name, "has sizes that contradict each other")
        if entry.header_offset != position:
            raise _bad_format("its entries overlap, have gaps or are not in order")
        position = _check_header(source, entry) + size
        if position > archive.start_dir:
            raise _bad_entry(name, "is longer than the archive")
        entries[name] = entry
    if len(entries) != count:
        raise _bad_format("the list of its entries has another number than it says")
    if position != archive.start_dir:
        raise _bad_format("bytes that belong to no entry")
    if MANIFEST not in entries:
        raise refuse(
            "packed.files",
            "the file is not a packed map: it has no manifest",
            field="map",
            expected=f"an entry {MANIFEST}",
        )
    _check_sizes(entries, max_bytes)
    return entries


def _check_sizes(entries: dict[str, zipfile.ZipInfo], max_bytes: int) -> None:
    total = sum(entry.file_size for entry in entries.values())
    if total > max_bytes:
        raise refuse(
            "packed.too_large",
            field="map",
            expected=f"at most {max_bytes} bytes",
            got=f"{total} bytes",
        )
    limit = _MAX_MAP_MANIFEST_BYTES + _MAX_MANIFEST_BYTES_PER_FILE * len(entries)
    if SET_OFFSETS in entries:
        limit = MAX_MANIFEST_BYTES
    if entries[MANIFEST].file_size > limit:
        raise refuse(
            "packed.too_large",
            "the manifest is too large",
            field=MANIFEST,
            expected=f"at most {limit} bytes for {len(entries)} entries",
            got=f"{entries[MANIFEST].file_size} bytes",
        )


def _check_header(source: BinaryIO, entry: zipfile.ZipInfo) -> int:
    """Check the header in front of an entry's bytes; return where these start."""
    header = _read(source, entry.header_offset, _LOCAL.size)
    signature, _, flags, method, _, _, _, *sizes, name_length, extra_length = _LOCAL.unpack(header)
    if signature != b"PK\3\4":
        raise _bad_format("an entry is not where the list says")
    start = entry.header_offset + _LOCAL.size
    rest = _read(source, start, name_length + extra_length)
    name, size = entry.orig_filename, entry.file_size
    _check_kind(name, flags, method, 0)
    if sizes == [_WIDE, _WIDE] and struct.pack("<2H2Q", 1, 16, size, size) in rest[name_length:]:
        sizes = [size, size]
    if rest[:name_length] != name.encode() or sizes != [size, size]:
        raise _bad_entry(name, "has another name or size than in the list")
    return start + len(rest)


def _check_kind(name: str, flags: int, method: int, mode: int) -> None:
    if flags & _ENCRYPTED:
        raise _bad_entry(name, "is encrypted")
    if flags & _SIZE_BEHIND:
        raise _bad_entry(name, "tells its size behind its bytes only")
    if method != zipfile.ZIP_STORED:
        raise _bad_entry(name, "is compressed; pack it without (zip -0)")
    kind = stat.S_IFMT(mode)
    if kind not in (0, stat.S_IFDIR if name.endswith("/") else stat.S_IFREG):
        raise _bad_entry(name, "is a link or another special file")


def _checked_name(entry: zipfile.ZipInfo) -> str:
    name = entry.orig_filename  # ``filename`` is what zipfile made of it
    if name != entry.filename or not FILE_NAME.fullmatch(name.removesuffix("/")):
        raise _bad_entry(name, "has a name that no file of a map has")
    return name


def _check_listed(entries: dict[str, zipfile.ZipInfo], manifest: AnyManifest) -> None:
    """The archive has the files of the manifest, in their sizes, and no folder beyond theirs."""
    files = {name: entry.file_size for name, entry in entries.items() if not entry.is_dir()}
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


def _write_file(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path) -> None:
    with archive.open(entry) as source, path.open("xb") as target:
        shutil.copyfileobj(source, target, _BLOCK_BYTES)
        target.flush()
        os.fsync(target.fileno())


def _read(source: BinaryIO, start: int, length: int) -> bytes:
    source.seek(start)
    data = source.read(length)
    if len(data) != length:
        raise _bad_format("it is cut off")
    return data


@contextmanager
def _format_errors() -> Iterator[None]:
    try:
        with zip_errors():
            yield
    except ValueError as error:
        raise _bad_format(str(error)) from error


def _bad_format(why: str) -> VislocError:
    return refuse("packed.format", field="map", got=why)


def _bad_entry(name: str, why: str) -> VislocError:
    return refuse("packed.entry", field="map", got=name, why=why)
