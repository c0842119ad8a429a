"""Where a new capture lies in the map that it is to join, and whether it fits at all."""

from __future__ import annotations

from bisect import bisect
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mapping.build.photos import MappingPhoto
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
from mapping.maps.updating.localizing import Placed
from visloc.archive import Map
from visloc.errors import VislocError, refuse
from visloc.evaluation import pose_error
from visloc.geometry import Pose, Similarity
from visloc.localization.solving import registration_for
from visloc.pose.reprojection import reprojection_errors
from visloc.pose.views import MatchedView
from visloc.types import LocalizeOptions

T = TypeVar("T")
Lift = Callable[[MappingPhoto, NDArray[np.float64]], tuple[NDArray[np.int64], NDArray[np.float64]]]
"""Tells which of some pixels (n, 2) of a photo have a depth, (m,), and their place in the photo's
own frame of the world (m, 3)."""

# Of the photos that are tried, this part must be localized, and of those agree.
_MIN_PART = 0.5
# Matches with depth that a tie is refined on; of fewer, projections tell more.
_MIN_LIFTED = 100
# Photos whose depth is compared with the map, evenly chosen.
_LIFTED_BY = 16
_GOOD_DEPTH = (
    f"depth within {MAX_DEPTH_OFF:.0%} of what the map and the poses say (--depth-scale), or "
    "--method sfm"
)


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a capture lies in a map.

    Attributes:
        map_from_dataset: takes the dataset's frame to the map's.
        tried: photos that were to be localized.
        not_localized: how many of them were not, by reason.
        tied: photos whose own pose, moved, agrees with what they see of the map.
        pixels: median distance between where they see landmarks and their projections.
        position: median distance between where they were localized and their own pose, moved, in
            units of the map.
        orientation_deg: the same of directions.
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
    """Refuse a capture of which most photos are not localized.

    Raises:
        Conflict: ``update.elsewhere``.
    """
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
    *,
    metric: bool,
) -> Placement:
    """Find where a capture lies, from where its photos were localized.

    Args:
        opened: the map.
        photos: those that were tried; with poses of their own but for ``localize``.
        placed: where they were localized.
        poses: a name of ``mapping.maps.updating.settings.POSES``.
        lift: gives pixels their place by the depth of their photo, which is compared with the map
            and makes a tie better; None without depth.
        metric: whether a unit of the photos' own poses is a metre.

    Raises:
        Conflict: ``update.elsewhere`` when too few are localized, or do not agree, or their depth
            contradicts where they lie.
    """
    refuse_elsewhere(opened, placed)
    both = [(photo, one) for photo, one in zip(photos, placed, strict=True) if one.localized]
    localized = (
        f"{len(both)} of {len(photos)} photos that were tried are localized in map {opened.ref}"
    )
    if poses == "localize":
        both = [(replace(photo, cam_from_world=one.cam_from_map), one) for photo, one in both]
        agrees = [True] * len(both)
        _refuse_other_depth(localized, both, agrees, lift)
        own = [one.cam_from_map for _, one in both]
        return _placement(Similarity.identity(), placed, both, own, agrees)
    if poses == "given":
        own = [photo.pose for photo, _ in both]
        agrees = [_fits(photo, one) for photo, one in both]
        if sum(agrees) <= len(both) / 2:  # as a tie needs more than half
            raise _elsewhere(
                f"{localized}, but only {sum(agrees)} where --poses given has them",
                "poses in the map's frame, or --poses tie",
            )
        _refuse_other_depth(localized, both, agrees, lift)
        return _placement(Similarity.identity(), placed, both, own, agrees)
    rigid = metric and opened.manifest.world.metric
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
    if lift is not None:
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
    own = [similarity.move(photo.pose) for photo, _ in both]
    return _placement(similarity, placed, both, own, agrees)


def contradicted(
    photos: Sequence[MappingPhoto], placed: Mapping[int, Placed], map_from_dataset: Similarity
) -> list[int]:
    """Rows of the photos that were localized where their own pose, moved, cannot be."""
    rows = [row for row, one in placed.items() if one.localized]
    wrong = contradicting([_seen(photos[row], placed[row]) for row in rows], map_from_dataset)
    return sorted(row for row, is_wrong in zip(rows, wrong, strict=True) if is_wrong)


def beside(wrong: Collection[int], localized: Collection[int], count: int) -> list[int]:
    """Rows of photos that are not localized and of whose neighbours that are one is wrong.

    Args:
        wrong: rows of photos that the map contradicts.
        localized: rows of all that are localized, these among them.
        count: of all photos, which are in the order in which they were taken.
    """
    known = sorted(localized)
    found = []
    for row in sorted(set(range(count)).difference(known)):
        at = bisect(known, row)
        if not set(known[max(at - 1, 0) : at + 1]).isdisjoint(wrong):
            found.append(row)
    return found


def _refuse_other_depth(
    localized: str,
    both: Sequence[tuple[MappingPhoto, Placed]],
    agrees: Sequence[bool],
    lift: Lift | None,
) -> None:
    """Refuse depth that contradicts the map, where poses are in its frame."""
    if lift is not None:
        _refuse_depth(localized, _all_lifted(both, agrees, lift), Similarity.identity())


def _refuse_depth(localized: str, lifted: Sequence[Seen], map_from_dataset: Similarity) -> None:
    if any(len(one.points) for one in lifted):
        other = other_depth(lifted, map_from_dataset)
        if other is not None:
            raise _elsewhere(f"{localized}, but {other}", _GOOD_DEPTH)


def _all_lifted(
    both: Sequence[tuple[MappingPhoto, Placed]], agrees: Sequence[bool], lift: Lift
) -> list[Seen]:
    """Photos that agree, with those of their matches whose place their depth tells as well."""
    agreed = [pair for pair, agree in zip(both, agrees, strict=True) if agree]
    return [_lifted(_seen(*pair), pair[0], lift) for pair in evenly(agreed, _LIFTED_BY)]


def _seen(photo: MappingPhoto, one: Placed) -> Seen:
    return Seen(photo.pose, photo.camera, one.pixels, one.points, one.cam_from_map)


def _lifted(seen: Seen, photo: MappingPhoto, lift: Lift) -> Seen:
    """A photo with those of its matches whose place its depth tells as well."""
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


def _fits(photo: MappingPhoto, one: Placed) -> bool:
    """Whether a photo's own pose explains most of what it sees, as poses of queries must."""
    most = registration_for(LocalizeOptions(), [photo.camera]).max_error_px
    return bool(np.mean(_errors_px(photo, one, photo.pose) <= most) >= _MIN_PART)


def _errors_px(photo: MappingPhoto, one: Placed, pose: Pose) -> NDArray[np.float64]:
    """Distances (n,) in pixels between where a photo sees landmarks and where they project."""
    view = MatchedView(photo.camera, Pose.identity(), one.pixels, one.points)
    return reprojection_errors(view, pose)


def _reasons(placed: Sequence[Placed]) -> dict[str, int]:
    return dict(Counter(one.reason for one in placed if not one.localized).most_common())


def _elsewhere(message: str, expected: str, got: str | None = None) -> VislocError:
    return refuse("update.elsewhere", field="DATASET", expected=expected, got=got, why=message)
