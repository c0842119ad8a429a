"""Refuses doubtful answers when the photo may show a tile that is too poor to answer.

If a tile finds no pose, that is evidence against it only if the tile finds its own photos. A tile
with few photos or landmarks does not: its photos would be placed in a tile that looks like it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from visloc.archive import SetOutline
from visloc.localization.acceptance.judge import (
    PlaceAnswer,
    candidate,
    measured_pose,
    most_inliers_first,
)
from visloc.types import Reason, Refusal
from visloc_extensions.sets.choosing import MAX_SEARCHED, is_doubtful

# Below this probability, an answer is more likely wrong than right.
_MORE_LIKELY_RIGHT = 0.5


def hard_to_find(
    outline: SetOutline, doubtful: Collection[str], left: NDArray[np.bool_]
) -> tuple[int, ...]:
    """Return tiles that must be searched because a doubtful answer may be theirs.

    Args:
        left: (T,) tiles that may be searched, and were not.

    Returns:
        Rows of at most five tiles whose photos are mistaken for those of a tile with a doubtful
        answer.
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

    Another tile that gave no pose at the same place is open in these cases:

    - Its own photos are mistaken for those of the answering tile, and the answering tile finds its
      own photos. It is open even if it has a pose that explains much less, because it is poor. A
      tile that misses photos of its own gives doubtful answers to them as well, so there a doubtful
      answer is no sign of another place.
    - Its own photos are mistaken for those of the answering tile, or it looks about as much like
      the query, and the answer is more likely wrong than right.

    Tiles whose photos lie among each other show the same place, and are never open.

    Args:
        places: the answers of the tiles that were searched, by row.
        elsewhere: (T,) tiles that the priors allow and that gave no pose at the same place.
        close: rows of the tiles with at least half of the best coarse score.

    Returns:
        A refusal, ``ambiguous``, with the poses of both tiles as candidates, as far as they have
        one; None for an answer that stands.
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
    """Tell which tiles (T,) have photos in a box that does not overlap that of one tile.

    Args:
        boxes: (T, 2, 3) least and largest coordinates of each tile's photos.
    """
    low, high = boxes[:, 0], boxes[:, 1]
    return np.asarray(((low > high[row]) | (high < low[row])).any(axis=1))
