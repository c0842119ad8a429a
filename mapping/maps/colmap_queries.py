"""Query photos matched with a map, for COLMAP's image_registrator."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapping.maps.colmap_database import DatabasePhoto
from visloc.archive import Map
from visloc.kapture import Dataset, FileRecord
from visloc.localization.localizer import Localizer
from visloc.localization.solving import Look
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file

# By pairs of rows, the lower one first.
PairMatches = dict[tuple[int, int], NDArray[np.uint32]]


def match_queries(
    opened: Map, localizer: Localizer, queries: Dataset
) -> tuple[list[DatabasePhoto], PairMatches, tuple[str, ...]]:
    """Match the photos of a dataset with those that the map retrieves for them.

    A query's keypoints are those that matched a landmark. A match with a landmark is one with each
    retrieved photo that sees it.

    Args:
        queries: their poses are not used; of ``usable_queries``, the others are left out.

    Returns:
        The photos; their matches, where the rows of the map's photos come before those of the
        queries; and notes.
    """
    photos: list[DatabasePhoto] = []
    matches: PairMatches = {}
    names = {image.name: row for row, image in enumerate(opened.images)}
    usable = usable_queries(opened, queries)
    for record in usable:
        photo = read_photo_file(queries.path_of(record))
        camera = queries.sensors[record.sensor_id].camera
        look = localizer.look(photo, camera, LocalizeOptions())
        row = len(names) + len(photos)
        retrieved = [names[image.name] for image in look.evidence.retrieved]
        matches |= {(image, row): rows for image, rows in _with_photos(opened, look, retrieved)}
        keypoints = (look.matches.pixels * look.reduced).astype(np.float32)
        # A name of its own: the camera of a query need not be the map's of that name.
        sensor = f"query {record.sensor_id}"
        photos.append(
            DatabasePhoto(record.path, sensor, look.evidence.camera, keypoints, None, None)
        )
    left_out = len(queries.images) - len(usable)
    why = "that have no file, or the name of a mapping photo"
    return photos, matches, (f"{left_out} queries left out {why}",) if left_out else ()


def usable_queries(opened: Map, queries: Dataset) -> list[FileRecord]:
    """Return the photos that can be added: with a file, and without the name of a mapping photo."""
    names = {image.name for image in opened.images}
    return [
        record for record in queries.images if record.path not in names and queries.has_file(record)
    ]


def _with_photos(
    opened: Map, look: Look, retrieved: Sequence[int]
) -> list[tuple[int, NDArray[np.uint32]]]:
    """Return, for each retrieved photo, rows of its keypoints and of the query's."""
    found = []
    for image in retrieved:
        seen, _ = opened.observations(image)
        order = np.argsort(seen, kind="stable")
        place = np.minimum(np.searchsorted(seen[order], look.landmarks), max(len(seen) - 1, 0))
        if len(seen) == 0 or len(look.landmarks) == 0:
            continue
        rows = order[place]
        hit = seen[rows] == look.landmarks
        if hit.any():
            pairs = np.column_stack([rows[hit], np.flatnonzero(hit)])
            found.append((image, pairs.astype(np.uint32)))
    return found
