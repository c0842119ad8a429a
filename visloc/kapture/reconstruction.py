"""3D points of a dataset and their observations: points3d.txt and observations.txt."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.errors import VislocError, refuse
from visloc.kapture.feature_reader import FeatureSet, feature_types, open_features
from visloc.kapture.table import Table
from visloc.kapture.text import is_field, is_path_field
from visloc.kapture.writer import VERSION_LINE, write_atomically

_POINTS = "reconstruction/points3d.txt"
_OBSERVATIONS = "reconstruction/observations.txt"
_MAX_INDEX = 2**31
_MAX_DIGITS = 18


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """3D points and their observations by keypoints of one type.

    Attributes:
        points: (P, 3) float64 in the world.
        colors: (P, 3) uint8 RGB; None without.
        keypoints_type: folder TYPE of the keypoints; None when there are no observations.
        images: paths of the observing images, each once.
        observations: (M, 3) int64: row of ``points``, row of ``images``, row of that image's
            keypoints. An image can see a point several times.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.uint8] | None
    keypoints_type: str | None
    images: tuple[str, ...]
    observations: NDArray[np.int64]


def read_reconstruction(
    root: Path, keypoints_type: str | None = None, features_dir: Path | None = None
) -> Reconstruction | None:
    """Read the points of a dataset and the observations by one type of keypoints.

    Args:
        root: the dataset.
        keypoints_type: folder TYPE of the keypoints; None takes the only one there is.
        features_dir: where keypoints lie outside the dataset, as for ``open_features``.
            If keypoints are found, rows are checked against their number.

    Returns:
        None if the dataset has no points.

    Raises:
        DatasetError: with file and line: ``kapture.index``, ``kapture.duplicate``,
            ``kapture.number``, ``kapture.color``, ``kapture.path``, ``kapture.column_count``;
            ``kapture.keypoints_type`` when the observations are by other or several types.
    """
    table = Table(root, _POINTS, None)
    if not table.exists():
        if Table(root, _OBSERVATIONS, None).exists():
            raise table.error("kapture.unreadable", "the observed points are missing")
        return None
    points, colors = _read_points(table)
    table = Table(root, _OBSERVATIONS, None)
    if not table.exists():
        return Reconstruction(points, colors, None, (), np.empty((0, 3), dtype=np.int64))
    known = feature_types(root, "keypoints", features_dir)

    def open_keypoints(kind: str) -> FeatureSet | None:
        return open_features(root, "keypoints", kind, features_dir) if kind in known else None

    return Reconstruction(
        points, colors, *_read_observations(table, len(points), keypoints_type, open_keypoints)
    )


def write_reconstruction(root: Path, reconstruction: Reconstruction) -> None:
    """Write ``points3d.txt`` and, if anything is observed, ``observations.txt``.

    Reading returns the same numbers, with observations sorted by point. Each file is written
    atomically, the points last: observations without points are ignored.

    Raises:
        Conflict: ``kapture.exists`` if one of the files exists.
        InvalidInput: ``kapture.reconstruction`` for arrays of another shape or type, or rows that
            refer to nothing.
        DatasetError: ``kapture.field`` for a name that kapture cannot hold.
    """
    _check(reconstruction)
    for relative in (_OBSERVATIONS, _POINTS):
        if (root / relative).exists():
            raise refuse(
                "kapture.exists",
                "the dataset already has a reconstruction",
                field=str(root / relative),
                expected="a dataset without points",
            )
    (root / _POINTS).parent.mkdir(parents=True, exist_ok=True)
    if len(reconstruction.observations):
        write_atomically(root / _OBSERVATIONS, _observations_text(reconstruction).encode("utf-8"))
    columns: list[list[float | int]] = reconstruction.points.T.tolist()
    header = "# X, Y, Z"
    if reconstruction.colors is not None:
        columns += reconstruction.colors.T.tolist()
        header += ", R, G, B"
    rows = (", ".join(map(repr, row)) for row in zip(*columns, strict=True))
    text = "\n".join(chain((VERSION_LINE, header), rows)) + "\n"
    write_atomically(root / _POINTS, text.encode("utf-8"))


def _read_points(table: Table) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    values = array("d")
    num_columns = 0
    for fields in table:
        if not num_columns and len(fields) in (3, 6):
            num_columns = len(fields)
        if len(fields) != num_columns:
            raise table.error(
                "kapture.column_count",
                expected=str(num_columns or "X, Y, Z or X, Y, Z, R, G, B"),
                got=len(fields),
            )
        numbers = table.numbers(fields)
        if num_columns == 6 and (min(numbers[3:]) < 0 or max(numbers[3:]) > 255):
            raise table.error("kapture.color", got=fields[3:])
        values.extend(numbers)
    rows = np.frombuffer(values).reshape(-1, num_columns or 3)
    colors = np.rint(rows[:, 3:]).astype(np.uint8) if num_columns == 6 else None
    return rows[:, :3].copy(), colors


