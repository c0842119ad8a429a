"""Places of one map that look like each other: a photo of one would be found at the other.

A photo is asked of the map as if its own place were not in it. What is then found passes the gates
of a query, and can only be a place that looks alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.cluster.workers import Workers
from mapping.frames.stored_queries import solve_stored
from mapping.own_test.held_out import HeldOut, match_held_out
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc import __version__
from visloc.archive import Map
from visloc.localization.map_view.constraints import MapGeometry, Viewpoints
from visloc.options import LocalizeOptions
from visloc_extensions.report.held_out import ask_photos, opened_once

_REVISION = 2
_MOST = 12
# Every second held-out photo is asked, in maps of few photos every one. This adds 3 to 17 % to the
# time of a report.
_EVERY, _FEW_PHOTOS = 2, 24
# Viewpoints that are further apart than this, in radians as ``Viewpoints.apart_from`` counts, are
# at other places unless they share a landmark.
_OTHER_PLACE = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class LookAlike:
    """A photo, and where the map would find it if its own place were not mapped.

    Attributes:
        image: row of the map's photos.
        twin: row of the photo nearest to where it was found.
        position: (3,) float64 where it was found, relative to the map's origin.
        own_inliers: matches that are right with the photo's own pose, in the map without the photo.
    """

    image: int
    twin: int
    position: NDArray[np.float64]
    inliers: int
    own_inliers: int

    def told(self, opened: Map) -> str:
        """Return it in words."""
        image, twin = opened.images[self.image].name, opened.images[self.twin].name
        return (
            f"photos around {image} look like those around {twin}: {image} has {self.inliers} "
            f"inliers there, and {self.own_inliers} at its own place"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """The result of asking a map for places that look alike.

    Attributes:
        asked: the number of photos that were asked. A photo that shares its place with all others
            cannot be.
    """

    found: tuple[LookAlike, ...]
    asked: int


def shares_place(opened: Map, viewpoints: Viewpoints, image: int) -> NDArray[np.bool_]:
    """Which photos (n,) are of the same place as one, itself among them.

    They share a landmark with it, or stand near and look the same way.
    """
    seen = np.zeros(len(opened.landmarks), dtype=np.bool_)
    seen[opened.observations(image)[0]] = True
    shares = [bool(seen[opened.observations(i)[0]].any()) for i in range(len(opened.images))]
    return np.array(shares) | (viewpoints.apart_from(viewpoints.pose(image)) < _OTHER_PLACE)


def find_look_alikes(
    opened: Map,
    viewpoints: Viewpoints,
    runs: Sequence[HeldOut],
    work: WorkFolder,
    workers: Workers,
    progress: Callable[[int, int], None],
) -> Search:
    """Find places that look alike; each pair of places once, at most a dozen.

    Args:
        runs: of held-out photos; some of these photos are asked.
        progress: told how many photos are done, and of how many.

    Returns:
        Those with the most inliers at the wrong place first.
    """
    own = {run.image: len(run.correct) for run in reversed(runs)}  # the run with fewest left out
    images = sorted(own)
    images = images[:: 1 if len(images) <= _FEW_PHOTOS else _EVERY]
    items = ask_photos(
        work, workers, images, partial(_key, opened), partial(_keep, opened.path, work), progress
    )
    found = [
        LookAlike(image, int(twin), position.astype(np.float64), int(inliers), own[image])
        for image, item in zip(images, items, strict=True)
        for twin, position, inliers in zip(
            item["twin"], item["position"], item["inliers"], strict=True
        )
    ]
    found.sort(key=lambda one: -one.inliers)
    asked = sum(bool(item["asked"].all()) for item in items)
    return Search(tuple(_pairs_of_places(opened, viewpoints, found)), asked)


def _pairs_of_places(
    opened: Map, viewpoints: Viewpoints, found: Sequence[LookAlike]
) -> list[LookAlike]:
    """The first of each pair of places, whichever of the two was asked."""
    pairs: list[LookAlike] = []
    told: list[tuple[NDArray[np.bool_], NDArray[np.bool_]]] = []
    for one in found:
        if len(pairs) == _MOST:
            break
        a, b = one.image, one.twin
        if any((x[a] and y[b]) or (x[b] and y[a]) for x, y in told):
            continue
        pairs.append(one)
        told.append((shares_place(opened, viewpoints, a), shares_place(opened, viewpoints, b)))
    return pairs


def _key(opened: Map, image: int) -> str:
    return key_of(
        "look-alike",
        _REVISION,
        program=__version__,
        options=repr(LocalizeOptions()),
        map=opened.manifest.content_hash,
        image=image,
        other_place=_OTHER_PLACE,
    )


def _keep(folder: Path, work: WorkFolder, image: int) -> None:
    opened, viewpoints = opened_once(folder)
    work.get(_key(opened, image), lambda: _ask(opened, viewpoints, image))


def _ask(opened: Map, viewpoints: Viewpoints, image: int) -> Item:
    """Look for one photo where it was not taken; arrays of one row if it is found, else of none.

    A photo that shares its place with all others is not asked.
    """
    own_place, options = shares_place(opened, viewpoints, image), LocalizeOptions()
    twin, position, inliers = np.empty(0, np.int64), np.empty((0, 3)), np.empty(0, np.int64)
    if not own_place.all():
        geometry = MapGeometry(opened)
        matched = match_held_out(geometry, image, np.flatnonzero(own_place), options)
        solved = solve_stored(opened, image, geometry, matched, options)
        if solved.pose is not None:
            pose = solved.pose.rig_from_world
            apart = viewpoints.apart_from(pose)
            # Nearer, it is its own place still, which photos show that share no landmark with it.
            if apart[image] >= _OTHER_PLACE:
                twin = np.array([np.where(own_place, np.inf, apart).argmin()])
                position, inliers = pose.center[None], np.array([solved.pose.num_inliers])
    asked = np.array([not own_place.all()])
    return {"asked": asked, "twin": twin, "position": position, "inliers": inliers}
