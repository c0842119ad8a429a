"""The places that a build reads and writes: folders, and URLs that fsspec knows.

A URL is a ``UPath``, which has the part of ``Path``'s interface that is used here.
"""

from __future__ import annotations

import errno
import hashlib
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, cast

from visloc.archive import MapStore, open_remote_store, sha256_of
from visloc.errors import VislocError, refuse
from visloc.kapture import Dataset, read_dataset

# kapture's text files are fetched; everything else is read where it lies.
_TABLES = ("sensors/*.txt", "reconstruction/*.txt")
_DATA = "sensors/records_data"
# A disk that was full or away: with room, or when it is back, the job goes on.
_PASSING = frozenset(
    (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ESTALE, errno.ETIMEDOUT)
)
_RESUMES = "; finished work is kept, and the same command resumes"


def place_of(text: str, option: str) -> Path:
    """Return the place of a folder's name or a URL."""
    text = text.removeprefix("file://")
    if "://" not in text:
        return Path(text)
    if "::" in text or "@" in text:
        raise _bad_url(option, "credentials, or a URL of several parts")
    try:
        from upath import UPath  # with the libraries of URLs, which are optional

        # Other machines write there too.
        place = UPath(text, use_listings_cache=False)
        place.fs  # noqa: B018  raises if the library for this kind of URL is missing
    except (ImportError, ValueError) as error:
        raise _bad_url(option, str(error)) from error
    return cast("Path", place)


def _bad_url(option: str, got: str) -> VislocError:
    return refuse("build.url", field=option, got=got)


def is_remote(place: Path) -> bool:
    """Tell whether a place is a URL."""
    return not isinstance(place, PurePath)


def remove_folder(place: Path) -> None:
    """Remove the folder at a URL, if it exists."""
    remote: Any = place
    if remote.fs.exists(remote.path):
        remote.fs.rm(remote.path, recursive=True)


def storage_errors() -> tuple[type[Exception], ...]:
    """Return the errors that failing storage raises, with the libraries in use."""
    botocore = sys.modules.get("botocore.exceptions")
    return (OSError,) if botocore is None else (OSError, botocore.BotoCoreError)


def storage_failed(error: Exception, place: Path) -> VislocError:
    """Return the refusal of a job whose storage failed.

    It says that the same command resumes only where nothing but the storage must change for that.

    Args:
        place: of the job's work, named where the error names no file.
    """
    passes = not isinstance(error, OSError) or error.errno in _PASSING
    return refuse(
        "storage.failed",
        field=str(getattr(error, "filename", None) or place),
        why=f"{getattr(error, 'strerror', None) or error}" + (_RESUMES if passes else ""),
    )


def open_store(maps_dir: Path, cache_dir: Path) -> MapStore:
    """Return the store of a folder, or of a URL with local copies in ``cache_dir``."""
    if not is_remote(maps_dir):
        return MapStore(maps_dir)
    try:
        return open_remote_store(str(maps_dir), cache_dir, sys.maxsize)
    except ImportError as error:
        raise _bad_url("--maps-dir", str(error)) from error


def is_map_folder(ref: str) -> bool:
    """Tell whether a map is given as a folder, not as id or id@version."""
    return (Path(ref) / "manifest.json").is_file()


def map_folder(ref: str, maps_dir: Path) -> Path:
    """Return the folder of a map: id, id@version, or the folder itself."""
    return Path(ref) if is_map_folder(ref) else MapStore(maps_dir).folder(ref)


def lies_in(place: Path, other: Path) -> bool:
    """Tell whether a place is inside another, or equal to it."""
    if is_remote(place) != is_remote(other):
        return False
    if is_remote(place):
        return f"{place}/".replace("//", "/").startswith(f"{other}/".replace("//", "/"))
    return place.resolve().is_relative_to(other.resolve())


def work_place(place: Path, map_id: str) -> Path:
    """Return the folder, of its own, for finished work of a map."""
    return place / ".work" / map_id


def scratch_folder(maps_dir: Path, cache_dir: Path, map_id: str) -> Path:
    """Return the folder for files of a build that only this machine needs."""
    if not is_remote(maps_dir):
        return maps_dir / ".work" / map_id
    name = hashlib.sha256(str(maps_dir).encode()).hexdigest()[:16]
    return cache_dir / ".builds" / name / map_id


@contextmanager
def opened_dataset(place: Path) -> Iterator[Dataset]:
    """Read a dataset; at a URL, fetch its tables and leave photos where they are."""
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
        tags: the storage's tag of each file's content, by name; "" if it has none.
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
