"""Photos whose matches contradict their place in a model.

The mapper begins with two photos far apart, which may share few matches, and places others by what
these made. Where that was wrong, photos at the edge of the model lie decimetres off in a room, and
no adjustment brings them back: their true matches were dropped as outliers. These matches tell
which photos it happened to, and the rest of the model where they belong.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapping.methods.matching import Matches, fits_poses
from mapping.methods.sparse_model import SfmPhoto
from mapping.stages.landmarks import View

# Least share of a photo's verified matches that fit the poses. Of photos in their place, 0.92 or
# more do.
_LEAST_FITTING = 0.9
# With more of the photos in doubt, what is left is not known to be right.
_MOST_IN_DOUBT = 0.5


def misplaced(
    photos: Sequence[SfmPhoto],
    views: Sequence[View | None],
    matches: Sequence[Matches],
    max_error_px: float,
) -> tuple[list[int], float]:
    """Tell which photos of a model have matches that do not fit its poses.

    Args:
        views: of each photo; None for those without a place.
        matches: verified by the two-view geometry of each pair.
        max_error_px: largest distance of a match to its epipolar line.

    Returns:
        Rows of the photos, none if too many are in doubt; and the share of all matches that fit.
        Photos that share many matches with a misplaced one are among them: they were placed by it,
        or it by them.
    """
    fitting, total = np.zeros(len(photos)), np.zeros(len(photos))
    for pair in matches:
        first, second = views[pair.first], views[pair.second]
        if first is None or second is None:
            continue
        a, b = pair.rows.T
        fits = fits_poses(
            (first, second),
            photos[pair.first].keypoints[a],
            photos[pair.second].keypoints[b],
            max_error_px,
        )
        for row in (pair.first, pair.second):
            fitting[row] += fits.sum()
            total[row] += len(fits)
    rows = np.flatnonzero(fitting < _LEAST_FITTING * total).tolist()
    share = float(fitting.sum() / max(total.sum(), 1))
    placed = sum(view is not None for view in views)
    return (rows if len(rows) <= _MOST_IN_DOUBT * placed else []), share
