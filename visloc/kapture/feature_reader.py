"""Reading ready-made features: keypoints, descriptors and global features of any type.

The files are not trusted: types are looked up in a table, sizes are checked before reading, and
paths stay inside the folder.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.errors import VislocError, refuse
from visloc.kapture.feature_layout import COLUMNS, DTYPES, FeatureKind, feature_file, parse_dtype
from visloc.kapture.feature_tar import index_tar
from visloc.kapture.table import Table

_TYPE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_MAX_DSIZE = 2**20
# 200 000 keypoints with 256 float32 each are 195 MiB.
_MAX_FILE_BYTES = 2**29


@dataclass(frozen=True, slots=True, eq=False)
class FeatureSet:
    """The files of one kind and type of features, open for reading. It can be pickled.

    Attributes:
        type_name: folder TYPE.
        name: name of the method in the config file.
        dsize: numbers per row.
        keypoints_type: TYPE of the keypoints that descriptors belong to; None for other kinds.
        metric_type: how rows are compared, as in the config file; None for keypoints.
        folder: holds the config file, and the files of the images or ``<kind>.tar``.
        members: offset and size by file name in ``<kind>.tar``, which hides other files; None
            without it.
    """

    kind: FeatureKind
    type_name: str
    name: str
    dtype: np.dtype[Any]
    dsize: int
    keypoints_type: str | None
    metric_type: str | None
    folder: Path
    members: Mapping[str, tuple[int, int]] | None

    def has(self, image_path: str) -> bool:
        """Tell whether an image has a file.

        Raises:
            DatasetError: ``kapture.path``.
        """
        name = feature_file(self.kind, image_path)
        return (self.folder / name).is_file() if self.members is None else name in self.members

    def count(self, image_path: str) -> int:
        """Return the number of rows of an image without reading them.

        Raises:
            DatasetError: as ``read``.
        """
        return self._num_rows(image_path, self._place(image_path)[2])

    def read(self, image_path: str) -> NDArray[Any]:
        """Return the rows (N, dsize) of an image in their own type; N = 1 for global features.

        Raises:
            DatasetError: with the file: ``kapture.path``, ``kapture.feature_missing``,
                ``kapture.feature_size``, ``kapture.feature_too_large``, ``kapture.unreadable``.
        """
        path, offset, size = self._place(image_path)
        num_rows = self._num_rows(image_path, size)
        try:
            with path.open("rb") as file:
                file.seek(offset)
                content = file.read(size)
        except OSError as error:
            raise self._unreadable(image_path, error) from error
        if len(content) != size:
            raise refuse(
                "kapture.unreadable",
                "the file became shorter while it was read",
                field=self.label(image_path),
                expected=f"{size} bytes",
                got=f"{len(content)} bytes",
            )
        return np.frombuffer(content, self.dtype).reshape(num_rows, self.dsize).copy()

    def label(self, image_path: str) -> str:
        """Name the file of an image, for error messages."""
        holder = self.folder if self.members is None else self.folder / f"{self.kind}.tar"
        return str(holder / feature_file(self.kind, image_path))

    def _place(self, image_path: str) -> tuple[Path, int, int]:
        """File, offset and size in bytes of an image's rows."""
        name = feature_file(self.kind, image_path)
        if self.members is not None:
            if name in self.members:
                return (self.folder / f"{self.kind}.tar", *self.members[name])
            raise self._missing(image_path)
        path = self.folder / name
        try:
            status = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            raise self._missing(image_path) from None
        except OSError as error:
            raise self._unreadable(image_path, error) from error
        if not stat.S_ISREG(status.st_mode):
            raise self._missing(image_path)
        return path, 0, status.st_size

    def _num_rows(self, image_path: str, size: int) -> int:
        row_bytes = self.dtype.itemsize * self.dsize
        if size > _MAX_FILE_BYTES:
            raise refuse(
                "kapture.feature_too_large",
                field=self.label(image_path),
                expected=f"at most {_MAX_FILE_BYTES} bytes",
                got=f"{size} bytes",
            )
        rows_expected = "1 row" if self.kind == "global_features" else "whole rows"
        if size % row_bytes or (self.kind == "global_features" and size != row_bytes):
            raise refuse(
                "kapture.feature_size",
                field=self.label(image_path),
                expected=f"{rows_expected} of {self.dsize} {self.dtype.name}, {row_bytes} bytes",
                got=f"{size} bytes",
                what=self.kind,
            )
        return size // row_bytes

    def _missing(self, image_path: str) -> VislocError:
        return refuse(
            "kapture.feature_missing",
            field=self.label(image_path),
            what=self.kind.replace("_", " "),
            type_name=self.type_name,
        )

    def _unreadable(self, image_path: str, error: OSError) -> VislocError:
        return refuse(
            "kapture.unreadable", field=self.label(image_path), got=error.strerror or str(error)
        )


