"""Find doubts about a capture's map: photos that do not come back, paths that jump, a lost size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.own_test.held_out import come_back, doubts_of_length, spread_photos
from mapping.own_test.verdict import LINKING_LANDMARKS, MAX_NAMES, MOST_APART
from mapping.progress import ItemProgress
from visloc.archive import Map, MapStore
from visloc.archive.schema import Doubt
from visloc.errors import MapCorrupt, NotFound
from visloc.geometry import Pose
from visloc.pose.reprojection import project
from visloc_extensions.capture.frames import FilmedVideo

LOST_SIZE = "size"
"""The kind of a doubt about a map of unknown size that would replace one in metres."""
_MOST_TRIED = 60
# The path of a film jumps where its poses say that the picture moved by more than so many times
# what was seen, and by so much of its longer side more. Seen is a median over tracked corners.
_TIMES_SEEN, _MORE_THAN_SEEN = 3.0, 0.1
# Frames whose pictures moved further from one another tell nothing: they may not overlap.
_FAR = 0.4
_MOST_POINTS = 300


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """Photos of the map, each localized without itself and its nearest neighbours.

    Attributes:
        images: (t,) rows of the map's photos, in their order.
        right: (t,) whether it came back where it was.
    """

    images: NDArray[np.int64]
    right: NDArray[np.bool_]


def try_photos(opened: Map, progress: ItemProgress) -> Trials:
    """Ask the map for some of its photos, as if they and those beside them had not been taken."""
    images = spread_photos(len(opened.images), _MOST_TRIED)
    right = come_back(opened, images, progress)
    return Trials(np.array(images, np.int64), np.array(right, np.bool_))


def doubts_of_capture(
    opened: Map, films: Mapping[str, FilmedVideo], measured: Sequence[str]
) -> tuple[Doubt, ...]:
    """Return what speaks against the map of a capture, beside what its own test finds.

    Args:
        films: the videos that it was made of, by name.
        measured: names of the photos of the known length that gives the map its size, if any.
    """
    found = []
    astray = out_of_order(opened, films)
    filmed = [image.name for image in opened.images if image.name.partition("/")[0] in films]
    if len(astray) > MOST_APART * len(filmed):
        message = (
            f"the path of a film jumps where its pictures do not: {len(astray)} of {len(filmed)} "
            "frames lie away from the rest"
        )
        found.append(Doubt(kind="order", message=message, photos=tuple(astray[:MAX_NAMES])))
    return (*found, *doubts_of_length(opened, measured, astray))


def lost_size(opened: Map, store: MapStore) -> tuple[Doubt, ...]:
    """Return a doubt about a map of unknown size if the version in use is in metres.

    Whoever uses that version may count on metres.
    """
    if opened.manifest.world.metric:
        return ()
    try:
        in_use = store.outline(opened.manifest.id)
    except (NotFound, MapCorrupt):
        return ()  # it would replace nothing that anybody can use
    if not in_use.manifest.world.metric:
        return ()
    message = (
        "the version in use is in metres, and the size of this one is not known: give --scale or "
        "--marker-size again"
    )
    return (Doubt(kind=LOST_SIZE, message=message),)


def out_of_order(opened: Map, films: Mapping[str, FilmedVideo]) -> list[str]:
    """Return the names of frames that lie away from most frames of their film.

    The poses of two frames say how far the landmarks of the first move in the picture from one to
    the other. Where that is much more than the picture moved, and the frames share few landmarks,
    the path jumps.
    """
    rows = {image.name: row for row, image in enumerate(opened.images)}
    astray = []
    for source, film in films.items():
        seen = zip(film.names, film.motion.path[film.chosen.rows].tolist(), strict=True)
        placed = [(rows[f"{source}/{n}"], at) for n, at in seen if f"{source}/{n}" in rows]
        pieces = _pieces(opened, placed)
        most = max(pieces, key=len, default=[])
        astray += [opened.images[row].name for row, _ in placed if row not in most]
    return astray


def _pieces(opened: Map, frames: Sequence[tuple[int, float]]) -> list[list[int]]:
    """Cut frames (row, path) where the path jumps; a piece goes on where it fits again.

    A frame that shares landmarks with the last one of a piece belongs to it, whatever the poses of
    another piece allow. Else one frame that seems to lie away, as a fast turn escaped the corners'
    tracking, would take along all frames after it.
    """
    pieces: list[list[tuple[int, float]]] = []
    for row, path in frames:
        # That of the frame before is tried first.
        pieces.sort(key=lambda piece: -piece[-1][1])
        shared = [piece for piece in pieces if _share_landmarks(opened, piece[-1][0], row)]
        fitting = shared or [
            piece
            for piece in pieces
            if path - piece[-1][1] <= _FAR
            and not _jumps(opened, piece[-1][0], row, path - piece[-1][1])
        ]
        if not fitting and pieces and path - pieces[0][-1][1] > _FAR:
            fitting = pieces  # nothing was seen between them that contradicts
        if not fitting:
            pieces.append([])
            fitting = pieces[-1:]
        fitting[0].append((row, path))
    return [[row for row, _ in piece] for piece in pieces]


def _share_landmarks(opened: Map, first: int, second: int) -> bool:
    seen = np.intersect1d(_landmarks_of(opened, first), _landmarks_of(opened, second))
    return len(seen) >= LINKING_LANDMARKS


def _landmarks_of(opened: Map, row: int) -> NDArray[np.int64]:
    start, end = opened.observation_offsets[row : row + 2]
    return np.asarray(opened.observation_landmarks[start:end]).astype(np.int64)


def _jumps(opened: Map, first: int, second: int, seen: float) -> bool:
    """Whether two poses move the picture by much more than was seen, in its longer sides."""
    landmarks = _landmarks_of(opened, first)
    landmarks = landmarks[:: max(1, len(landmarks) // _MOST_POINTS)]
    points = opened.landmarks[landmarks].astype(np.float64) + opened.manifest.world.origin
    pixels = []
    for row in (first, second):
        pose = Pose.from_quaternion(opened.image_poses[row][:4], opened.image_poses[row][4:])
        camera = opened.cameras[opened.images[row].camera]
        pixels.append(project(camera, pose.apply(points)) / max(camera.width, camera.height))
    moved = np.linalg.norm(pixels[1] - pixels[0], axis=1)
    moved[~np.isfinite(moved)] = np.inf  # behind the camera
    return bool(np.median(moved) > _TIMES_SEEN * seen + _MORE_THAN_SEEN)
