"""Packed maps, as they are uploaded."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from tests.fuzz.target import holds, refusal
from tests.fuzz.tiny_map import write_tiny_map
from visloc.archive import verify_map
from visloc.archive.packed import pack_map, unpack_map
from visloc.errors import InvalidInput, MapCorrupt

MAX_BYTES = 2**18
_LOCAL_HEADER = 30


class Packed:
    """Unpacks archives and verifies what they held."""

    def __init__(self, folder: Path) -> None:
        write_tiny_map(folder / "good")
        self._good = folder / "good"
        pack_map(self._good, folder / "good.zip")
        self._room = folder / "room"
        self._room.mkdir()

    def run(self, data: bytes) -> str:
        """Unpack; what is accepted is what any other reader of archives would find."""
        file, target = self._room / "map.zip", self._room / "map"
        file.write_bytes(data)
        try:
            try:
                manifest = unpack_map(file, target, MAX_BYTES)
            except (InvalidInput, MapCorrupt) as error:
                return refusal(error, "packed.", "map.")
            finally:
                assert {path.name for path in self._room.iterdir()} <= {"map.zip", "map"}
            with holds("what the manifest lists"):
                paths = [path for path in target.rglob("*") if not path.is_dir()]
                assert not any(path.is_symlink() for path in target.rglob("*"))
                files = {path.relative_to(target).as_posix(): path.read_bytes() for path in paths}
                assert files.keys() == manifest.files.keys() | {"manifest.json"}
                assert sum(map(len, files.values())) <= min(len(data), MAX_BYTES)
            with holds("read alike by another reader"):
                _check_alike(data, files)
            try:
                verify_map(target)
            except MapCorrupt as error:
                return f"unpacked, then {refusal(error, 'map.')}"
        finally:
            shutil.rmtree(target, ignore_errors=True)
        return "accepted"

    def repair(self, data: bytes) -> bytes:
        """Make the list at the end that of the entries before it."""
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w") as rebuilt:
            position = 0
            while data[position : position + 4] == b"PK\3\4":
                size = int.from_bytes(data[position + 18 : position + 22], "little")
                length = int.from_bytes(data[position + 26 : position + 28], "little")
                extra = int.from_bytes(data[position + 28 : position + 30], "little")
                name = data[position + _LOCAL_HEADER : position + _LOCAL_HEADER + length]
                start = position + _LOCAL_HEADER + length + extra
                if start > len(data) or not name or b"\0" in name:
                    break
                entry = zipfile.ZipInfo(name.decode("latin-1"))
                entry.external_attr = (0o100644 if size % 8 else 0o120777) << 16  # or a link
                if entry.filename in rebuilt.namelist():
                    break
                rebuilt.writestr(entry, data[start : start + size])
                position = start + size
        return archive.getvalue()

    def seeds(self) -> Iterator[bytes]:
        """Yield the map as it is packed, and small archives of every kind."""
        yield self._good.with_suffix(".zip").read_bytes()
        manifest = json.loads((self._good / "manifest.json").read_text(encoding="utf-8"))
        manifest["files"] = {"global/a.npy": {"size": 3, "sha256": "0" * 64}}
        text = json.dumps(manifest).encode()
        for compression, folder, wide in (
            (zipfile.ZIP_STORED, False, False),
            (zipfile.ZIP_STORED, True, False),
            (zipfile.ZIP_STORED, False, True),
            (zipfile.ZIP_DEFLATED, False, False),
        ):
            archive = io.BytesIO()
            with zipfile.ZipFile(archive, "w", compression) as packed:
                packed.writestr(zipfile.ZipInfo("manifest.json"), text, compression)
                if folder:
                    packed.writestr(zipfile.ZipInfo("global/"), b"")
                with packed.open(zipfile.ZipInfo("global/a.npy"), "w", force_zip64=wide) as file:
                    file.write(b"abc")
            yield archive.getvalue()


def _check_alike(data: bytes, files: dict[str, bytes]) -> None:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = [name for name in archive.namelist() if not name.endswith("/")]
        assert sorted(names) == sorted(files)
        for name, content in files.items():
            archive.getinfo(name).CRC = zlib.crc32(content)  # checksums are the manifest's
            assert archive.read(name) == content
