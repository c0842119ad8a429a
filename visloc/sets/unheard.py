"""Tiles that a doubtful answer leaves open: the photo may show them, but they had no say.

That a tile finds no pose speaks against it only if it finds its own photos. A poor tile does not,
and its photos would go to another tile that looks like it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from visloc.archive import SetOutline
from visloc.localization.judge import PlaceAnswer, candidate, measured_pose, most_inliers_first
from visloc.sets.choosing import MAX_SEARCHED, is_doubtful
from visloc.types import Reason, Refusal

# Below, an answer is more likely wrong than right.
_MORE_LIKELY_RIGHT = 0.5


def hard_to_find(
    outline: SetOutline, doubtful: Collection[str], left: NDArray[np.bool_]
) -> tuple[int, ...]:
    """Return tiles that were not searched because the set takes their photos for other tiles'.

    Args:
        outline: the set.
        doubtful: refs of the tiles with doubtful answers.
        left: (T,) tiles that may be searched, and were not.

    Returns:
        Rows of tiles whose photos are mistaken for those of a tile with a doubtful answer, five at
        most.
    """
    if not doubtful:
        return ()
    tiles = outline.tiles
    rows = np.flatnonzero(left).tolist()
    return tuple([row for row in rows if set(tiles[row].mistaken_for) & set(doubtful)])[
        :MAX_SEARCHED
    ]


def left_open(
    outline: SetOutline,
    row: int,
    places: Mapping[int, PlaceAnswer],
    elsewhere: NDArray[np.bool_],
    close: Collection[int],
) -> Refusal | None:
    """Refuse a doubtful answer that leaves another tile open.

    A tile that does not agree stays open when its own photos are mistaken for those of the tile
    that answers, even if it has a pose that explains much less: it is poor. But where the tile that
    answers misses photos of its own, doubtful answers to these are usual, and no sign of another
    place: there a tile stays open only if the answer is more likely wrong than right. Then, so does
    one that looks about as much like the photo. Tiles of the same place, whose photos lie among
    each other, are no contradiction.

    Args:
        outline: the set.
        row: of the tile whose answer was chosen.
        places: the answers of the tiles that were searched, by row.
        elsewhere: (T,) tiles that the priors allow and that gave no pose at the same place.
        close: rows of the tiles with at least half of the best coarse score.

    Returns:
        A refusal, ``ambiguous``, with the poses that there are as its candidates; None for an
        answer that stands.
    """
    place, tiles = places[row], outline.tiles
    pose = measured_pose(place.answer)
    if pose is None or pose.probability is None or not is_doubtful(place.answer):
        return None
    more_likely_wrong = pose.probability < _MORE_LIKELY_RIGHT
    telling = more_likely_wrong or not tiles[row].misses_own_photos
    for other in np.flatnonzero(elsewhere & apart(outline.photo_boxes, row)).tolist():
        if telling and tiles[row].ref in tiles[other].mistaken_for:
            why = f"whose own photos look like those of {place.ref}"
        elif more_likely_wrong and other in close:
            why = "which looks about as much like it"
        else:
            continue
        return Refusal(
            "gate",
            Reason.AMBIGUOUS,
            f"{place.ref} explains the query with {place.answer.num_inliers} inliers, but with a "
            f"probability of only {pose.probability:.2f}; it may also show {tiles[other].ref}, "
            f"{why}. Send priors that exclude one of them, or map the latter with more photos",
            most_inliers_first(
                [
                    candidate(each)
                    for each in (place, places.get(other))
                    if each and measured_pose(each.answer)
                ]
            ),
        )
    return None


def apart(boxes: NDArray[np.float64], row: int) -> NDArray[np.bool_]:
    """Tell which tiles (T,) have no photos among those of one.

    Args:
        boxes: (T, 2, 3) least and largest coordinates of each tile's photos.
        row: of the tile.
    """
    low, high = boxes[:, 0], boxes[:, 1]
    return np.asarray(((low > high[row]) | (high < low[row])).any(axis=1))
