"""Tell whether the poses of a finished model agree with the matches that they were made of.

The verified matches of a pair fit one geometry of its two photos. In a sound model, that is the
geometry of their poses, and nearly all matches fit it. If something moves through the pictures, it
may have more matches than the place in some pairs. The geometry of these pairs is then that of the
moving thing, and no poses fit all pairs. The mapper leaves out the matches that do not fit, so the
landmarks look consistent. That is why the pairs are compared, not the landmarks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from mapping.methods.matching.stages import Matches, fits_poses
from mapping.methods.sparse.model import SfmPhoto, SparseModel
from visloc.archive.schema import Doubt

# Poses contradict a pair when less than this part of its matches fits them.
_LEAST_FITTING = 0.4
# A match fits within this share of the longer side, or within the pixels that it was verified by,
# whichever is more: slightly wrong poses do not contradict it.
_ABOUT = 0.01
# A model is in doubt when at least so many pairs, and more than this share, contradict its poses.
# Measured: docs/decisions/0040-moving-things.md.
_LEAST_PAIRS, _MOST_CONTRADICTED = 4, 0.03
_MAX_NAMES = 100


def contradicted_pairs(
    model: SparseModel,
    photos: Sequence[SfmPhoto],
    pairs: Sequence[Matches],
    max_error_px: float,
) -> tuple[list[Matches], int]:
    """Return the pairs whose matches contradict the poses of a model, and how many were compared.

    Args:
        model: of all photos; pairs with photos that have no place in it are passed over.
    """
    found, compared = [], 0
    for pair in pairs:
        a, b = model.views[pair.first], model.views[pair.second]
        if a is None or b is None:
            continue
        compared += 1
        longest = max(a.camera.width, a.camera.height, b.camera.width, b.camera.height)
        fits = fits_poses(
            (a, b),
            photos[pair.first].keypoints[pair.rows[:, 0]],
            photos[pair.second].keypoints[pair.rows[:, 1]],
            max(max_error_px, _ABOUT * longest),
        )
        if fits.mean() < _LEAST_FITTING:
            found.append(pair)
    return found, compared


def doubts_about_poses(
    model: SparseModel,
    photos: Sequence[SfmPhoto],
    pairs: Sequence[Matches],
    max_error_px: float,
) -> tuple[Doubt, ...]:
    """Return a doubt about a model whose poses contradict many of its pairs.

    Arguments are those of ``contradicted_pairs``.
    """
    found, compared = contradicted_pairs(model, photos, pairs, max_error_px)
    if len(found) < _LEAST_PAIRS or len(found) <= _MOST_CONTRADICTED * compared:
        return ()
    message = (
        f"{len(found)} of {compared} pairs of photos that match contradict the poses of the map: "
        "something large that moves, such as people, vehicles or a screen, may have bent it, or "
        "photos of several lenses or zooms that share a camera; film again without it, or give "
        "masks of it"
    )
    involved = Counter(row for pair in found for row in (pair.first, pair.second))
    names = [photos[row].name for row, _ in involved.most_common(_MAX_NAMES)]
    return (Doubt(kind="matches", message=message, photos=tuple(names)),)