def open_features(
    root: Path, kind: FeatureKind, type_name: str, features_dir: Path | None = None
) -> FeatureSet:
    """Find the features of one kind and type.

    Args:
        root: the dataset; features lie in ``reconstruction/<kind>/TYPE``.
        kind: ``keypoints``, ``descriptors`` or ``global_features``.
        type_name: folder TYPE.
        features_dir: where to look instead of the dataset: in ``local_features/TYPE/<kind>``
            (``global_features/TYPE/<kind>``), ``TYPE/<kind>``, ``reconstruction/<kind>/TYPE``,
            ``<kind>/TYPE``, in this order.

    Raises:
        InvalidInput: ``kapture.feature_type`` for an impossible name.
        DatasetError: ``kapture.no_features`` with the places and existing types;
            ``kapture.version`` for the layout of kapture 1.0; ``kapture.tar``; errors of the config
            file with its line.
    """
    if not _TYPE_NAME.fullmatch(type_name):
        raise refuse("kapture.feature_type", field=kind, got=type_name)
    for pattern in _patterns(kind, features_dir):
        folder = (features_dir or root) / pattern.format(type_name)
        if (folder / f"{kind}.txt").is_file():
            return _open_folder(folder, kind, type_name)
    raise _not_found(root, kind, type_name, features_dir)


def open_local_features(
    root: Path, type_name: str, features_dir: Path | None = None
) -> tuple[FeatureSet, FeatureSet]:
    """Find the descriptors of one type and the keypoints that they belong to.

    Returns:
        The keypoints and the descriptors. Their types can differ: a published dataset describes
        keypoints of type HessianAffine by descriptors of type HOG.

    Raises:
        InvalidInput, DatasetError: as ``open_features``.
    """
    descriptors = open_features(root, "descriptors", type_name, features_dir)
    keypoints_type = descriptors.keypoints_type or type_name
    return open_features(root, "keypoints", keypoints_type, features_dir), descriptors


def feature_types(
    root: Path, kind: FeatureKind, features_dir: Path | None = None
) -> tuple[str, ...]:
    """Return the types that ``open_features`` finds, sorted."""
    found = set()
    for pattern in _patterns(kind, features_dir):
        before, after = (part.strip("/") for part in pattern.split("{}"))
        folder = (features_dir or root) / before
        for name in _folders(folder):
            if _TYPE_NAME.fullmatch(name) and (folder / name / after / f"{kind}.txt").is_file():
                found.add(name)
    return tuple(sorted(found))


def _patterns(kind: FeatureKind, features_dir: Path | None) -> tuple[str, ...]:
    inside = f"reconstruction/{kind}/{{}}"
    if features_dir is None:
        return (inside,)
    family = "global_features" if kind == "global_features" else "local_features"
    return f"{family}/{{}}/{kind}", f"{{}}/{kind}", inside, f"{kind}/{{}}"


def _folders(folder: Path) -> Iterator[str]:
    try:
        with os.scandir(folder) as entries:
            yield from (entry.name for entry in entries if entry.is_dir())
    except OSError:  # absent, or not a folder: it has none
        return


def _not_found(
    root: Path, kind: FeatureKind, type_name: str, features_dir: Path | None
) -> VislocError:
    base = features_dir or root
    words = kind.replace("_", " ")
    old = base / "reconstruction" / kind / f"{kind}.txt"
    if old.is_file():
        return refuse(
            "kapture.version",
            f"the {words} are stored as in kapture 1.0; move the files one folder down, "
            f"into {kind}/{type_name}, and complete the line of {kind}.txt",
            field=str(old),
            expected=f"reconstruction/{kind}/TYPE/{kind}.txt with {', '.join(COLUMNS[kind])}",
        )
    places = ", ".join(pattern.format(type_name) for pattern in _patterns(kind, features_dir))
    types = ", ".join(feature_types(root, kind, features_dir)) or "none"
    return refuse(
        "kapture.no_features",
        field=str(base),
        expected=f"{kind}.txt in {places}; types there: {types}",
        got=type_name,
        what=words,
    )


def _open_folder(folder: Path, kind: FeatureKind, type_name: str) -> FeatureSet:
    # An absolute second part is the whole path: errors name the file in full.
    table = Table(folder, str((folder / f"{kind}.txt").absolute()), len(COLUMNS[kind]))
    sets = []
    for fields in table:
        name, dtype_name, dsize_text, *rest = fields
        dtype = parse_dtype(dtype_name)
        if dtype is None:
            raise table.error("kapture.dtype", expected=DTYPES, got=dtype_name)
        fewest = 2 if kind == "keypoints" else 1  # x and y
        dsize = int(dsize_text) if re.fullmatch(r"[0-9]{1,7}", dsize_text) else 0
        if not fewest <= dsize <= _MAX_DSIZE:
            raise table.error(
                "kapture.dsize",
                expected=f"an integer from {fewest} to {_MAX_DSIZE}",
                got=dsize_text,
            )
        keypoints_type = rest[0] if kind == "descriptors" else None
        sets.append((name, dtype, dsize, keypoints_type, rest[-1] if rest else None))
    if len(sets) != 1:
        raise table.error(
            "kapture.feature_config",
            expected=f"one line: {', '.join(COLUMNS[kind])}",
            got=f"{len(sets)} lines",
            what=kind.replace("_", " "),
        )
    tar = folder / f"{kind}.tar"
    members = index_tar(tar) if tar.exists() else None
    return FeatureSet(kind, type_name, *sets[0], folder, members)
