"""Whether a new version of a map may be used without a person saying so."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mapping.methods.sparse.contradictions import ModelPhoto, find_places
from mapping.own_test.trials import OwnTestRun
from mapping.stages.landmarks import View
from visloc.archive import Map
from visloc.archive.schema import Doubt, OwnTest
from visloc.localization.map_view.constraints import MapGeometry

# Shares that no map at hand that localizes well comes near: of 17, those with exact poses have all
# photos back, and the weakest of look-alike hallways one wrong photo of 12. The painted sample with
# every tenth pose exchanged has more (docs/decisions/0032-the-own-test-decides.md).
MOST_WRONG = 0.15
LEAST_BACK = 0.4
# Fewer photos tell too little.
LEAST_TESTED = 8
# Photos that find no place when poses are estimated, or lie in another piece than the most.
MOST_LEFT_OUT = 0.4
MOST_APART = 0.1
# Fewer photos that contradict a larger group may have rough poses.
LEAST_DOUBTED = 4
# A pose needs at least as many landmarks by default (``RegistrationPreset.min_inliers``).
LINKING_LANDMARKS = 30
MAX_NAMES = 100


def doubts_about(opened: Map, run: OwnTestRun, left_out: Sequence[str] = ()) -> tuple[Doubt, ...]:
    """Return what speaks against using a map: nothing for one that passed.

    Args:
        run: its own test.
        left_out: names of photos that found no place while poses were estimated.
    """
    return tuple(
        doubt
        for doubt in (
            _not_back(opened, run),
            _without_place(opened, left_out),
            _apart(opened),
            _two_places(opened),
        )
        if doubt is not None
    )


def misses_own_photos(test: OwnTest | None) -> bool:
    """Tell whether more than a few of a map's own photos did not come back where they were.

    Then right answers of the map are often doubtful: it is sparse. Too few photos tell nothing.
    """
    if test is None or test.tested < LEAST_TESTED:
        return False
    return test.tested - (test.localized - test.wrong) > MOST_WRONG * test.tested


def _not_back(opened: Map, run: OwnTestRun) -> Doubt | None:
    test = run.test
    if test.tested < LEAST_TESTED:
        return None
    right = test.localized - test.wrong
    # Where poses were given, photos that find no place tell that the map is sparse, not wrong.
    is_broken = has_estimated_poses(opened) and right < LEAST_BACK * test.tested
    if test.wrong <= MOST_WRONG * test.tested and not is_broken:
        return None
    names = [opened.images[row].name for row in (*run.wrong, *run.refused)]
    message = (
        f"of {test.tested} photos that were localized in the map without themselves, {right} came "
        f"back where they were, {test.wrong} elsewhere, and {test.tested - test.localized} found "
        "no place"
    )
    return Doubt(kind="own_test", message=message, photos=tuple(names[:MAX_NAMES]))


def _without_place(opened: Map, left_out: Sequence[str]) -> Doubt | None:
    total = len(opened.images) + len(left_out)
    if len(left_out) <= MOST_LEFT_OUT * total:
        return None
    message = f"{len(left_out)} of {total} photos found no place beside those of this map"
    return Doubt(kind="left_out", message=message, photos=tuple(left_out[:MAX_NAMES]))


def _apart(opened: Map) -> Doubt | None:
    """Doubt a map whose photos, placed by its landmarks alone, hang together by too few of them."""
    if not has_estimated_poses(opened):
        return None  # pieces that do not see each other may have known poses
    pieces = _pieces(opened)
    sizes = np.bincount(pieces)
    outside = np.flatnonzero(pieces != np.argmax(sizes))
    if len(outside) <= MOST_APART * len(pieces):
        return None
    names = [opened.images[row].name for row in outside[:MAX_NAMES]]
    message = (
        f"the photos fell apart into {len(sizes)} pieces that share fewer than "
        f"{LINKING_LANDMARKS} landmarks; {len(outside)} of {len(pieces)} photos lie outside the "
        "largest"
    )
    return Doubt(kind="pieces", message=message, photos=tuple(names))


def _two_places(opened: Map) -> Doubt | None:
    """Doubt a map in which photos of two places seem to have been taken beside each other."""
    if not has_estimated_poses(opened):
        # A map keeps only keypoints that were matched: where few pairs were, others seem missing.
        return None
    rows = find_places(_model_photos(opened), opened.landmarks.astype(np.float64)).doubted()
    if len(rows) < LEAST_DOUBTED or len(rows) <= MOST_APART * len(opened.images):
        return None
    message = (
        f"the map seems to show two places that look alike as one: {len(rows)} of "
        f"{len(opened.images)} photos miss what others beside them see, and see what these miss"
    )
    names = [opened.images[row].name for row in rows[:MAX_NAMES]]
    return Doubt(kind="places", message=message, photos=tuple(names))


def _model_photos(opened: Map) -> list[ModelPhoto]:
    """Return the photos, relative to the map's origin, with the keypoints that the map keeps."""
    viewpoints = MapGeometry(opened).viewpoints
    photos = []
    for row, image in enumerate(opened.images):
        landmarks, descriptors = opened.observations(row)
        photos.append(
            ModelPhoto(
                View(opened.cameras[image.camera], viewpoints.pose(row)),
                opened.keypoints(row),
                descriptors,
                landmarks.astype(np.int64),
                np.arange(len(landmarks)),
            )
        )
    return photos


def has_estimated_poses(opened: Map) -> bool:
    """Tell whether the photos placed each other, so that a pose may be wrong with its landmarks."""
    return opened.manifest.method.settings.get("poses") == "estimate"


def _pieces(opened: Map) -> NDArray[np.int64]:
    """Return the number of the piece (n,) that each photo belongs to."""
    num = len(opened.images)
    photos = np.repeat(np.arange(num), np.diff(opened.observation_offsets))
    landmarks = opened.observation_landmarks.astype(np.int64)
    ones = np.ones(len(photos), np.int32)
    seen = coo_array((ones, (photos, landmarks)), (num, len(opened.landmarks))).tocsr()
    seen.data[:] = 1  # a photo may see a landmark twice
    shared = seen @ seen.T
    shared.data = (shared.data >= LINKING_LANDMARKS).astype(np.int32)
    shared.eliminate_zeros()
    return np.asarray(connected_components(shared, directed=False)[1])
