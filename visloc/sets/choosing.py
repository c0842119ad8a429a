"""Which tiles are searched, in which order, and which of their answers is the set's."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.archive import SetOutline
from visloc.archive.places import circles_of
from visloc.errors import InvalidInput, NotFound
from visloc.geodesy import ground_distances
from visloc.geometry import Pose, rotation_angle
from visloc.pose.centre import largest_std, position_covariance
from visloc.priors import HEIGHT_REACH, POSE_PRIOR_STDS, REACH, Priors
from visloc.sets.frame import down_in_set
from visloc.types import Answer, InstantAnswer, Localized, Reason, Refusal

# Tiles that a query is searched in, at most.
MAX_SEARCHED = 5
# Tiles of at least this share of the best score are searched at once with the best.
_CLOSE_SCORE = 0.8
# An answer of so many inliers needs no other tile.
CLEAR_INLIERS = 100
# Of the most inliers: answers of this share must agree with each other, or the answer is
# ambiguous; of those of this share, the most certain counts.
_RIVAL_SHARE, _SIMILAR_SHARE = 0.5, 0.8
# Answers agree that are no further apart than what both leave open (three standard deviations),
# and how well tiles are tied to each other: a tenth of how far their photos see, five degrees.
STDS = 3.0
TIE_REACH_SHARE, TIE_ANGLE = 0.1, math.radians(5.0)
_NAMED = 5


@dataclass(frozen=True, slots=True)
class TileScore:
    """How much a tile looks like a query.

    Attributes:
        tile: its row in the set.
        score: estimated cosine similarity of its best photos, comparable within one query.
    """

    tile: int
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What one tile answered.

    Attributes:
        tile: its row in the set.
        answer: in the set's frame (``visloc.sets.frame.answer_in_set``).
    """

    tile: int
    answer: Answer | InstantAnswer


def tiles_near(
    outline: SetOutline, latitude: float, longitude: float, radius: float
) -> NDArray[np.bool_]:
    """Tell which tiles reach into a circle on Earth.

    Args:
        outline: the set.
        latitude: of the circle's middle, degrees.
        longitude: likewise.
        radius: metres.

    Returns:
        (T,) all False for a set that is not tied to the Earth.
    """
    if outline.geodetic is None:
        return np.zeros(len(outline.tiles), np.bool_)
    boxes = np.array([(tile.extent.min, tile.extent.max) for tile in outline.tiles])
    circles = circles_of(boxes, outline.geodetic)
    away = ground_distances(circles, np.array([latitude, longitude, 0.0]))
    return np.asarray(away <= radius + circles[:, 2])


