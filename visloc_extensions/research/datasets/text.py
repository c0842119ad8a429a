"""Text files of archives, and errors that name them."""

from __future__ import annotations

from pathlib import Path

from visloc.errors import refuse


def read_lines(path: Path, expected: str) -> list[str]:
    """Return the lines of a file without those that are blank, stripped."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise refuse("archive.missing", field=str(path), expected=expected) from None
    except (OSError, UnicodeDecodeError) as error:
        raise refuse("archive.content", field=str(path), got=str(error)) from error
    lines = [line.strip() for line in text.splitlines()]
    found = [line for line in lines if line]
    if not found:
        raise refuse("archive.content", field=str(path), expected=expected, got="nothing")
    return found
