"""Rows of one kapture text file, and errors that name file and line."""

from __future__ import annotations

import math
import re
import stat
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from visloc.errors import DatasetError, InvalidInput, VislocError, refuse
from visloc.kapture.text import relative_path

_VERSION = re.compile(r"#\s*kapture format:\s*(\d{1,4})\.(\d{1,4})", re.ASCII)
_INTEGER = re.compile(r"[+-]?\d{1,19}", re.ASCII)
_INT64_LIMIT = 2**63


class Table:
    """One text file of a dataset. Iterates over its rows and collects notes about bad ones.

    Args:
        relative: path of the file in it, with forward slashes.
        num_columns: fields of every row; None if rows differ.
    """

    def __init__(self, root: Path, relative: str, num_columns: int | None) -> None:
        self.relative = relative
        self.line = 0  # of the current row, from 1
        self._path = root / relative
        self._num_columns = num_columns
        self._tolerated: Counter[str] = Counter()
        self._examples: dict[str, str] = {}

    def exists(self) -> bool:
        try:
            self._path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            raise self._unreadable(error) from error
        return True

    def version(self) -> tuple[int, int] | None:
        """Return the version that the first line declares; None if it declares none."""
        for line in self._lines():
            match = _VERSION.match(line.strip())
            return None if match is None else (int(match[1]), int(match[2]))
        return None

    def __iter__(self) -> Iterator[list[str]]:
        for line in self._lines():
            text = line.strip()
            if not text or text[0] == "#":
                continue
            fields = [field.strip() for field in text.split(",")]
            if self._num_columns is not None and len(fields) != self._num_columns:
                raise self.error(
                    "kapture.column_count",
                    "the line has the wrong number of columns (fields cannot contain commas)",
                    expected=str(self._num_columns),
                    got=len(fields),
                )
            yield fields

    def error(self, code: str, message: str | None = None, **parts: Any) -> VislocError:
        """Make an error about the current row; the arguments are those of ``refuse``."""
        where = f"{self.relative}:{self.line}" if self.line else self.relative
        return refuse(code, message, field=where, kind=DatasetError, **parts)

    @contextmanager
    def errors_at_row(self) -> Iterator[None]:
        """Turn InvalidInput of a value into an error about the current row."""
        try:
            yield
        except InvalidInput as error:
            raise self.error(
                error.code, error.message, expected=error.expected, got=error.got
            ) from None

    def tolerate(self, what: str, example: str) -> None:
        """Count one row that is ignored, in whole or in part."""
        self._tolerated[what] += 1
        self._examples.setdefault(what, f"line {self.line}: {example}")

    def notes(self) -> list[str]:
        """Return one sentence with a count for each kind of tolerated row."""
        return [
            f"{self.relative}: {count} {what} (first in {self._examples[what]})"
            for what, count in self._tolerated.items()
        ]

    def timestamp(self, text: str) -> int:
        """Parse an int64."""
        if _INTEGER.fullmatch(text):
            value = int(text)
            if -_INT64_LIMIT <= value < _INT64_LIMIT:
                return value
        raise self.error("kapture.timestamp", got=text)

    def path(self, text: str, folder: str) -> str:
        """Parse a relative path."""
        try:
            return relative_path(text)
        except ValueError:
            raise self.error(
                "kapture.path", expected=f"a relative path that stays inside {folder}", got=text
            ) from None

    def numbers(self, texts: list[str]) -> list[float]:
        """Parse finite numbers."""
        numbers = []
        for text in texts:
            try:
                value = math.nan if "_" in text else float(text)  # Python reads 1_000 as a number
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise self.error("kapture.number", got=text)
            numbers.append(value)
        return numbers

    def _lines(self) -> Iterator[str]:
        self.line = 0
        try:
            # A pipe blocks, and a device may have no end.
            if not stat.S_ISREG(self._path.stat().st_mode):
                raise self.error(
                    "kapture.unreadable", "this is not a plain file", expected="a plain file"
                )
            with self._path.open(encoding="utf-8-sig") as file:
                for line in file:
                    self.line += 1
                    yield line
        except UnicodeDecodeError as error:
            self.line = 0  # text is decoded in blocks, so the line would be wrong
            raise self.error("kapture.encoding", got=str(error)) from error
        except OSError as error:
            raise self._unreadable(error) from error

    def _unreadable(self, error: OSError) -> VislocError:
        self.line = 0
        return self.error("kapture.unreadable", got=error.strerror or str(error))
