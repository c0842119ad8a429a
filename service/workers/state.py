"""State that travels between worker processes, without what each of them has open."""

from __future__ import annotations

import io
import pickle
from collections.abc import Mapping
from typing import Any


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, kept: Mapping[str, object]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._names = {id(each): name for name, each in kept.items()}

    def persistent_id(self, obj: Any) -> str | None:
        return self._names.get(id(obj))


class _Unpickler(pickle.Unpickler):
    def __init__(self, state: bytes, kept: Mapping[str, object]) -> None:
        super().__init__(io.BytesIO(state))
        self._kept = kept

    def persistent_load(self, pid: Any) -> object:
        return self._kept[pid]


def packed(state: object, kept: Mapping[str, object]) -> bytes:
    """Pickle a state, but name the objects that every process has of its own."""
    buffer = io.BytesIO()
    _Pickler(buffer, kept).dump(state)
    return buffer.getvalue()


def unpacked(state: bytes, kept: Mapping[str, object]) -> Any:
    """Load what ``packed`` wrote in this service, with this process's objects of these names."""
    return _Unpickler(state, kept).load()
