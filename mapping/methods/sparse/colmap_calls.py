"""Long calls of pycolmap: they can be interrupted, and print errors only."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap

T = TypeVar("T")


def interruptible(run: Callable[[pycolmap.CancellationToken], T]) -> T:
    """Run a long call of pycolmap so that Ctrl-C ends the call, not only Python's waiting."""
    token = pycolmap.CancellationToken()
    result: list[T] = []
    failed: list[BaseException] = []

    def call() -> None:
        try:
            result.append(run(token))
        except BaseException as error:  # noqa: BLE001  raised again in the caller's thread
            failed.append(error)

    thread = threading.Thread(target=call, name="pycolmap")
    thread.start()
    try:
        while thread.is_alive():
            thread.join(0.2)
    except BaseException:
        token.cancel()
        thread.join()
        raise
    if failed:
        raise failed[0]
    return result[0]


@contextmanager
def quiet(*, errors: bool = True) -> Iterator[None]:
    """Let pycolmap print errors only; or nothing, where what it returns tells of an error."""
    before: Any = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 2 if errors else 3
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
