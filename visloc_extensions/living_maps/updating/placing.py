"""Finds where a new capture lies in the map that it joins, and checks that it fits."""

from __future__ import annotations

from bisect import bisect
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mapping.frames.alignment import (
    MAX_DEPTH_OFF,
    NoTie,
    Seen,
    agreeing,
    contradicting,
    other_depth,
    refined_by_depth,
    tie,
    too_few,
)
from mapping.stages.photos import MappingPhoto
from visloc.archive import Map
from visloc.errors import VislocError, refuse
from visloc.evaluation import pose_error
from visloc.geometry import Pose, Similarity
from visloc.localization.acceptance.gates import registration_for
from visloc.options import LocalizeOptions
from visloc.pose.reprojection import MatchedView, reprojection_errors
from visloc_extensions.living_maps.updating.localizing import Placed

T = TypeVar("T")
Lift = Callable[[MappingPhoto, NDArray[np.float64]], tuple[NDArray[np.int64], NDArray[np.float64]]]
"""Takes a photo and pixels (n, 2). Returns the rows (m,) of the pixels that have a depth, and their
points (m, 3) in the photo's own world."""

# This part of the tried photos must be localized, and this part of those must agree.
_MIN_PART = 0.5
# Fewest matches with depth to refine a tie; with fewer, projections are more accurate.
_MIN_LIFTED = 100
# Photos whose depth is compared with the map, evenly chosen.
_LIFTED_BY = 16
_GOOD_DEPTH = (
    f"depth within {MAX_DEPTH_OFF:.0%} of what the map and the poses say (--depth-scale), or "
    "--method sfm"
)


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """The pose of a capture in a map, and how well photos agree with it.

    Attributes:
        tried: photos that were to be localized.
        not_localized: how many of them were not, by reason.
        tied: photos whose own pose, moved, agrees with what they see of the map.
        pixels: median reprojection error of their inliers.
        position: median distance between their localized and own (moved) positions, in units of
            the map.
        orientation_deg: the same of orientations.
    """

    map_from_dataset: Similarity
    tried: int
    not_localized: dict[str, int]
    tied: int
    pixels: float
    position: float
    orientation_deg: float


def evenly(items: Sequence[T], count: int) -> list[T]:
    """Return at most ``count`` of the items, evenly chosen."""
    rows = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[row] for row in rows]


def refuse_elsewhere(opened: Map, placed: Sequence[Placed]) -> None:
    """Refuse a capture of which most photos are not localized."""
    localized = sum(one.localized for one in placed)
    if localized < _MIN_PART * len(placed):
        reasons = ", ".join(f"{count} {reason}" for reason, count in _reasons(placed).items())
        raise _elsewhere(
            f"most of its photos are not localized in map {opened.ref}",
            f"half of {len(placed)} photos that were tried",
            f"{localized}; {reasons}",
        )


def place_capture(
    opened: Map,
    photos: Sequence[MappingPhoto],
    placed: Sequence[Placed],
    poses: str,
    lift: Lift | None,
    readings: Callable[[], Mapping[str, Callable[[], list[Pose]]]],
    *,
    metric: bool,
) -> Placement:
    """Find where a capture lies, from the poses at which its photos were localized.

    Args:
        photos: the photos that were tried; with poses of their own, except for ``localize``.
        placed: the map's answers to them.
        poses: a name of ``visloc_extensions.living_maps.updating.settings.POSES``.
        lift: lifts pixels by the depth of their photo. Depth is compared with the map, and refines
            a tie. None without depth.
        readings: returns the photos' own poses as other conventions have them, to name a mistake.
        metric: whether a unit of the photos' own poses is a metre.
    """
    refuse_elsewhere(opened, placed)
    both = [(photo, one) for photo, one in zip(photos, placed, strict=True) if one.localized]
    localized = (
        f"{len(both)} of {len(photos)} photos that were tried are localized in map {opened.ref}"
    )
    if poses == "tie":
        rigid = metric and opened.manifest.world.metric
        similarity, agrees = _tie(both, localized, lift, rigid=rigid, metric=metric)
        own = [similarity.move(photo.pose) for photo, _ in both]
        return _placement(similarity, placed, both, own, agrees)
    if poses == "localize":
        both = [(replace(photo, cam_from_world=one.cam_from_map), one) for photo, one in both]
        agrees = [True] * len(both)
    else:
        agrees = [_fits(photo, one) for photo, one in both]
        if sum(agrees) <= len(both) / 2:  # a tie needs more than half, too
            named = _named(photos, placed, readings())
            raise _elsewhere(
                f"{localized}, but only {sum(agrees)} where --poses given has them{named}",
                "poses in the map's frame, or --poses tie",
            )
    if lift is not None:
        _refuse_depth(localized, _all_lifted(both, agrees, lift), Similarity.identity())
    own = [photo.pose for photo, _ in both]
    return _placement(Similarity.identity(), placed, both, own, agrees)


