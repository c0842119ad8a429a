"""Files of a folder that an import does not use: told by reason, and all of them in a list."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

_NAMED = 3  # how many names a note lists

LeftOut = Mapping[str, Sequence[str]]
"""Names of files by the reason why they are not used."""


def list_path(output: Path) -> Path:
    """Return where the list of an import to ``output`` lies: beside the dataset."""
    return output.with_name(f"{output.name}.left-out.txt")


def notes_on(left_out: LeftOut) -> list[str]:
    """Return a note for each reason, with how many files it holds for and the first names."""
    return [
        f"{len(names)} left out ({reason}): {', '.join(map(_shown, names[:_NAMED]))}"
        + (", ..." if len(names) > _NAMED else "")
        for reason, names in left_out.items()
    ]


def write_list(left_out: LeftOut, path: Path) -> list[str]:
    """Write every name with its reason; return a note on the file.

    Where nothing was left out there is no file afterwards, nor one of an earlier import.
    """
    if not left_out:
        path.unlink(missing_ok=True)
        return []
    lines = [f"{_shown(name)}\t{reason}\n" for reason, names in left_out.items() for name in names]
    path.write_text("".join(lines), encoding="utf-8")
    return [f"every file that was left out, with the reason: {path}"]


def _shown(name: str) -> str:
    """Return a name as a line of text: names of files may hold line breaks and stray bytes."""
    return name if name.isprintable() else ascii(name)
