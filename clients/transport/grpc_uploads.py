"""A packed map over gRPC."""

from __future__ import annotations

from collections.abc import Iterator

from clients.transport.messages import version_message
from clients.transport.uploads import OnProgress, Upload, pieces
from visloc.errors import VislocError
from visloc_api.v1 import localization_pb2 as wire


class UploadFeed:
    """The messages of an upload, which end early when the file fails.

    gRPC would only log what an iterator raises. A server takes nothing that ends early.

    Attributes:
        failure: what the file raised.
    """

    def __init__(self, upload: Upload, on_progress: OnProgress) -> None:
        self._upload, self._on_progress = upload, on_progress
        self.failure: VislocError | OSError | None = None

    def messages(self) -> Iterator[bytes]:
        """Give the messages, read as they are sent."""
        yield self._start()
        try:
            for piece in pieces(self._upload, self._on_progress):
                yield _chunk(piece)
        except (VislocError, OSError) as error:
            self.failure = error

    def _start(self) -> bytes:
        start = version_message(self._upload.map_id, self._upload.version)
        return wire.PutVersionRequest(start=start).SerializeToString()


def _chunk(piece: bytes) -> bytes:
    return wire.PutVersionRequest(chunk=piece).SerializeToString()
