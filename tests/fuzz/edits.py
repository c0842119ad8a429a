"""Inputs that are folders: which files of a good folder are altered, and how.

An input is a byte of flags and a list of edits: a byte that tells file and kind, two bytes of
length, and as many bytes. Whatever bytes come, they are such a list, so that none is wasted.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

_MAX_EDITS = 4
_KINDS = ("content", "patch", "cut", "missing", "folder", "link", "pipe")


@dataclass(frozen=True)
class Edit:
    """What happens to one file: its new content, or bytes that go over, or another thing."""

    name: str
    kind: str
    data: bytes


def encode(names: list[str], edits: Iterable[Edit], flags: int = 0) -> bytes:
    """Return the input that means these edits."""
    parts = [bytes([flags])]
    for edit in edits:
        parts += [
            bytes([_KINDS.index(edit.kind) * 32 + names.index(edit.name)]),
            len(edit.data).to_bytes(2, "little"),
            edit.data,
        ]
    return b"".join(parts)


def decode(names: list[str], data: bytes) -> tuple[int, list[Edit]]:
    """Return flags and edits of an input; each file is edited at most once."""
    edits: dict[str, Edit] = {}
    position = 1
    while position + 3 <= len(data) and len(edits) < _MAX_EDITS:
        kind, which = divmod(data[position], 32)
        length = int.from_bytes(data[position + 1 : position + 3], "little")
        position += 3
        name = names[which % len(names)]
        edits[name] = Edit(name, _KINDS[kind % len(_KINDS)], data[position : position + length])
        position += length
    return (data[0] if data else 0), list(edits.values())


class EditedFolder:
    """A good folder, altered for one run at a time.

    Args:
        folder: where it lies; its files of now are the good ones.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.good: Mapping[str, bytes] = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }
        self.names = sorted(self.good)
        assert len(self.names) <= 32
        self._altered: list[str] = []

    def restore(self) -> None:
        """Make the folder what it was."""
        for name in self._altered:
            path = self.folder / name
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
            path.write_bytes(self.good[name])
        self._altered.clear()

    def alter(self, edits: Iterable[Edit]) -> Iterator[tuple[str, bytes]]:
        """Apply edits; yield name and content of those files that are files still."""
        for edit in edits:
            content = self._apply(edit)
            if content is not None:
                yield edit.name, content

    def write(self, name: str, content: bytes) -> None:
        """Give a file another content."""
        self._altered.append(name)
        (self.folder / name).write_bytes(content)

    def _apply(self, edit: Edit) -> bytes | None:
        path, good = self.folder / edit.name, self.good[edit.name]
        offset = int.from_bytes(edit.data[:2], "little")
        content = {
            "content": edit.data,
            "patch": good[:offset] + edit.data[2:] + good[offset + len(edit.data) - 2 :],
            "cut": good[:offset],
        }.get(edit.kind)
        if content is not None:
            self.write(edit.name, content)
            return content
        self._altered.append(edit.name)
        path.unlink()
        if edit.kind == "folder":
            path.mkdir()
        elif edit.kind == "link":
            outside = self.folder.parent / "outside"
            outside.write_bytes(edit.data or good)
            path.symlink_to(outside)
        elif edit.kind == "pipe":
            os.mkfifo(path)
        return None
