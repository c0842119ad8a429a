"""Matches of pairs of photos in kapture's layout.

``FIRST.overlapping/SECOND.matches`` holds rows of three float64, little-endian: the row of a
keypoint of each photo, and a score. A folder may have ``matches.tar`` instead.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.errors import VislocError, refuse
from visloc.kapture.feature_tar import index_tar
from visloc.kapture.text import relative_path
from visloc.kapture.writer import write_atomically

_BETWEEN, _SUFFIX = ".overlapping/", ".matches"
_ROW = np.dtype(("<f8", 3))
# A million matches of one pair.
_MAX_FILE_BYTES = _ROW.itemsize * 10**6


@dataclass(frozen=True, slots=True, eq=False)
class MatchFiles:
    """A folder of matches, open for reading. It can be pickled.

    Attributes:
        folder: holds the files of the pairs, or ``matches.tar``.
        members: offset and size by file name in ``matches.tar``; None without it.
    """

    folder: Path
    members: Mapping[str, tuple[int, int]] | None

    def pairs(self) -> Iterator[tuple[str, str]]:
        """Name the photos of each file, in the file's order."""
        for name in sorted(self._names()):
            first, between, second = name.partition(_BETWEEN)
            if between and second.endswith(_SUFFIX):
                yield first, second.removesuffix(_SUFFIX)

    def read(self, first: str, second: str) -> NDArray[np.int64] | None:
        """Return rows (k, 2) of keypoints of the two photos, each once.

        Files of either order of the two are found. None when there is none, which is not the same
        as a file without a match.
        """
        found = self._find(first, second)
        if found is None:
            return None
        name, columns, content = found
        return self._rows(name, content)[:, columns]

    def digest(self, first: str, second: str) -> str:
        """Return a hash of the file that ``read`` reads, without looking at its matches."""
        name, _, content = self._find(first, second) or ("", [], b"")
        return hashlib.sha256(name.encode() + b"\0" + content).hexdigest()

    def _find(self, first: str, second: str) -> tuple[str, list[int], bytes] | None:
        """Return the name and content of a pair's file, and the columns of first and second."""
        for one, other, columns in ((first, second, [0, 1]), (second, first, [1, 0])):
            name = match_file(one, other)
            content = self._content(name)
            if content is not None:
                return name, columns, content
        return None

    def _rows(self, name: str, content: bytes) -> NDArray[np.int64]:
        if len(content) % _ROW.itemsize:
            raise refuse(
                "kapture.feature_size",
                field=self.label(name),
                expected=f"whole rows of 3 float64, {_ROW.itemsize} bytes",
                got=f"{len(content)} bytes",
                what="matches",
            )
        indices = np.frombuffer(content, "<f8").reshape(-1, 3)[:, :2]
        # NaN fails too.
        right = (indices >= 0) & (indices < 2**31) & (indices == np.floor(indices))
        if not right.all():
            row = int(np.flatnonzero(~right.all(axis=1))[0])
            got = f"{indices[row].tolist()} in row {row}"
            raise refuse("kapture.match_values", field=self.label(name), got=got)
        return np.unique(indices.astype(np.int64), axis=0)

    def _names(self) -> Iterator[str]:
        if self.members is not None:
            yield from self.members
            return
        for parent, _, files in os.walk(self.folder):
            for file in files:
                yield (Path(parent) / file).relative_to(self.folder).as_posix()

    def _content(self, name: str) -> bytes | None:
        try:
            if self.members is not None:
                if name not in self.members:
                    return None
                offset, size = self.members[name]
                path = self.folder / "matches.tar"
            else:
                path, offset = self.folder / name, 0
                if not path.is_file():
                    return None
                size = path.stat().st_size
            if size > _MAX_FILE_BYTES:
                raise refuse(
                    "kapture.feature_too_large",
                    field=self.label(name),
                    expected=f"at most {_MAX_FILE_BYTES} bytes",
                    got=f"{size} bytes",
                )
            with path.open("rb") as file:
                file.seek(offset)
                return file.read(size)
        except OSError as error:
            raise self._unreadable(name, error) from error

    def label(self, name: str) -> str:
        """Name a file, for error messages."""
        holder = self.folder if self.members is None else self.folder / "matches.tar"
        return str(holder / name)

    def _unreadable(self, name: str, error: OSError) -> VislocError:
        got = error.strerror or str(error)
        return refuse("kapture.unreadable", field=self.label(name), got=got)


def open_matches(folder: Path) -> MatchFiles:
    """Open the matches of one type of keypoints.

    Args:
        folder: ``reconstruction/matches/TYPE`` of a dataset, or such a folder elsewhere.
    """
    tar = folder / "matches.tar"
    found = MatchFiles(folder, index_tar(tar) if tar.exists() else None)
    if next(found.pairs(), None) is None:
        raise refuse("kapture.no_matches", field=str(folder))
    return found


def write_matches(
    folder: Path,
    first: str,
    second: str,
    rows: NDArray[np.integer],
    scores: NDArray[np.floating] | None = None,
) -> None:
    """Write the matches of one pair, under the name that comes first in the alphabet.

    Args:
        second: another photo.
        rows: (k, 2) rows of their keypoints.
        scores: (k,); 1 where they are not known.
    """
    if first > second:
        first, second, rows = second, first, rows[:, ::-1]
    path = folder / match_file(first, second)
    path.parent.mkdir(parents=True, exist_ok=True)
    table = np.ones((len(rows), 3), "<f8")
    table[:, :2] = rows
    if scores is not None:
        table[:, 2] = scores
    write_atomically(path, table.tobytes())


def match_file(first: str, second: str) -> str:
    """Return the path of a pair's file in its folder."""
    try:
        return f"{relative_path(first)}{_BETWEEN}{relative_path(second)}{_SUFFIX}"
    except ValueError:
        raise refuse(
            "kapture.path",
            "photos of these paths cannot have matches",
            field="image_path",
            expected="relative paths that stay inside the dataset",
            got=f"{first}, {second}",
        ) from None
