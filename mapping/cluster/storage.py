"""Places that a build reads from and writes to: folders, and URLs that fsspec knows.

A URL is a ``UPath``, which has the interface of a ``Path`` as far as it is used here.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, cast

from visloc.archive import MapStore, sha256_of
from visloc.errors import VislocError, refuse
from visloc.kapture import Dataset, read_dataset

# What kapture keeps in text of a dataset; all else is read where it lies.
_TABLES = ("sensors/*.txt", "reconstruction/*.txt")
_DATA = "sensors/records_data"


def place_of(text: str, option: str) -> Path:
    """Return the place that a folder's name or a URL stands for.

    Raises:
        InvalidInput: ``build.url`` for one that cannot be used.
    """
    text = text.removeprefix("file://")
    if "://" not in text:
        return Path(text)
    if "::" in text or "@" in text:
        raise _bad_url(option, "credentials, or a URL of several parts")
    try:
        from upath import UPath  # with the libraries of URLs, which are optional

        # Other machines write there too.
        place = UPath(text, use_listings_cache=False)
        place.fs  # noqa: B018  raises where the library of this kind of URL is missing
    except (ImportError, ValueError) as error:
        raise _bad_url(option, str(error)) from error
    return cast("Path", place)


def _bad_url(option: str, got: str) -> VislocError:
    return refuse("build.url", field=option, got=got)


def is_remote(place: Path) -> bool:
    """Tell whether a place is a URL."""
    return not isinstance(place, PurePath)


def remove_folder(place: Path) -> None:
    """Remove a folder of a URL, if it is there, with all that is in it."""
    remote: Any = place
    if remote.fs.exists(remote.path):
        remote.fs.rm(remote.path, recursive=True)


def storage_errors() -> tuple[type[Exception], ...]:
    """Return what a storage that fails raises, as far as libraries of URLs are in use."""
    botocore = sys.modules.get("botocore.exceptions")
    return (OSError,) if botocore is None else (OSError, botocore.BotoCoreError)


def open_store(maps_dir: Path, cache_dir: Path) -> MapStore:
    """Return the store of a folder, or of a URL with copies in a folder."""
    if not is_remote(maps_dir):
        return MapStore(maps_dir)
    from visloc.archive.remote_store import RemoteMapStore  # its libraries are optional

    return cast("MapStore", RemoteMapStore(str(maps_dir), cache_dir, sys.maxsize))


def lies_in(place: Path, other: Path) -> bool:
    """Tell whether a place is in another, or is the same."""
    if is_remote(place) != is_remote(other):
        return False
    if is_remote(place):
        return f"{place}/".replace("//", "/").startswith(f"{other}/".replace("//", "/"))
    return place.resolve().is_relative_to(other.resolve())


def work_place(place: Path, map_id: str) -> Path:
    """Return where a place keeps finished work of a map: in a folder that is only for that."""
    return place / ".work" / map_id


def scratch_folder(maps_dir: Path, cache_dir: Path, map_id: str) -> Path:
    """Return where a build of a map keeps what only this machine needs, beside its maps."""
    if not is_remote(maps_dir):
        return maps_dir / ".work" / map_id
    name = hashlib.sha256(str(maps_dir).encode()).hexdigest()[:16]
    return cache_dir / ".builds" / name / map_id


@contextmanager
def opened_dataset(place: Path) -> Iterator[Dataset]:
    """Read a dataset; of a URL its tables are fetched, and its photos read where they lie.

    Raises:
        DatasetError: what ``read_dataset`` raises.
    """
    if not is_remote(place):
        yield read_dataset(place)
        return
    remote: Any = place
    files = remote.fs
    top = remote.path.rstrip("/")
    with tempfile.TemporaryDirectory(prefix="visloc-dataset-") as folder:
        for pattern in _TABLES:
            for name in files.glob(f"{top}/{pattern}"):
                target = Path(folder) / name[len(top) + 1 :]
                target.parent.mkdir(exist_ok=True)
                files.get_file(name, str(target))
        found = files.find(f"{top}/{_DATA}", detail=True)
        start = len(f"{top}/{_DATA}/")
        tags = {name[start:]: str(info.get("ETag", "")) for name, info in found.items()}
        yield read_dataset(Path(folder), _RemoteFiles(place / _DATA, tags))


@dataclass(frozen=True, slots=True, eq=False)
class _RemoteFiles:
    """Photos and depth maps below a URL, listed once.

    Attributes:
        folder: the URL.
        tags: of each file by name, what its storage calls its content; "" where that does not tell.
    """

    folder: Path
    tags: Mapping[str, str]

    def path_of(self, name: str) -> Path:
        return self.folder / name

    def has(self, name: str) -> bool:
        return name in self.tags

    def identity(self, name: str) -> str:
        return self.tags[name] or sha256_of(self.path_of(name))

    def without_listing(self) -> _RemoteFiles:
        return replace(self, tags={})
