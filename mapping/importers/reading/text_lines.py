"""Lines of a text file in blank-separated fields, with errors that name file and line."""

from __future__ import annotations

import math
from pathlib import Path
from types import TracebackType
from typing import Self

from mapping.importers.reading.json_fields import LARGEST
from visloc.errors import VislocError, refuse


class TextLines:
    """Reads a file line by line, as a context manager.

    Attributes:
        number: of the current line, from 1.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.number = 0
        try:
            # Names may be in any coding; what is not UTF-8 is refused where names are checked.
            self._file = path.open(encoding="utf-8-sig", errors="surrogateescape", newline=None)
        except FileNotFoundError:
            raise refuse("import.missing", field=str(path)) from None
        except OSError as error:
            raise self._unreadable(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def next_or_none(self) -> str | None:
        """Return the next line that is not blank, stripped; None at the end of the file."""
        while True:
            try:
                line = self._file.readline()
            except OSError as error:
                raise self._unreadable(error) from error
            if not line:
                return None
            self.number += 1
            if text := line.strip():
                return text

    def next(self, expected: str) -> str:
        """Return the next line that is not blank, stripped."""
        line = self.next_or_none()
        if line is None:
            raise refuse("import.truncated", field=f"{self.path}:{self.number}", expected=expected)
        return line

    def end(self, of: str) -> None:
        """Refuse what comes after the end."""
        if (line := self.next_or_none()) is not None:
            raise self.error(f"the file goes on after {of}", expected="its end", got=line[:80])

    def next_numbers(self, count: int, expected: str) -> list[float]:
        """Return the next line's fields: exactly ``count`` finite numbers."""
        fields = self.next(expected).split()
        if len(fields) != count:
            raise self.error(
                "the line has the wrong number of fields",
                expected=f"{count}: {expected}",
                got=len(fields),
            )
        return [self.to_number(field) for field in fields]

    def to_number(self, field: str) -> float:
        """Parse a number that is finite and of sane magnitude."""
        try:
            number = float(field) if "_" not in field else math.nan
        except ValueError:
            number = math.nan
        if not abs(number) <= LARGEST:  # NaN is not
            raise self.error(
                "the number is not valid", expected=f"a number within +-{LARGEST:g}", got=field
            )
        return number

    def to_integer(self, field: str, high: int) -> int:
        """Parse a whole number from 0 to ``high``."""
        # The length bounds the work: int() of a long text takes long.
        number = int(field) if field.isascii() and field.isdigit() and len(field) < 20 else -1
        if not 0 <= number <= high:
            raise self.error(
                "the number is not valid", expected=f"a whole number, 0 to {high}", got=field
            )
        return number

    def error(
        self, message: str, *, expected: str | None = None, got: object = None
    ) -> VislocError:
        """Make an error about the current line."""
        return refuse(
            "import.line", message, field=f"{self.path}:{self.number}", expected=expected, got=got
        )

    def _unreadable(self, error: OSError) -> VislocError:
        return refuse("import.unreadable", field=str(self.path), got=error.strerror)