def _tie(
    both: Sequence[tuple[MappingPhoto, Placed]],
    localized: str,
    lift: Lift | None,
    *,
    rigid: bool,
    metric: bool,
) -> tuple[Similarity, list[bool]]:
    """Return where the photos' own frame lies in the map, and which photos agree."""
    seen = [_seen(photo, one) for photo, one in both]
    found = tie(seen, rigid=rigid)
    if isinstance(found, NoTie):
        raise _elsewhere(
            f"{localized}, but {found.why}",
            "poses in metres, as those of the map, or --not-metric"
            if found.unit
            else "poses that agree with where the photos are localized, or --poses localize",
        )
    similarity, agrees = found.there_from_here, found.tied.tolist()
    if lift is None:
        return similarity, agrees
    lifted = _all_lifted(both, agrees, lift)
    count = sum(len(one.points) for one in lifted)
    if count < _MIN_LIFTED and not metric:
        raise _elsewhere(
            f"{localized}, but only {count} points that they see have depth, which do not tell "
            "whether its unit is that of the poses",
            f"{_MIN_LIFTED} points with depth, or --method sfm",
        )
    _refuse_depth(localized, lifted, similarity)
    if count >= _MIN_LIFTED:
        similarity = refined_by_depth(lifted, similarity, rigid=rigid)
        tied = agreeing(seen, similarity)
        if (few := too_few(tied)) is not None:
            raise _elsewhere(f"{localized}, but with depth {few}", _GOOD_DEPTH)
        agrees = tied.tolist()
    return similarity, agrees


def contradicted(
    photos: Sequence[MappingPhoto], placed: Mapping[int, Placed], map_from_dataset: Similarity
) -> list[int]:
    """Return the rows of localized photos that contradict their own pose, moved."""
    rows = [row for row, one in placed.items() if one.localized]
    wrong = contradicting([_seen(photos[row], placed[row]) for row in rows], map_from_dataset)
    return sorted(row for row, is_wrong in zip(rows, wrong, strict=True) if is_wrong)


def beside(wrong: Collection[int], localized: Collection[int], count: int) -> list[int]:
    """Return the rows of photos that are not localized, and have a wrong localized neighbour.

    Args:
        localized: rows of all localized photos, including the wrong ones.
        count: of all photos, in the order in which they were taken.
    """
    known = sorted(localized)
    found = []
    for row in sorted(set(range(count)).difference(known)):
        at = bisect(known, row)
        if not set(known[max(at - 1, 0) : at + 1]).isdisjoint(wrong):
            found.append(row)
    return found


def _refuse_depth(localized: str, lifted: Sequence[Seen], map_from_dataset: Similarity) -> None:
    if any(len(one.points) for one in lifted):
        other = other_depth(lifted, map_from_dataset)
        if other is not None:
            raise _elsewhere(f"{localized}, but {other}", _GOOD_DEPTH)


def _all_lifted(
    both: Sequence[tuple[MappingPhoto, Placed]], agrees: Sequence[bool], lift: Lift
) -> list[Seen]:
    """Return the photos that agree, with their matches that have a depth."""
    agreed = [pair for pair, agree in zip(both, agrees, strict=True) if agree]
    return [_lifted(_seen(*pair), pair[0], lift) for pair in evenly(agreed, _LIFTED_BY)]


def _seen(photo: MappingPhoto, one: Placed) -> Seen:
    return Seen(photo.pose, photo.camera, one.pixels, one.points, one.cam_from_map)


def _lifted(seen: Seen, photo: MappingPhoto, lift: Lift) -> Seen:
    """Return a photo with its matches that have a depth."""
    rows, points = lift(photo, seen.pixels)
    return replace(seen, pixels=seen.pixels[rows], points=seen.points[rows], own_points=points)


def _placement(
    similarity: Similarity,
    placed: Sequence[Placed],
    both: Sequence[tuple[MappingPhoto, Placed]],
    own: Sequence[Pose],
    agrees: Sequence[bool],
) -> Placement:
    tied = [(*pair, pose) for pair, pose, fits in zip(both, own, agrees, strict=True) if fits]
    errors = np.array([pose_error(pose, one.cam_from_map) for _, one, pose in tied])
    pixels = np.concatenate([_errors_px(photo, one, pose) for photo, one, pose in tied])
    return Placement(
        similarity,
        len(placed),
        _reasons(placed),
        len(tied),
        float(np.nanmedian(pixels)),
        *np.median(errors, axis=0).tolist(),
    )


def _named(
    photos: Sequence[MappingPhoto],
    placed: Sequence[Placed],
    readings: Mapping[str, Callable[[], list[Pose]]],
) -> str:
    """Name the convention in which most of the photos' own poses fit the map, if any."""
    for name, read in readings.items():
        own = [replace(p, cam_from_world=pose) for p, pose in zip(photos, read(), strict=True)]
        both = [(p, one) for p, one in zip(own, placed, strict=True) if one.localized]
        if sum(_fits(*each) for each in both) > len(both) / 2:
            return f". They look like {name}"
    return ""


def _fits(photo: MappingPhoto, one: Placed) -> bool:
    """Tell whether a photo's own pose explains most of its inliers, by the limit of queries."""
    most = registration_for(LocalizeOptions(), [photo.camera]).max_error_px
    return bool(np.mean(_errors_px(photo, one, photo.pose) <= most) >= _MIN_PART)


def _errors_px(photo: MappingPhoto, one: Placed, pose: Pose) -> NDArray[np.float64]:
    """Return the distances (n,) in pixels of keypoints from the projections of their landmarks."""
    view = MatchedView(photo.camera, Pose.identity(), one.pixels, one.points)
    return reprojection_errors(view, pose)


def _reasons(placed: Sequence[Placed]) -> dict[str, int]:
    return dict(Counter(one.reason for one in placed if not one.localized).most_common())


def _elsewhere(message: str, expected: str, got: str | None = None) -> VislocError:
    return refuse("update.elsewhere", field="DATASET", expected=expected, got=got, why=message)
