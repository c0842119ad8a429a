"""Asks extensions whether a path that was given as photos or a dataset is of a format of theirs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

from visloc.errors import refuse
from visloc.extensions import RECOGNIZERS, extensions, load


@functools.cache
def _recognizers() -> list[Callable[[Path], str | None]]:
    return [load(entry) for entry in extensions(RECOGNIZERS).values()]


def importer_of(path: Path) -> str | None:
    """Return the importer that reads a file or folder, None for what no extension recognises."""
    found = (recognize(path) for recognize in _recognizers())
    return next((name for name in found if name is not None), None)


def refuse_recognized(path: Path) -> None:
    """Refuse what an extension recognises where photos or a dataset are expected."""
    if (app := importer_of(path)) is not None:
        raise refuse("import.scan", field=str(path), app=app, path=path)