class _Tracks:
    """Observations by one type of keypoints, collected line by line."""

    def __init__(self, table: Table, num_points: int, keypoints: FeatureSet | None) -> None:
        self.rows: dict[str, int] = {}  # of images, by path
        self._table, self._num_points, self._keypoints = table, num_points, keypoints
        self._num_keypoints: list[int] = []  # of each image; _MAX_INDEX where it is not known
        self._row_of_name: dict[str, int] = {}  # as written
        self._seen: set[int] = set()
        self._points, self._images, self._indices = array("q"), array("q"), array("q")

    def add(self, fields: list[str]) -> None:
        """Take one line: point, type, then image and keypoint in turn."""
        table = self._table
        (point,) = _indices(table, fields[:1], self._num_points, "point in points3d.txt")
        if point in self._seen:
            raise table.error("kapture.duplicate", got=fields[0])
        self._seen.add(point)
        track = _indices(table, fields[3::2], _MAX_INDEX, "keypoint")
        for name, keypoint in zip(fields[2::2], track, strict=True):
            row = self._row(name)
            if keypoint >= self._num_keypoints[row]:
                raise table.error(
                    "kapture.index",
                    f"{name} has no such keypoint",
                    expected=f"less than {self._num_keypoints[row]}",
                    got=str(keypoint),
                )
            self._images.append(row)
        self._indices.extend(track)
        self._points.extend([point] * len(track))

    def observations(self) -> NDArray[np.int64]:
        """(M, 3) rows of points, of images and of keypoints."""
        columns = (self._points, self._images, self._indices)
        return np.stack([np.frombuffer(column, np.int64) for column in columns], axis=1)

    def _row(self, name: str) -> int:
        row = self._row_of_name.get(name)
        if row is None:
            path = self._table.path(name, "the dataset")
            if path not in self.rows:
                self.rows[path] = len(self.rows)
                keypoints = self._keypoints
                known = keypoints.count(path) if keypoints and keypoints.has(path) else _MAX_INDEX
                self._num_keypoints.append(known)
            row = self._row_of_name[name] = self.rows[path]
        return row


def _read_observations(
    table: Table,
    num_points: int,
    keypoints_type: str | None,
    open_keypoints: Callable[[str], FeatureSet | None],
) -> tuple[str | None, tuple[str, ...], NDArray[np.int64]]:
    wanted, types = keypoints_type, dict[str, None]()
    tracks = _Tracks(table, num_points, None if wanted is None else open_keypoints(wanted))
    for fields in table:
        if len(fields) < 2 or len(fields) % 2:
            raise table.error(
                "kapture.column_count",
                "the line has the wrong number of columns (kapture 1.0 has no type of keypoints)",
                expected="point3d_id, keypoints_type, then image_path and feature_id in turn",
                got=len(fields),
            )
        types[fields[1]] = None
        if wanted is None:
            wanted = fields[1]
            tracks = _Tracks(table, num_points, open_keypoints(wanted))
        if fields[1] == wanted:
            tracks.add(fields)
        elif keypoints_type is None:
            raise table.error(
                "kapture.keypoints_type",
                "keypoints of several types observe the points; name the one to use",
                expected=" or ".join(types),
            )
    if keypoints_type is not None and types and keypoints_type not in types:
        raise refuse(
            "kapture.keypoints_type",
            field=table.relative,
            expected=" or ".join(types),
            got=keypoints_type,
        )
    return wanted, tuple(tracks.rows), tracks.observations()


def _indices(table: Table, texts: list[str], limit: int, what: str) -> list[int]:
    joined = "".join(texts)
    # int() also accepts signs, underscores, digits of other scripts, and texts of any length.
    if all(texts) and joined.isascii() and (joined.isdigit() or not texts):
        indices = [int(text) for text in texts if len(text) <= _MAX_DIGITS]
        if len(indices) == len(texts) and max(indices, default=-1) < limit:
            return indices
    raise table.error(
        "kapture.index",
        f"there is no such {what}",
        expected=f"integers from 0 to {limit - 1}" if limit else "no rows: there are none",
        got=", ".join(texts),
    )


def _check(reconstruction: Reconstruction) -> None:
    r = reconstruction
    limits = (len(r.points), len(r.images), _MAX_INDEX)
    fine = (
        r.points.shape == (len(r.points), 3)
        and r.points.dtype == np.float64
        and bool(np.isfinite(r.points).all())
        and (r.colors is None or (r.colors.shape == r.points.shape and r.colors.dtype == np.uint8))
        and r.observations.shape == (len(r.observations), 3)
        and np.issubdtype(r.observations.dtype, np.integer)
        and bool(((r.observations >= 0) & (r.observations < limits)).all())
        and (not len(r.observations) or r.keypoints_type is not None)
        and len(set(r.images)) == len(r.images)
    )
    if not fine:
        raise refuse(
            "kapture.reconstruction",
            field="reconstruction",
            got=f"points {r.points.shape} {r.points.dtype}, {len(r.images)} images, "
            f"observations {r.observations.shape} {r.observations.dtype}",
        )
    for text in r.images:
        if not is_path_field(text):
            raise _not_a_field(text)
    if r.keypoints_type is not None and not (r.keypoints_type and is_field(r.keypoints_type)):
        raise _not_a_field(r.keypoints_type)


def _not_a_field(text: str) -> VislocError:
    return refuse(
        "kapture.field",
        "kapture cannot store this name",
        field=_OBSERVATIONS,
        expected="a relative path, or a type, without commas or blanks around it",
        got=text,
    )


def _observations_text(reconstruction: Reconstruction) -> str:
    rows = reconstruction.observations
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    points, starts = np.unique(rows[:, 0], return_index=True)
    bounds = [*starts.tolist(), len(rows)]
    images, features = rows[:, 1].tolist(), rows[:, 2].tolist()
    lines = [VERSION_LINE, "# point3d_id, keypoints_type, [image_path, feature_id]*"]
    for row, point in enumerate(points.tolist()):
        seen = range(bounds[row], bounds[row + 1])
        track = ", ".join(f"{reconstruction.images[images[i]]}, {features[i]}" for i in seen)
        lines.append(f"{point}, {reconstruction.keypoints_type}, {track}")
    return "\n".join(lines) + "\n"
