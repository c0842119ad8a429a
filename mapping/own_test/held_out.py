"""A photo of a map, localized in what the map would be without it.

What the map keeps of a photo is a query: its descriptors, its keypoints and its rows of the global
descriptors. The same functions as online answer it, from what would be in the map without the
photo and without those taken near it. Its landmarks that are gone then stay in the query: they
are what a photo of a place shows that the map does not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames.stored_queries import match_stored, solve_stored
from mapping.progress import ItemProgress
from visloc.archive import Map
from visloc.archive.schema import Doubt
from visloc.evaluation import pose_error
from visloc.geometry import Pose
from visloc.localization.acceptance.gates import registration_for
from visloc.localization.map_view.constraints import MapGeometry, Viewpoints
from visloc.matching.correspondences import Correspondences
from visloc.options import LocalizeOptions
from visloc.pose.reprojection import MatchedView, reprojection_errors
from visloc.retrieval.index import retrieve

# How far from the photo others are left out, as ``Viewpoints.apart_from`` counts: nothing but the
# photo itself, then as if the mapper had walked by further away or not looked there.
LEAVE_OUT_WITHIN = (0.0, 0.2, 0.4, 0.6, 0.9)
_COUNTED_PART = 4


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """One run.

    Attributes:
        image: row of the map's photos.
        left_out: (k,) int64 rows of the photos that were left out, ``image`` among them.
        reason: of the refusal; "" when localized.
        position_error: units of the world; infinity when refused.
        orientation_error_deg: degrees; infinity when refused.
        inliers: of the best pose, believed or not.
        correct: (c,) int64 landmarks that were matched with where the photo does see them.
        errors_px: (c,) float64, how far from it their projections with the photo's pose are.
    """

    image: int
    left_out: NDArray[np.int64]
    reason: str
    position_error: float
    orientation_error_deg: float
    inliers: int
    correct: NDArray[np.int64]
    errors_px: NDArray[np.float64]

    @property
    def localized(self) -> bool:
        """Whether the map gave a pose."""
        return self.reason == ""


def spread_photos(num_photos: int, most: int) -> list[int]:
    """Rows of at most so many photos, evenly spread."""
    chosen = np.linspace(0, num_photos - 1, min(num_photos, most)).astype(np.int64)
    return [int(image) for image in np.unique(chosen)]


def taken_with(opened: Map, image: int) -> NDArray[np.bool_]:
    """Which photos (n,) the same rig took at the same instant, the photo itself among them."""
    record = opened.images[image]
    on_rig = set[str]().union(*(rig for rig in opened.rigs.values() if record.camera in rig))
    others = on_rig - {record.camera}
    together = np.array(
        [i.timestamp == record.timestamp and i.camera in others for i in opened.images]
    )
    together[image] = True
    return together


def left_out_sets(opened: Map, viewpoints: Viewpoints, image: int) -> list[NDArray[np.int64]]:
    """Which photos (k,) to leave out in each run of one, fewest first.

    Those that the same rig took at the same instant always go with it: no query has them.
    """
    together = taken_with(opened, image)
    apart = viewpoints.apart_from(viewpoints.pose(image))
    sets: list[NDArray[np.int64]] = []
    for within in LEAVE_OUT_WITHIN:
        without = np.flatnonzero(together | (apart < within))
        is_new = not sets or len(without) > len(sets[-1])
        if is_new and len(without) < len(opened.images):
            sets.append(without)
    return sets


def localize_held_out(
    opened: Map, viewpoints: Viewpoints, image: int, left_out: NDArray[np.int64]
) -> HeldOut:
    """Localize one photo in what the map would be without some, itself among them."""
    options = LocalizeOptions()
    camera = opened.cameras[opened.images[image].camera]
    pose = viewpoints.pose(image)
    geometry = MapGeometry(opened)
    matched = match_held_out(geometry, image, left_out, options)
    pixels = opened.keypoints(image)[matched.keypoints].astype(np.float64)
    points = opened.landmarks[matched.landmarks].astype(np.float64)
    view = MatchedView(camera, Pose.identity(), pixels, points)
    errors_px = reprojection_errors(view, pose) if len(view) else np.empty(0)
    correct = errors_px <= registration_for(options, [camera]).max_error_px  # False for NaN

    solved = solve_stored(opened, image, geometry, matched, options)
    refusal, position_error, orientation_error = solved.answer.refusal, np.inf, np.inf
    if refusal is None and solved.pose is not None:
        position_error, orientation_error = pose_error(solved.pose.rig_from_world, pose)
    return HeldOut(
        image,
        left_out,
        "" if refusal is None else str(refusal.reason),
        position_error,
        orientation_error,
        sum(int(mask.sum()) for mask in solved.inliers),
        matched.landmarks[correct],
        errors_px[correct],
    )


def vanishing(opened: Map, left_out: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sorted landmarks that a map without some of its photos would not have.

    Those made of matches need two photos that see them, those of a depth map one.
    """
    seen = [opened.observations(int(image))[0] for image in left_out]
    return too_seldom_seen(opened, np.concatenate(seen))


