"""Chooses the tiles of a set that are searched, and their order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.values import Query
from visloc.archive import SetOutline
from visloc.archive.places import located
from visloc.errors import refuse
from visloc.localization.acceptance.judge import measured_pose
from visloc.pose.motion import largest_std
from visloc.priors import HEIGHT_REACH, POSE_PRIOR_STDS, REACH, Priors
from visloc.types import InstantAnswer
from visloc_extensions.sets.frame import down_in_set

# Maximum number of tiles searched for one query.
MAX_SEARCHED = 5
# Tiles with at least this share of the best score are searched together with the best: look-alike
# floors score 0.55 to 1 of each other, places that are not alike below 0.3.
_CLOSE_SCORE = 0.5
# An answer with at least so many inliers and so high a probability ends the search.
CLEAR_INLIERS, CLEAR_PROBABILITY = 100, 0.9
_NAMED = 5


@dataclass(frozen=True, slots=True)
class TileScore:
    """A tile's row in the set and its similarity to a query.

    The score is the estimated cosine similarity of its best photos, comparable within one query.
    """

    tile: int
    score: float


class RankedTiles(NamedTuple):
    """The tiles of a set ranked by a photo.

    Attributes:
        query: packed where it could be decoded, else as it came.
        scores: of the most similar tiles, best first; empty when none were to be ranked, or the
            photo shows nothing.
    """

    query: Query
    scores: tuple[TileScore, ...] = ()


def allowed_tiles(
    outline: SetOutline, priors: Priors, within: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Tell which tiles the priors allow.

    A tile is allowed if one of its photos may show what the device sees. The distances are those
    of a single map (``visloc.localization.map_view.constraints``), measured from the bounding box
    of the photos' centres: twice the viewing distance around a sphere, a quarter of the height
    around a band.

    Args:
        priors: in the set's frame.
        within: (T,) the requested tiles; None for all.

    Returns:
        (T,) at least one is True.
    """
    low, high = outline.photo_boxes[:, 0], outline.photo_boxes[:, 1]
    allowed = np.ones(len(low), np.bool_) if within is None else within.copy()
    if priors.maps is not None:
        allowed &= _named(outline, priors.maps)
    spheres = []
    if priors.position is not None:
        spheres.append((priors.position.position, priors.position.radius))
    if priors.pose is not None:
        pose, covariance = priors.pose.device_from_world, priors.pose.covariance
        spheres.append((pose.center, POSE_PRIOR_STDS * largest_std(pose, covariance)))
    for center, radius in spheres:
        away = np.linalg.norm(center - np.clip(center, low, high), axis=1)
        allowed &= away <= radius + REACH * outline.reaches
    fix = located(priors, outline.manifest.world).gnss
    if fix is not None and fix.fix_from_world is not None:
        # A box may lie aslant of the vertical: the sphere around it is compared.
        radii = np.linalg.norm(high - low, axis=1) / 2
        beyond = fix.beyond((low + high) / 2) / fix.fix_from_world.scale
        allowed &= beyond <= radii + REACH * outline.reaches
    band, down = priors.height, down_in_set(priors, outline.gravity)
    if band is not None and down is not None:
        middle = -((low + high) / 2) @ down
        half = (high - low) / 2 @ np.abs(down)
        slack = HEIGHT_REACH * (band.max - band.min)
        allowed &= (middle + half >= band.min - slack) & (middle - half <= band.max + slack)
    if not allowed.any():
        raise refuse("set.no_tile", field="priors", got=outline.ref)
    return allowed


def nearest_tile(
    outline: SetOutline, priors: Priors, within: NDArray[np.bool_] | None = None
) -> int:
    """Return the row of the tile that reports that no photo fits the priors.

    It is the requested tile whose photos are nearest to the position prior; without a position, the
    first one.

    Args:
        priors: in the set's frame; they exclude every tile.
        within: (T,) the requested tiles; None for all.
    """
    asked = allowed_tiles(outline, Priors(maps=priors.maps), within)
    center = None
    if priors.position is not None:
        center = priors.position.position
    elif priors.pose is not None:
        center = priors.pose.device_from_world.center
    low, high = outline.photo_boxes[:, 0], outline.photo_boxes[:, 1]
    fix = located(priors, outline.manifest.world).gnss
    if center is None and fix is not None:
        return int(np.where(asked, fix.beyond((low + high) / 2), np.inf).argmin())
    if center is None:
        return int(np.flatnonzero(asked)[0])
    away = np.linalg.norm(center - np.clip(center, low, high), axis=1)
    return int(np.where(asked, away, np.inf).argmin())


def plan(scores: Sequence[TileScore]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Plan the search.

    Args:
        scores: at least one, best first.

    Returns:
        Rows of the tiles that are searched first, together: the best and those about as good. Rows
        of the tiles that are searched next unless an answer is clear.
    """
    least = _CLOSE_SCORE * scores[0].score
    searched = scores[:MAX_SEARCHED]
    first = [s.tile for number, s in enumerate(searched) if number == 0 or s.score >= least > 0]
    return tuple(first), tuple(s.tile for s in searched[len(first) :])


def is_clear(answer: InstantAnswer) -> bool:
    """Tell whether a pose is so certain that no other tile needs to be searched."""
    if measured_pose(answer) is None or answer.num_inliers < CLEAR_INLIERS:
        return False
    return not is_doubtful(answer)


def is_doubtful(answer: InstantAnswer) -> bool:
    """Tell whether the probability of a pose is low.

    A pose without a probability, such as one from motion, is not doubtful.
    """
    pose = measured_pose(answer)
    if pose is None or pose.probability is None:
        return False
    return pose.probability < CLEAR_PROBABILITY


def _named(outline: SetOutline, names: Sequence[str]) -> NDArray[np.bool_]:
    asked, known = set(names), set[str]()
    named = np.zeros(len(outline.tiles), np.bool_)
    for row, tile in enumerate(outline.tiles):
        found = asked & {tile.map, tile.ref}
        if found:
            known |= found
            named[row] = True
    for name in names:
        if name not in known:
            some = ", ".join(dict.fromkeys(tile.map for tile in outline.tiles[:_NAMED]))
            raise refuse(
                "priors.maps",
                field="priors.maps",
                expected=f"id or id@version of its tiles, such as {some}",
                got=name,
                ref=outline.ref,
            )
    return named
