"""The backend of a store: the operations that its rules need from a folder or object storage."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from visloc.archive.reader import MapOutline
from visloc.archive.set_outline import SetOutline
from visloc.archive.set_rules import AnyManifest
from visloc.errors import MapCorrupt

CURRENT, MANIFEST = "current", "manifest.json"


class Backend(Protocol):
    """Versions of maps and sets in one place. Ids and versions are checked before they get here.

    A place on another machine raises Unavailable ``maps.storage_away`` from every method.
    """

    is_local: bool
    """Whether looking for one file is cheap."""

    @property
    def reachable(self) -> bool:
        """Whether the place answered when it was last asked."""

    def ids(self) -> list[str]:
        """Sorted ids that have a current version."""

    def versions(self, map_id: str) -> list[str]:
        """Sorted published versions."""

    def current(self, map_id: str) -> str | None:
        """The text of the file ``current``, which may name no version; None if it is missing."""

    def has_version(self, map_id: str, version: str) -> bool:
        """Tell whether a version is published."""

    def has_file(self, map_id: str, version: str, name: str) -> bool:
        """Tell whether a version has a file."""

    def address(self, *names: str) -> str:
        """The path or URL of something in this place, for error messages."""

    def manifests(
        self, refs: Sequence[tuple[str, str]]
    ) -> Iterator[AnyManifest | MapCorrupt | None]:
        """The manifest of each version; the error if it is damaged; None if it is missing."""

    def local_folder(self, map_id: str, version: str) -> Path | None:
        """The local folder of a version if it can be used now; None if it must be fetched."""

    def folder(self, map_id: str, version: str) -> Path:
        """The local folder of a version, fetched first where necessary."""

    def outline(self, map_id: str, version: str) -> MapOutline | SetOutline:
        """Read what a version says about itself, without fetching its arrays."""

    def changing(self) -> AbstractContextManager[None]:
        """Hold the lock of this place. Within it, ``versions`` and ``current`` are up to date."""

    def publish(
        self,
        incoming: Path,
        map_id: str,
        version: str,
        *,
        make_current: bool,
        based_on: str | None,
    ) -> Path:
        """Take in a verified version and return its local folder. Only within ``changing``.

        A reader finds all of the version or nothing. Killed before ``current`` is switched, the
        version is there and the one before it stays current.

        Args:
            map_id: the map's id.
            version: the version's name.
            based_on: the version that ``current`` must still name when it is switched.
        """

    def set_current(self, map_id: str, version: str) -> None:
        """Switch ``current`` atomically. Only within ``changing``."""

    def withdraw(self, map_id: str) -> None:
        """Remove ``current`` atomically; the versions stay. Only within ``changing``."""

    def remove(self, map_id: str, version: str, *, is_last: bool) -> Callable[[], object]:
        """Make a version disappear; with the last one, the map. Only within ``changing``.

        Returns:
            What deletes its files, to be called after ``changing``, as it can take long.
        """

    def incoming(self) -> AbstractContextManager[Path]:
        """Give an empty folder for a version that is to be published."""

    def sweep(self) -> None:
        """Delete what killed processes left behind."""


def text_of_current(content: bytes) -> str:
    """Decode the file ``current``, whatever is in it."""
    return content[:200].decode("ascii", "backslashreplace").strip()
