"""The API keys of a running service, kept up to date with their file."""

from __future__ import annotations

import logging
from pathlib import Path

from service.security.key_file import Key, read_keys, split_token
from visloc.errors import InvalidInput

logger = logging.getLogger(__name__)

# Compared with unknown keys, so that their refusal takes as long.
_NOBODY = Key("0" * 12, "nobody", frozenset(), "", bytes(16), bytes(32), None, None, None)


class KeyRing:
    """Finds keys; reads the file again when it has changed.

    If the changed file cannot be used, that is logged and the old keys stay valid.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._version = self._version_now()
        self._keys = _by_id(read_keys(path))

    def find(self, token: str) -> Key | None:
        """Return the key of a token, None for an unknown or revoked one."""
        self._take_over_changes()
        id_, secret = split_token(token) or ("", "")
        key = self._keys.get(id_, _NOBODY)
        return key if key.fits(secret) and key is not _NOBODY else None

    def _take_over_changes(self) -> None:
        version = self._version_now()
        if version == self._version:
            return
        self._version = version
        try:
            self._keys = _by_id(read_keys(self._path))
        except InvalidInput as error:
            logger.error("the API keys were not reloaded: %s", error)  # noqa: TRY400
        else:
            logger.info("reloaded the API keys: %d are valid", len(self._keys))

    def _version_now(self) -> tuple[int, ...] | None:
        try:
            stat = self._path.stat()
        except OSError:
            return None
        return stat.st_mtime_ns, stat.st_size, stat.st_ino, stat.st_mode


def _by_id(keys: tuple[Key, ...]) -> dict[str, Key]:
    return {key.id: key for key in keys}