def allowed_tiles(
    outline: SetOutline, priors: Priors, within: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Tell which tiles the priors allow.

    A tile is allowed when a photo of it may show what the device sees. As in one map, photos
    count that were taken within twice the distance that they see of a sphere, or within a quarter
    of its height of a band (``visloc.constraints``). Of a tile, the box of its photos' centres is
    looked at.

    Args:
        outline: the set.
        priors: in its frame.
        within: (T,) the tiles that are asked for; None for all.

    Returns:
        (T,) one at least is True.

    Raises:
        InvalidInput: ``priors.maps`` for a name that is no tile; ``priors.height`` when neither the
            set nor the priors know which way is down.
        NotFound: ``set.no_tile``.
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
    band, down = priors.height, down_in_set(priors, outline.gravity)
    if band is not None and down is not None:
        middle = -((low + high) / 2) @ down
        half = (high - low) / 2 @ np.abs(down)
        slack = HEIGHT_REACH * (band.max - band.min)
        allowed &= (middle + half >= band.min - slack) & (middle - half <= band.max + slack)
    if not allowed.any():
        raise NotFound(
            "set.no_tile",
            "no tile of the set has photos where the priors allow the device",
            field="priors",
            expected="priors that a tile obeys; what the tiles hold is in the set's description",
            got=outline.ref,
        )
    return allowed


def nearest_tile(
    outline: SetOutline, priors: Priors, within: NDArray[np.bool_] | None = None
) -> int:
    """Return the tile that says best that it has no photo where the priors allow the device.

    Of the tiles that are asked for, that whose photos are nearest to where the device may be; the
    first where only a height says so.

    Args:
        outline: the set.
        priors: in its frame, of which ``allowed_tiles`` leaves nothing.
        within: (T,) the tiles that are asked for; None for all.

    Returns:
        Its row.

    Raises:
        NotFound: ``set.no_tile`` when none that is asked for is named.
    """
    asked = allowed_tiles(outline, Priors(maps=priors.maps), within)
    center = None
    if priors.position is not None:
        center = priors.position.position
    elif priors.pose is not None:
        center = priors.pose.device_from_world.center
    if center is None:
        return int(np.flatnonzero(asked)[0])
    low, high = outline.photo_boxes[:, 0], outline.photo_boxes[:, 1]
    away = np.linalg.norm(center - np.clip(center, low, high), axis=1)
    return int(np.where(asked, away, np.inf).argmin())


def plan(scores: Sequence[TileScore]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Say which tiles are searched.

    Args:
        scores: at least one, best first.

    Returns:
        Rows of the tiles that are searched at once, the best and those about as good; and of those
        that are searched after them unless an answer is clear.
    """
    least = _CLOSE_SCORE * scores[0].score
    searched = scores[:MAX_SEARCHED]
    first = [s.tile for number, s in enumerate(searched) if number == 0 or s.score >= least > 0]
    return tuple(first), tuple(s.tile for s in searched[len(first) :])


def is_clear(answer: Answer | InstantAnswer) -> bool:
    """Tell whether no other tile needs to be searched: a pose of many inliers."""
    return _pose(answer) is not None and inliers_of(answer) >= CLEAR_INLIERS


def judge(outline: SetOutline, found: Sequence[Found]) -> int | Refusal:
    """Choose the answer of a set among those of its tiles.

    Of answers with a pose, the one with the most inliers counts, or one that has similarly many
    and is more certain. Two places are reason to refuse, each of which explains half as much as
    the best: guessing could put the device into the wrong building. All pairs are compared, since
    an uncertain answer agrees with places that contradict each other.

    Args:
        outline: the set.
        found: of the tiles that were searched, at least one.

    Returns:
        The row in ``found`` of the answer; when no tile gave a pose, of that which came furthest.
        Or a refusal, ``ambiguous``.
    """
    localized = [row for row, one in enumerate(found) if _pose(one.answer) is not None]
    if not localized:
        return max(range(len(found)), key=lambda row: _progress(found[row].answer))
    most = max(inliers_of(found[row].answer) for row in localized)
    rivals = [row for row in localized if inliers_of(found[row].answer) >= _RIVAL_SHARE * most]
    for a, b in itertools.combinations(rivals, 2):
        if not _agree(outline, found[a], found[b]):
            return _ambiguous(outline, found[a], found[b])
    similar = [row for row in rivals if inliers_of(found[row].answer) >= _SIMILAR_SHARE * most]
    return min(similar, key=lambda row: _spread(found[row].answer))


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
            raise InvalidInput(
                "priors.maps",
                f"not a tile of {outline.ref}",
                field="priors.maps",
                expected=f"id or id@version of its tiles, such as {some}",
                got=name,
            )
    return named


def _pose(answer: Answer | InstantAnswer) -> tuple[Pose, NDArray[np.float64]] | None:
    """The pose that an answer's own images measured, and its covariance."""
    if isinstance(answer, Localized):
        return answer.cam_from_world, answer.covariance
    if isinstance(answer, InstantAnswer) and answer.pose is not None and answer.refusal is None:
        return answer.pose.rig_from_world, answer.pose.covariance
    return None


def inliers_of(answer: Answer | InstantAnswer) -> int:
    """Return the inliers of the best pose, accepted or not."""
    if isinstance(answer, InstantAnswer):
        return answer.num_inliers
    return answer.evidence.num_inliers


def _progress(answer: Answer | InstantAnswer) -> tuple[int, int]:
    if isinstance(answer, InstantAnswer):
        return answer.num_inliers, answer.num_correspondences
    return answer.evidence.num_inliers, answer.evidence.num_correspondences


def _spread(answer: Answer | InstantAnswer) -> float:
    """Variance of the position, along all axes together."""
    known = _pose(answer)
    return math.inf if known is None else float(position_covariance(*known).trace())


def _agree(outline: SetOutline, a: Found, b: Found) -> bool:
    """Whether two poses are those of one place, seen from two tiles."""
    known_a, known_b = _pose(a.answer), _pose(b.answer)
    if known_a is None or known_b is None:
        return False
    floor = TIE_REACH_SHARE * float(outline.reaches[[a.tile, b.tile]].max())
    (pose_a, covariance_a), (pose_b, covariance_b) = known_a, known_b
    away = float(np.linalg.norm(pose_a.center - pose_b.center))
    turned = rotation_angle(pose_a.rotation @ pose_b.rotation.T)
    turn_std = math.sqrt(covariance_a[:3, :3].trace() + covariance_b[:3, :3].trace())
    move_std = math.hypot(largest_std(*known_a), largest_std(*known_b))
    return away <= floor + STDS * move_std and turned <= TIE_ANGLE + STDS * turn_std


def _ambiguous(outline: SetOutline, a: Found, b: Found) -> Refusal:
    ref_a, ref_b = (outline.tiles[one.tile].ref for one in (a, b))
    count_a, count_b = (inliers_of(one.answer) for one in (a, b))
    return Refusal(
        "gate",
        Reason.AMBIGUOUS,
        f"{ref_a} and {ref_b} both explain it, at different places, with {count_a} and "
        f"{count_b} inliers; say where it is (priors)",
    )
