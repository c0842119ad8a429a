"""The main function of a worker process: one task after another."""

from __future__ import annotations

import os
import pickle
import signal
import threading
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from traceback import format_exception
from typing import TYPE_CHECKING, Any

from service.values import OpenMap, Signals, WorkerSettings

if TYPE_CHECKING:
    from service.workers.vision import Vision


@dataclass(frozen=True, slots=True)
class Reply:
    """What became of a task.

    Attributes:
        open_maps: the maps that are open after it.
        traceback: of the error, as text; frames cannot be sent.
    """

    result: Any = None
    open_maps: tuple[OpenMap, ...] = ()
    error: BaseException | None = None
    traceback: str = ""

    def opened(self) -> tuple[Any, tuple[OpenMap, ...]]:
        """Return the result and the open maps, or raise the error."""
        if self.error is not None:
            raise self.error from TracebackInWorker(self.traceback)
        return self.result, self.open_maps


class TracebackInWorker(Exception):
    """The cause of an error that a task raised; the log shows it."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def serve(connection: Connection, settings: WorkerSettings, signals: Signals) -> None:
    """Do one task after another, until the main process closes its end of the connection.

    Args:
        signals: shared with the main process.
    """
    # Both may reach all processes of a group, and the main process decides when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if settings.configure_logging is not None:
        settings.configure_logging()
    from service.workers.vision import Vision  # not in the main process, which has this module too

    vision = Vision(settings, signals)
    with suppress(EOFError, OSError):  # of the connection
        while True:
            connection.send_bytes(_reply_to(connection.recv_bytes(), vision))


def _reply_to(message: bytes, vision: Vision) -> bytes:
    try:
        task, threads = pickle.loads(message)
        vision.use_threads(threads)
        reply = Reply(task(vision), vision.open_maps)
        return pickle.dumps(reply, pickle.HIGHEST_PROTOCOL)
    except BaseException as error:  # noqa: BLE001  whatever it is, the main process gets it
        text = "".join(format_exception(error))
        return pickle.dumps(Reply(error=error, traceback=text), pickle.HIGHEST_PROTOCOL)


def _end_with_parent() -> None:
    """End when the main process was killed; else this one would wait for tasks for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
