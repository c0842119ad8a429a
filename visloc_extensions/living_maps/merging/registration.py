"""How one map lies in another, from photos of each localized in the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from mapping.frames.alignment import MIN_PHOTOS, NoTie, Seen, Tie, tie
from mapping.frames.stored_queries import match_stored, solve_stored
from visloc.archive import GlobalFeatures, Map
from visloc.errors import VislocError, refuse
from visloc.geometry import Pose
from visloc.localization.map_view.constraints import MapGeometry
from visloc.options import LocalizeOptions
from visloc_extensions.living_maps.merging.describing import describe_together

# Photos of each map that are tried, evenly chosen: a tie needs no more.
_MAX_TRIED = 100

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Where map B lies in map A.

    Attributes:
        tried: photos of B that were localized in A, or not.
        localized: rows of those that were; ``tie`` tells of them in this order.
        tie: A is there, B is here.
        described: one global descriptor of all photos, of A, then of B.
    """

    tried: int
    localized: tuple[int, ...]
    tie: Tie
    described: GlobalFeatures


def register(a: Map, b: Map, min_overlap: float, progress: Progress) -> Registration:
    """Find how a map lies in another with the same local features.

    Args:
        a: the map whose frame stays.
        min_overlap: least part of the photos of B that must be tied to A.
        progress: told the stage, how much is done, and how much there is.
    """
    progress("describing", 0, 1)
    described = describe_together((a, b))
    progress("describing", 1, 1)
    rows_a, rows_b = np.split(described.descriptors, [len(a.images)])
    depth = _by_depth(a) and _by_depth(b)
    seen, tried = _seen(b, a, rows_b, rows_a, lambda *done: progress("B in A", *done), depth=depth)
    back: dict[int, Seen] = {}
    if len(seen) >= MIN_PHOTOS:  # else it is refused below
        back, _ = _seen(a, b, rows_a, rows_b, lambda *done: progress("A in B", *done), depth=depth)
    rigid = a.manifest.world.metric and b.manifest.world.metric
    found = tie(list(seen.values()), list(back.values()), rigid=rigid)
    if isinstance(found, NoTie) and found.unit:
        raise refuse(
            "merge.unit", field="MAP", tried=tried, from_ref=b.ref, to_ref=a.ref, why=found.why
        )
    if isinstance(found, NoTie):
        raise _no_overlap(a, b, tried, found.why)
    needed = max(MIN_PHOTOS, int(np.ceil(min_overlap * tried)))
    if found.tied.sum() < needed:
        raise _no_overlap(
            a, b, tried, f"only {found.tied.sum()} of them are tied, and {needed} are needed"
        )
    return Registration(tried, tuple(seen), found, described)


def updates_of(settings: Mapping[str, JsonValue]) -> list[JsonValue]:
    """Return the updates in the settings of a map's method, which any software may have written."""
    updates = settings.get("updates")
    return updates if isinstance(updates, list) else []


def _by_depth(opened: Map) -> bool:
    """Whether depth made all landmarks of a map."""
    method = opened.manifest.method
    return method.name == "rgbd" and all(
        isinstance(update, dict) and update.get("method") == "rgbd"
        for update in updates_of(method.settings)
    )


def _no_overlap(a: Map, b: Map, tried: int, why: str) -> VislocError:
    return refuse("merge.overlap", field="MAP", tried=tried, from_ref=b.ref, to_ref=a.ref, why=why)


def _seen(
    source: Map,
    target: Map,
    own_rows: NDArray[np.float32],
    rows: NDArray[np.float32],
    progress: Callable[[int, int], None],
    *,
    depth: bool,
) -> tuple[dict[int, Seen], int]:
    """Localize photos of one map in another; those that are, by row, and how many were tried.

    With ``depth`` both maps know where a landmark is as well as depth does.
    """
    options, geometry = LocalizeOptions(), MapGeometry(target)
    source_origin = np.array(source.manifest.world.origin)
    chosen = np.linspace(0, len(source.images) - 1, min(len(source.images), _MAX_TRIED))
    tried = np.unique(chosen.astype(np.int64)).tolist()
    found = {}
    for done, image in enumerate(tried):
        progress(done, len(tried))
        alike = np.argsort(-(rows @ own_rows[image]), kind="stable")[: options.top_k]
        matched = match_stored(source, image, geometry, alike.tolist())
        solved = solve_stored(source, image, geometry, matched, options)
        if solved.answer.refusal is not None or solved.pose is None:
            continue
        inliers, local = solved.inliers[0], solved.pose.rig_from_world
        own = source.observations(image)[0][matched.keypoints][inliers]
        row = source.image_poses[image]
        found[image] = Seen(
            pose_here=Pose.from_quaternion(row[:4], row[4:]),
            camera=source.cameras[source.images[image].camera],
            pixels=source.keypoints(image)[matched.keypoints][inliers].astype(np.float64),
            points=geometry.points(matched.landmarks[inliers]) + geometry.origin,
            own_points=source.landmarks[own] + source_origin if depth else None,
            pose_there=Pose(local.rotation, local.translation - local.rotation @ geometry.origin),
        )
    progress(len(tried), len(tried))
    return found, len(tried)