def too_seldom_seen(opened: Map, seen: NDArray[np.integer]) -> NDArray[np.int64]:
    """``vanishing`` of the landmarks (k,) that the photos left out see, each as often."""
    least = 1 if opened.manifest.method.name == "rgbd" else 2
    num = len(opened.landmarks)
    if len(seen) > num // _COUNTED_PART:  # to sort so many takes longer than to count all
        counts = np.bincount(seen, minlength=num)
        landmarks = np.flatnonzero(counts)
        counts = counts[landmarks]
    else:
        landmarks, counts = np.unique(seen, return_counts=True)
    remaining = opened.track_lengths[landmarks].astype(np.int64) - counts
    return landmarks[remaining < least].astype(np.int64)


def match_held_out(
    geometry: MapGeometry,
    image: int,
    left_out: NDArray[np.int64],
    options: LocalizeOptions,
    features: NDArray[np.int64] | None = None,
) -> Correspondences:
    """Match a photo's features with a map without some of its photos, as the localizer does.

    Args:
        geometry: of the map; of one without landmarks, ``MapGeometry.without`` these photos.
        left_out: (k,) rows of the photos that the map is not to have.
        options: how many photos are asked.
        features: (m,) rows of the photo's features that count; None for all.
    """
    opened = geometry.opened
    remaining = np.ones(len(opened.images))
    remaining[left_out] = 0.0
    rows = opened.global_descriptors
    query = {name: rows[name][image] for name in opened.fusion.counted(rows)}
    retrieved = retrieve(query, rows, options.top_k, remaining, opened.fusion)
    gone = vanishing(opened, left_out) if opened.has_landmarks else None
    return match_stored(opened, image, geometry, retrieved.images.tolist(), gone, features)


# What counts as localized. In metric maps the high precision of Sattler et al. 2018, within shares
# of the distance from which photos see: it would mean nothing around a coin, and too much above a
# town. In others as much of that distance as the angle is of a turn.
_POSITION_M, _ORIENTATION_DEG = 0.25, 2.0
_LEAST_OF_REACH, _POSITION_OF_REACH, _MOST_OF_REACH = 0.01, 0.05, 0.2


@dataclass(frozen=True, slots=True)
class Within:
    """The distance within which a photo counts as localized.

    Attributes:
        position: units of the world.
        orientation_deg: degrees.
    """

    position: float
    orientation_deg: float

    def holds(self, run: HeldOut) -> bool:
        """Whether a run was localized that well."""
        return (
            run.position_error <= self.position
            and run.orientation_error_deg <= self.orientation_deg
        )


def tolerance_of(opened: Map, viewpoints: Viewpoints) -> Within:
    """Return the distances within which photos of a map count as localized."""
    reach = viewpoints.reach
    position = _POSITION_OF_REACH * reach
    if opened.manifest.world.metric:
        position = min(max(_POSITION_M, _LEAST_OF_REACH * reach), _MOST_OF_REACH * reach)
    return Within(position, _ORIENTATION_DEG)


def come_back(opened: Map, images: Sequence[int], progress: ItemProgress) -> list[bool]:
    """Tell which photos are localized where they are, without them and their nearest neighbours."""
    viewpoints = MapGeometry(opened).viewpoints
    within = tolerance_of(opened, viewpoints)
    right = []
    for done, image in enumerate(images):
        progress(done, len(images))
        sets = left_out_sets(opened, viewpoints, image)[:2]
        right.append(
            bool(sets) and within.holds(localize_held_out(opened, viewpoints, image, sets[-1]))
        )
    progress(len(images), len(images))
    return right


def doubts_of_length(
    opened: Map, measured: Sequence[str], astray: Sequence[str] = ()
) -> tuple[Doubt, ...]:
    """Return a doubt about a map whose size rests on photos that do not come back.

    Args:
        measured: names of the photos of the known length; those that are not in the map do not
            count, as they gave it no size.
        astray: photos that are known to lie away from where they were taken.
    """
    rows = {image.name: row for row, image in enumerate(opened.images)}
    named = [name for name in measured if name in rows]
    if not named:
        return ()
    back = come_back(opened, [rows[name] for name in named], lambda *_: None)
    lost = [name for name, right in zip(named, back, strict=True) if not right or name in astray]
    if not lost:
        return ()
    message = "the size rests on photos that do not come back where they were taken (--scale)"
    return (Doubt(kind="scale", message=message, photos=tuple(lost)),)
