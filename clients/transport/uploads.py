"""Sending a packed map in pieces, since it may be larger than memory."""

from __future__ import annotations

import asyncio
import json
import os
import zipfile
from collections.abc import AsyncGenerator, Callable, Generator
from dataclasses import dataclass
from pathlib import Path

from clients.wire.requests import checked_version
from visloc.errors import VislocError, refuse

# Called with the number of bytes that were sent since the last call.
OnProgress = Callable[[int], None]

_PIECE_BYTES = 512 * 1024
_MAX_MANIFEST_BYTES = 16 * 2**20
# The slowest rate at which a server takes a body, and about the slowest at which it verifies one.
_SLOWEST_BYTES_PER_S = 100_000
_SLOWEST_VERIFIED_BYTES_PER_S = 10_000_000


@dataclass(frozen=True, slots=True)
class Upload:
    """A packed map and its names on the server; see ``upload_request``."""

    path: Path
    map_id: str
    version: str
    size_bytes: int

    def verified_within_s(self, timeout_s: float) -> float:
        """Longest wait for the answer after everything is sent, seconds."""
        return timeout_s + self.size_bytes / _SLOWEST_VERIFIED_BYTES_PER_S

    def done_within_s(self, timeout_s: float) -> float:
        """Longest wait for the answer from the first byte on, seconds."""
        return self.verified_within_s(timeout_s) + self.size_bytes / _SLOWEST_BYTES_PER_S


def upload_request(path: Path, map_id: str | None, version: str | None) -> Upload:
    """Check a packed map; names that are None are read from its manifest."""
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
        if map_id is None or version is None:
            known_id, known_version = _read_names(path)
            map_id, version = map_id or known_id, version or known_version
    except OSError as error:
        raise refuse(
            "packed.unreadable", field=str(path), got=error.strerror or str(error)
        ) from error
    return Upload(path, *checked_version(map_id, version), size)


def pieces(upload: Upload, on_progress: OnProgress) -> Generator[bytes]:
    """Read the file."""
    left = upload.size_bytes
    with upload.path.open("rb") as file:
        while left:
            piece = file.read(min(left, _PIECE_BYTES))
            if not piece:
                raise refuse(
                    "packed.changed",
                    field=str(upload.path),
                    expected=f"{upload.size_bytes} bytes",
                    got=f"{upload.size_bytes - left} bytes",
                )
            left -= len(piece)
            yield piece
            on_progress(len(piece))


async def pieces_async(upload: Upload, on_progress: OnProgress) -> AsyncGenerator[bytes]:
    """Read the file in threads; ``on_progress`` is called in the event loop."""
    reading = pieces(upload, lambda _: None)
    try:
        while (piece := await asyncio.to_thread(next, reading, None)) is not None:
            yield piece
            on_progress(len(piece))
    finally:
        reading.close()


def _read_names(path: Path) -> tuple[str, str]:
    try:
        with zipfile.ZipFile(path) as archive:
            entry = archive.getinfo("manifest.json")
            if max(entry.file_size, entry.compress_size) > _MAX_MANIFEST_BYTES:
                raise _not_packed(path, f"a manifest of {entry.file_size} bytes")
            manifest = json.loads(archive.read(entry))
            names = manifest["id"], manifest["version"]
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise _not_packed(path, str(error)) from None
    if not all(isinstance(name, str) for name in names):
        raise _not_packed(path, repr(names))
    return names


def _not_packed(path: Path, got: str) -> VislocError:
    return refuse("packed.manifest", field=str(path), got=got)
