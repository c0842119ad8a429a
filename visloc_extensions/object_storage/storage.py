"""Objects of an fsspec URL, and whether they can be reached."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

import fsspec

from visloc.archive.backends.folder import FULL
from visloc.archive.schema import ID_PATTERN
from visloc.errors import VislocError, refuse

logger = logging.getLogger(__name__)

# After a failure the storage is left alone for so long.
AWAY_S = 5.0
CONNECT_TIMEOUT_S, READ_TIMEOUT_S = 3, 10
NEVER = -math.inf
_AT_ONCE = 256  # small objects that are asked for together


class Storage:
    """The objects below one URL."""

    def __init__(self, url: str) -> None:
        if "::" in url:
            raise ValueError("URLs of several parts (::) are not for maps")
        parts = urlsplit(url)
        # Credentials that the URL may carry are never shown.
        self.url = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}".rstrip("/")
        self.is_s3 = parts.scheme == "s3"
        options: dict[str, Any] = {"skip_instance_cache": True, "use_listings_cache": False}
        if self.is_s3:
            options["config_kwargs"] = {
                "connect_timeout": CONNECT_TIMEOUT_S,
                "read_timeout": READ_TIMEOUT_S,
                "retries": {"mode": "standard", "total_max_attempts": 1},
            }
        self.fs, root = fsspec.core.url_to_fs(url, **options)
        self.root = root.rstrip("/")
        if self.is_s3:
            self.fs.retries = 2  # of five, each up to the timeout
        self.away_until = NEVER

    @property
    def is_away(self) -> bool:
        """Whether the last request failed."""
        return self.away_until > NEVER

    def path(self, *names: str) -> str:
        """The path of an object, as fsspec knows it."""
        return "/".join((self.root, *names))

    def names_in(self, path: str) -> list[str]:
        """Names directly below a path that can be those of a map or version, sorted."""
        try:
            listed = self.fs.ls(path, detail=False)
        except FileNotFoundError:
            return []
        names = (PurePosixPath(found).name for found in listed)
        return sorted({name for name in names if ID_PATTERN.fullmatch(name)})

    def sizes_in(self, path: str) -> dict[str, int]:
        """Sizes of all objects below a path, by the rest of their names."""
        found = self.fs.find(path, detail=True)
        return {name[len(path) + 1 :]: info["size"] for name, info in found.items()}

    def contents(self, paths: Sequence[str]) -> Iterator[bytes | None]:
        """Small objects, in their order; None for one that is missing."""
        for start in range(0, len(paths), _AT_ONCE):
            some = list(paths[start : start + _AT_ONCE])
            with self.asking():
                found = self.fs.cat(some, on_error="return")
                for path in some:
                    if not isinstance(found[path], bytes | FileNotFoundError):
                        raise found[path]
            for path in some:
                yield found[path] if isinstance(found[path], bytes) else None

    def exists(self, path: str) -> bool:
        """Tell whether there is an object."""
        with self.asking():
            return bool(self.fs.exists(path))

    def fetch(self, path: str, target: Path) -> None:
        """Copy an object into a file."""
        with self.asking():
            self.fs.get_file(path, str(target))

    @contextmanager
    def asking(self) -> Iterator[None]:
        """Ask the storage; leave it alone for a while if it does not answer."""
        if monotonic() < self.away_until:
            raise self.away("it did not answer a moment ago")
        try:
            yield
        except VislocError:
            raise
        except FileNotFoundError:
            raise self.away("something is missing: removed just now, or no such bucket") from None
        except Exception as error:  # of whatever library serves the URL
            if isinstance(error, OSError) and error.errno in FULL:  # of this machine
                raise
            self.away_until = monotonic() + AWAY_S
            logger.warning("%s is away: %s", self.url, type(error).__name__)
            raise self.away(type(error).__name__) from None  # its text may tell secrets
        self.away_until = NEVER

    def away(self, why: str) -> VislocError:
        """``maps.storage_away``."""
        return refuse("maps.storage_away", field=self.url, got=why)
