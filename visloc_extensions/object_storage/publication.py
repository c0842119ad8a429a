"""Writing versions into object storage, where another server may publish at the same time.

There are no renames and no locks. ``manifest.json`` is written last: its presence publishes a
version. On S3 every object of a version is written on the condition that it does not exist yet, so
that no publisher changes what another one has written:

- Publishers of the same version write in the same order. A publisher that finds an object with
  other bytes gives up, so that only one of them reaches the manifest.
- Objects with the same bytes stay: the next attempt continues an interrupted publication.
- Objects with other bytes are deleted when nothing was added to them for ``LEFTOVER_S``.

``current`` is one small object: the last writer wins. A publication that is based on a version
replaces ``current`` on the condition that it still names that version.

Other storages, and S3 servers that ignore conditions, have no such protection: there, only one
server at a time may publish. A warning in the log says so.
"""

from __future__ import annotations

import hashlib
import logging
import secrets
from datetime import UTC, datetime, timedelta
from pathlib import Path

from visloc.archive.backends.base import CURRENT, MANIFEST, text_of_current
from visloc.archive.checks import sha256_of
from visloc.archive.version_rules import outdated, version_exists
from visloc.errors import VislocError, refuse
from visloc_extensions.object_storage.storage import Storage

logger = logging.getLogger(__name__)

LEFTOVER_S = 3600.0
# The last one is for two such writes at the same moment.
_CONDITION_CODES = ("PreconditionFailed", "412", "ConditionalRequestConflict")
_TOKEN = "publication"  # the metadata that tells the manifest of one publication from others


class Publisher:
    """Writes versions and ``current`` into a storage."""

    def __init__(self, storage: Storage) -> None:
        self._storage, self._fs = storage, storage.fs
        self._has_conditions: bool | None = None

    def write(self, folder: Path, map_id: str, version: str) -> None:
        """Write the files of a version, the manifest last."""
        place = self._storage.path(map_id, version)
        files = {
            path.relative_to(folder).as_posix(): path
            for path in sorted(folder.rglob("*"))
            if path.is_file() and path.name != MANIFEST
        }
        manifest = folder / MANIFEST
        with self._storage.asking():
            if not self._checks_conditions(files, place):
                self._overwrite({**files, MANIFEST: manifest}, place)
                return
            if not self._add(files, place):
                self._delete_leftover(place, map_id, version)
                if not self._add(files, place):
                    raise _upload_runs(map_id, version)
            token = secrets.token_hex(8)
            target = f"{place}/{MANIFEST}"
            # A request whose answer was lost is repeated, and then finds what it has written.
            if not self._create(manifest, target, token) and self._token_of(target) != token:
                raise version_exists(map_id, version)
            for name in self._storage.sizes_in(place).keys() - files.keys() - {MANIFEST}:
                self._fs.rm_file(f"{place}/{name}")

    def write_current(self, map_id: str, version: str, based_on: str | None = None) -> None:
        """Make a version current.

        Args:
            map_id: the map's id.
            version: the version's name.
            based_on: the version that must still be current; None for any.
        """
        target, content = self._storage.path(map_id, CURRENT), f"{version}\n".encode()
        with self._storage.asking():
            if based_on is None or not self._has_conditions:
                self._fs.pipe_file(target, content)
                return
            found = self._replaced_current(target, content, based_on)
        if found != version:
            raise outdated(map_id, based_on, found)

    def _replaced_current(self, target: str, content: bytes, based_on: str) -> str | None:
        """Replace ``current`` if it names a version; return the version that it names now."""
        try:
            # The tag first: if another publisher writes in between, the condition fails.
            tag = self._fs.info(target)["ETag"]
            found = text_of_current(self._fs.cat_file(target))
            if found != based_on:
                return found
            self._fs.pipe_file(target, content, IfMatch=tag)
        except FileNotFoundError:
            return None
        except OSError as error:
            if not _is_condition(error):
                raise
        # Also after a lost answer, when the repeated request finds what it has written.
        return text_of_current(self._fs.cat_file(target))

    def _overwrite(self, files: dict[str, Path], place: str) -> None:
        if self._fs.exists(place):  # what an interrupted publication left
            self._fs.rm(place, recursive=True)
        for name, path in files.items():
            target = f"{place}/{name}"
            if not self._storage.is_s3:  # where it would create a bucket whose name was mistyped
                self._fs.makedirs(target.rpartition("/")[0], exist_ok=True)
            self._fs.put_file(str(path), target)

    def _add(self, files: dict[str, Path], place: str) -> bool:
        """Write the files that are missing; False if one is there with other bytes."""
        there = self._storage.sizes_in(place)
        return all(
            (name not in there and self._create(path, f"{place}/{name}"))
            or self._is_same(path, f"{place}/{name}")
            for name, path in files.items()
        )

    def _create(self, path: Path, target: str, token: str = "") -> bool:
        """Write a file unless there is such an object; tell whether it was written."""
        options = {"Metadata": {_TOKEN: token}} if token else {}
        try:
            self._fs.put_file(str(path), target, mode="create", **options)
        except OSError as error:
            if not _is_condition(error):
                raise
            return False
        return True

    def _is_same(self, path: Path, target: str) -> bool:
        if self._fs.info(target)["size"] != path.stat().st_size:
            return False
        with self._fs.open(target, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest() == sha256_of(path)

    def _delete_leftover(self, place: str, map_id: str, version: str) -> None:
        """Delete an unfinished version to which nobody has added for a long time."""
        found = self._fs.find(place, detail=True)
        if f"{place}/{MANIFEST}" in found:
            raise version_exists(map_id, version)
        newest = max((info["LastModified"] for info in found.values()), default=datetime.now(UTC))
        if datetime.now(UTC) - newest <= timedelta(seconds=LEFTOVER_S):
            raise _upload_runs(map_id, version)
        logger.info("deleting what a publication of %s@%s left behind", map_id, version)
        self._fs.rm(place, recursive=True)

    def _token_of(self, target: str) -> str | None:
        found = self._fs.metadata(target).get(_TOKEN)
        return None if found is None else str(found)

    def _checks_conditions(self, files: dict[str, Path], place: str) -> bool:
        """Tell whether the storage refuses to overwrite: found out by creating a file twice."""
        if self._has_conditions is None:
            # The first one, so that all publishers still write in the same order.
            name, path = next(iter(files.items()))
            self._has_conditions = self._storage.is_s3 and not all(
                self._create(path, f"{place}/{name}") for _ in range(2)
            )
            if not self._has_conditions:
                logger.warning(
                    "%s has no conditional writes: publish from one server at a time",
                    self._storage.url,
                )
        return self._has_conditions


def _is_condition(error: OSError) -> bool:
    """Tell whether a condition of a write did not hold."""
    # s3fs makes it a FileExistsError only if the server names the condition.
    response = getattr(error.__cause__, "response", {})
    code = response.get("Error", {}).get("Code")
    return isinstance(error, FileExistsError) or code in _CONDITION_CODES


def _upload_runs(map_id: str, version: str) -> VislocError:
    return refuse(
        "map.upload_runs",
        "another server is publishing this version, or was interrupted in the last hour; "
        "try again later, or publish under another name",
        field="version",
        got=f"{map_id}@{version}",
    )
