"""Outputs that are complete or absent."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from visloc.errors import refuse


def refuse_existing(output: Path, code: str) -> None:
    """Refuse to overwrite a file or folder."""
    if output.exists() or output.is_symlink():
        raise refuse(code, field=str(output))


@contextmanager
def complete_output(output: Path, code: str) -> Iterator[Path]:
    """Give a path beside ``output``, which is renamed to ``output`` if the block succeeds."""
    refuse_existing(output, code)
    output.parent.mkdir(parents=True, exist_ok=True)
    partial = output.with_name(f".{output.name}.{os.getpid()}.partial")
    _remove(partial)  # of a process of the same id that was killed
    try:
        yield partial
        refuse_existing(output, code)
        partial.rename(output)
    except BaseException:
        _remove(partial)
        raise


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
