"""A refused photo, matched with the photos of one place only.

Each keypoint keeps one landmark, that of the photos most like the query. At night or in fog, the
photos that show the place are among those that are searched, but not the first of them: photos of
other places take their keypoints. So each place is solved for with the matches of its own photos.
The most promising one is looked at again, with all photos that were taken near the pose
(docs/decisions/0041-one-place-at-a-time.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.localization.acceptance.gates import (
    Problem,
    enough_inliers,
    enough_of_the_matches,
    first_refusal,
)
from visloc.localization.acceptance.rivals import Proposed
from visloc.localization.map_view.constraints import Constraints, MapGeometry
from visloc.localization.solving import Look, Matches, SeenImage, Solved, solve_instant
from visloc.options import DEFAULT_PRESET, PRESETS, LocalizeOptions
from visloc.pose.generalized import GeneralizedPose, refine_generalized_pose
from visloc.pose.reprojection import MatchedView
from visloc.pose.search import search_with_pycolmap
from visloc.priors import Priors
from visloc.types import CameraSource, Reason

# Refusals of photos that have too few matches for their pose.
_TOO_FEW = (Reason.NO_POSE, Reason.TOO_FEW_INLIERS, Reason.LOW_INLIER_RATIO)
# At most so many places are solved for. Photos of one place look at most so far apart (rad).
_MAX_PLACES, _SAME_PLACE = 4, 0.6
# So many trials find a pose with 10 % of the matches in 95 % of cases, one with 8 % in 79 %.
_MAX_TRIALS = 3000
# At most so many photos are matched near a pose. They look at most so far apart from it (rad).
_MAX_NEAR, _NEAR = 10, 0.9
# The first rank is counted as this, so that one photo does not outweigh several that agree.
_FIRST_RANK = 3.0
# The best of several places fits by chance more easily than a single one. So its pose needs as many
# inliers as exempt others from the test of two halves, and must be more likely right than wrong.
_LEAST_INLIERS, _LEAST_PROBABILITY = 100, 0.5


def solve_photo(
    image: SeenImage,
    geometry: MapGeometry,
    options: LocalizeOptions,
    priors: Priors,
    timestamp: int | None = None,
) -> tuple[SeenImage, Solved]:
    """Find the pose of a single photo. If it is refused, try again with one place only.

    Returns:
        The image with the matches that were solved, and its pose or the first refusal.
    """
    solved = solve_instant([image], geometry, options, priors, timestamp)
    refusal, look, began = solved.answer.refusal, image.look, perf_counter()
    if refusal is None or look is None:
        return image, solved
    seconds = solved.answer.seconds
    place = look_at_one_place(look, refusal.reason, geometry, options, priors)
    if place is not None:
        again = replace(image, look=place)
        found = solve_instant([again], geometry, options, priors, timestamp)
        if _is_sure(found):
            image, solved = again, found
    seconds = {**seconds, "places": perf_counter() - began}
    return image, replace(solved, answer=replace(solved.answer, seconds=seconds))


def _is_sure(solved: Solved) -> bool:
    pose = solved.pose
    return (
        pose is not None
        and pose.num_inliers >= _LEAST_INLIERS
        and (pose.probability or 0.0) >= _LEAST_PROBABILITY
    )


def look_at_one_place(
    look: Look,
    reason: Reason,
    geometry: MapGeometry,
    options: LocalizeOptions,
    priors: Priors,
) -> Look | None:
    """Return what a refused single photo shows of its most promising place.

    Args:
        options: those of the query.

    Returns:
        The look with other matches, to be solved and judged like any look; None when no place
        promises more.
    """
    proposed = look.proposed
    if proposed is None or not _is_worth_it(look, reason, options):
        return None
    constraints = Constraints(geometry, priors)
    empty = MatchedView(look.camera, Pose.identity(), np.empty((0, 2)), np.empty((0, 3)))
    problem = Problem((empty,), (look.evidence.camera_source,), options, constraints)
    best: GeneralizedPose | None = None
    for photos in _places(proposed.photos, geometry):
        pose = _solved(problem, proposed, photos)
        if pose is not None and (best is None or pose.num_inliers > best.num_inliers):
            best = pose
    if best is None:
        return None
    weights, among = constraints.photo_weights, np.arange(len(geometry.centers))
    if options.photos is not None:
        among = proposed.photos  # a caller who named photos gets no others
    elif weights is not None:
        among = np.flatnonzero(weights > 0.0)
    near = _photos_near(best.rig_from_world, geometry, among)
    if len(near) == 0:
        return None
    proposed = proposed.matched_with(near, geometry)
    chosen = _rows_of(proposed, near)
    matches = _matches(proposed, chosen)
    return replace(
        look,
        evidence=replace(look.evidence, num_correspondences=len(chosen)),
        matches=matches,
        landmarks=proposed.pairs.landmarks[chosen],
        proposed=proposed,
    )


def _is_worth_it(look: Look, reason: Reason, options: LocalizeOptions) -> bool:
    """Tell whether a photo may be placed by fewer matches.

    Not a photo whose focal length is a guess, because it would fit too easily. Nor one whose caller
    asks for other thresholds than the default.
    """
    usual = PRESETS[DEFAULT_PRESET]
    return (
        reason in _TOO_FEW
        and look.evidence.camera_source is not CameraSource.GUESS
        and options.registration == usual
        and options.preset == DEFAULT_PRESET
    )


def _places(photos: NDArray[np.int64], geometry: MapGeometry) -> Iterator[NDArray[np.int64]]:
    """Yield groups of searched photos that look at about the same, those of better rank first."""
    viewpoints = geometry.viewpoints.of(photos)
    apart = np.stack([viewpoints.apart_from(viewpoints.pose(row)) for row in range(len(photos))])
    votes = 1.0 / (np.arange(len(photos)) + _FIRST_RANK)
    left = np.ones(len(photos), dtype=np.bool_)
    for _ in range(_MAX_PLACES):
        if not left.any():
            return
        together = (apart <= _SAME_PLACE) & left
        of_place = together[np.argmax(np.where(left, together @ votes, 0.0))]
        yield photos[of_place]
        left &= ~of_place


def _solved(
    problem: Problem, proposed: Proposed, photos: NDArray[np.int64]
) -> GeneralizedPose | None:
    """Return the pose that the matches of some photos support; None when they are too few."""
    matches = _matches(proposed, _rows_of(proposed, photos))
    view = replace(problem.views[0], pixels=matches.pixels, points=matches.points)
    threshold = problem.registration.max_error_px
    starts = search_with_pycolmap(
        [view], max_error_px=threshold, seed=problem.options.seed, max_trials=_MAX_TRIALS
    )
    if not starts:
        return None
    pose = refine_generalized_pose([view], starts[0], max_error_px=threshold)
    gates = (enough_inliers, enough_of_the_matches)
    if pose is None or first_refusal(gates, problem.of([view]), pose) is not None:
        return None
    return pose


def _photos_near(pose: Pose, geometry: MapGeometry, among: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return those photos that look at about what a camera at a pose sees, nearest first."""
    apart = geometry.viewpoints.of(among).apart_from(pose)
    nearest = np.argsort(apart, kind="stable")[:_MAX_NEAR]
    return among[nearest[apart[nearest] <= _NEAR]]


def _rows_of(proposed: Proposed, photos: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return the pairs that some photos propose, conflicts settled by votes in their order."""
    order = np.full(int(max(proposed.photos.max(), photos.max())) + 1, -1)
    order[photos] = np.arange(len(photos))
    ranks = order[proposed.photos][proposed.pairs.ranks]
    rows = np.flatnonzero(ranks >= 0)
    return rows[replace(proposed.pairs.of(rows), ranks=ranks[rows]).settled_rows()]


def _matches(proposed: Proposed, rows: NDArray[np.intp]) -> Matches:
    pixels = proposed.shown.keypoints[proposed.pairs.keypoints[rows]]
    return Matches(pixels.astype(np.float64), proposed.points[rows].astype(np.float64))
