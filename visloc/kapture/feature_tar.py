"""The tar variant of a folder of features: an index of where each file's bytes lie."""

from __future__ import annotations

import stat
import tarfile
from collections.abc import Mapping
from pathlib import Path

from visloc.errors import VislocError, refuse
from visloc.kapture.text import relative_path


def index_tar(path: Path) -> Mapping[str, tuple[int, int]]:
    """Return offset and size of each plain file in an uncompressed tar, by normalized name.

    Of two members of one name the last wins, as kapture replaces files by appending. Folders,
    links, and members whose names lead out are ignored; nothing is ever unpacked.
    """
    members: dict[str, tuple[int, int]] = {}
    end = 0
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe blocks
            raise _damaged(path, "not a plain file")
        total = status.st_size
        with path.open("rb") as file, tarfile.open(fileobj=file, mode="r:") as archive:
            while (member := archive.next()) is not None:
                archive.members.clear()  # type: ignore[attr-defined]  # otherwise it keeps every header
                # A header with a negative size would make the reader loop.
                if member.offset_data < end or member.size < 0:
                    raise _damaged(path, f"{member.name!r} lies within what precedes it")
                end = member.offset_data + member.size
                if end > total:
                    raise _damaged(path, f"{member.name!r} ends beyond the archive")
                if member.isreg() and not member.issparse():
                    try:
                        members[relative_path(member.name)] = member.offset_data, member.size
                    except ValueError:
                        continue
            # tarfile takes a damaged header for the end, which is a block of zeros.
            file.seek(archive.offset)
            if any(file.read(tarfile.BLOCKSIZE)):
                raise _damaged(path, f"no header at byte {archive.offset}")
    except (tarfile.TarError, OSError, ValueError, OverflowError) as error:
        raise _damaged(path, str(error)) from error
    return members


def _damaged(path: Path, got: str) -> VislocError:
    return refuse("kapture.tar", field=str(path), got=got)
