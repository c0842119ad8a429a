"""A COLMAP database of an exported model, and of query photos that are matched with it.

Written by SQLite in the schema of COLMAP 3.8 (``src/base/database.cc``), which later versions
migrate when they open it; pycolmap writes a newer one, which 3.8 does not read. So COLMAP's
``image_registrator`` and other tools go on where the map ends.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose, cross_matrix
from visloc.pose.reprojection import colmap_camera

_VERSION = 3800
_SCHEMA = """
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, model INTEGER NOT NULL,
  width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB,
  prior_focal_length INTEGER NOT NULL);
CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
  name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL,
  prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL,
  prior_tx REAL, prior_ty REAL, prior_tz REAL,
  CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < 2147483647),
  FOREIGN KEY(camera_id) REFERENCES cameras(camera_id));
CREATE UNIQUE INDEX index_name ON images(name);
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
  cols INTEGER NOT NULL, data BLOB,
  FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
  cols INTEGER NOT NULL, data BLOB,
  FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
  cols INTEGER NOT NULL, data BLOB);
CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
  cols INTEGER NOT NULL, data BLOB, config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB,
  tvec BLOB);
"""
_MOST_IMAGES = 2147483647  # the base of COLMAP's pair ids
_CALIBRATED, _UNCALIBRATED = 2, 3
# COLMAP's factor from unit rows of SIFT to bytes.
_SIFT_SCALE, _SIFT_DIM = 512.0, 128


@dataclass(frozen=True, slots=True, eq=False)
class DatabasePhoto:
    """A photo of a database.

    Attributes:
        keypoints: (k, 2) pixels, the centre of the top-left one at (0.5, 0.5).
        descriptors: (k, 128) float32 unit rows of SIFT; None for others, which COLMAP 3.8 has no
            place for.
        cam_from_world: None for a query.
    """

    name: str
    sensor: str
    camera: Camera
    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32] | None
    cam_from_world: Pose | None


def write_colmap_database(
    path: Path,
    photos: Sequence[DatabasePhoto],
    first_cameras: Mapping[str, Camera],
    matches: dict[tuple[int, int], NDArray[np.uint32]],
) -> None:
    """Write a database whose ids count photos and sensors from 1, in their order.

    Args:
        path: a file that does not exist.
        first_cameras: the sensors that are counted before those of other photos.
        matches: (k, 2) rows of keypoints by rows of two photos, the lower one first; all count as
            verified.
    """
    with closing(sqlite3.connect(path)) as database, database:
        database.executescript(_SCHEMA)
        database.execute(f"PRAGMA user_version = {_VERSION}")
        cameras = {**first_cameras, **{photo.sensor: photo.camera for photo in photos}}
        ids = {sensor: number for number, sensor in enumerate(cameras, 1)}
        for sensor, camera in cameras.items():
            row = (ids[sensor], *_camera(camera), 1)
            database.execute("INSERT INTO cameras VALUES (?, ?, ?, ?, ?, ?)", row)
        for number, photo in enumerate(photos, 1):
            row = (number, photo.name, ids[photo.sensor], *[None] * 7)
            database.execute(f"INSERT INTO images VALUES ({', '.join('?' * 10)})", row)
            _insert_rows(database, "keypoints", number, photo.keypoints.astype("<f4"))
            if photo.descriptors is not None:
                _insert_rows(database, "descriptors", number, _sift_bytes(photo.descriptors))
        for (first, second), rows in matches.items():
            pair_id = _MOST_IMAGES * (first + 1) + second + 1
            _insert_rows(database, "matches", pair_id, rows.astype("<u4"))
            geometry = _two_view_geometry(photos[first], photos[second])
            values = (pair_id, len(rows), 2, rows.astype("<u4").tobytes(), *geometry)
            marks = ", ".join("?" * len(values))
            database.execute(f"INSERT INTO two_view_geometries VALUES ({marks})", values)


def matches_of_tracks(
    observations: NDArray[np.int64],
) -> dict[tuple[int, int], NDArray[np.uint32]]:
    """Return the matches of photos that see the same points.

    Args:
        observations: (M, 3) rows: point, photo, keypoint of that photo.

    Returns:
        (k, 2) rows of keypoints, by rows of two photos, the lower one first.
    """
    ordered = observations[np.lexsort(observations.T[::-1])]
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for track in np.split(ordered, np.flatnonzero(np.diff(ordered[:, 0])) + 1):
        for (_, a, i), (_, b, j) in combinations(track.tolist(), 2):
            if a != b:
                pairs.setdefault((a, b), []).append((i, j))
    return {pair: np.array(rows, np.uint32) for pair, rows in sorted(pairs.items())}


def _camera(camera: Camera) -> Iterator[object]:
    made: pycolmap.Camera = colmap_camera(camera)
    yield from (int(made.model), made.width, made.height)
    yield np.asarray(made.params, "<f8").tobytes()


def _insert_rows(
    database: sqlite3.Connection, table: str, key: int, rows: NDArray[np.generic]
) -> None:
    values = (key, *rows.shape, np.ascontiguousarray(rows).tobytes())
    database.execute(f"INSERT INTO {table} VALUES (?, ?, ?, ?)", values)


def _sift_bytes(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.clip(np.round(_SIFT_SCALE * descriptors), 0, 255).astype(np.uint8)


def _two_view_geometry(first: DatabasePhoto, second: DatabasePhoto) -> tuple[object, ...]:
    """Return config, F, E, H, qvec, tvec; zeros where they are not known."""
    config, essential = _UNCALIBRATED, np.zeros((3, 3))
    qvec, tvec = np.array([1.0, 0, 0, 0]), np.zeros(3)
    if first.cam_from_world is not None and second.cam_from_world is not None:
        relative = second.cam_from_world @ first.cam_from_world.inverse()
        config, essential = _CALIBRATED, cross_matrix(relative.translation) @ relative.rotation
        qvec, tvec = relative.rotation_wxyz, relative.translation
    none = np.zeros((3, 3)).tobytes()
    essential_bytes = np.ascontiguousarray(essential, "<f8").tobytes()
    return (config, none, essential_bytes, none, qvec.tobytes(), tvec.tobytes())
