"""Landmarks that a doubtful pose predicts, looked for where they should be.

In the dark, few keypoints look more like their landmark than like all others of the photo. Among
the handful of keypoints near the pixel where a pose predicts the landmark, many do. So poses that
too few matches support are tried: that of all matches, and those of each searched place with its
own matches alone. Matches by chance spread evenly over the disc in which a landmark is looked for;
right ones lie in its middle. How far the middle is fuller than by chance tells whether a pose is
right (docs/decisions/0039-guided-by-a-doubtful-pose.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from visloc.geometry import Camera, Pose
from visloc.localization.constraints import MapGeometry
from visloc.localization.evidence import Shown, best_products, expected_landmarks
from visloc.localization.gates import Problem
from visloc.localization.rivals import Proposed, score
from visloc.options import DEFAULT_PRESET, PRESETS
from visloc.pose.generalized import GeneralizedPose, refine_generalized_pose
from visloc.pose.search import search_with_pycolmap
from visloc.pose.views import MatchedView
from visloc.types import Reason, Refusal

# Refusals of photos that have too few matches for their pose.
_TOO_FEW = (Reason.NO_POSE, Reason.TOO_FEW_INLIERS, Reason.LOW_INLIER_RATIO)
# A pose counts as right when its landmarks are found this many standard deviations more often than
# by chance. Of mapping photos that maps without them were asked about, wrong poses reach 7.8: those
# of prints (``python -m benchmarks.probability scores``).
SURE = 8.5
# Poses with less are not refined: those that turned out right had more.
_PROMISING = 2.0
_MAX_EXPECTED = 3000
_FEWEST = 20  # landmarks that are compared, and matches of a place
_NUM_KEYPOINTS = 8  # that may show a landmark
# A landmark counts as found when it is more similar than this share of others in its place.
_CHANCE = 0.95
# Places that are tried, photos of one place, and how far apart these look at most, in radians.
_MAX_PLACES, _MAX_PHOTOS, _SAME_PLACE = 4, 6, 0.6
# A pose that a tenth of the matches with its own photos supports is found with 86 % probability.
_MAX_TRIALS = 2000


@dataclass(frozen=True, slots=True, eq=False)
class Guided:
    """Landmarks that were found where a pose predicts them.

    Attributes:
        pixels: (n, 2) float64 of the keypoints, each at most once.
        points: (n, 3) float64 of the landmarks, relative to the map's origin.
        support: how many more than by chance, in standard deviations.
    """

    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    support: float


def is_worth_guiding(problem: Problem, refusal: Refusal) -> bool:
    """Tell whether a refused photo may be placed by what its pose predicts.

    Not a rig, nor a photo whose focal length is a guess: that would fit too easily. Who asks for
    other thresholds than the default gets these.
    """
    options = problem.options
    as_usual = PRESETS[DEFAULT_PRESET]
    return (
        refusal.reason in _TOO_FEW
        and len(problem.views) == 1
        and not problem.views[0].focal_unknown
        and len(problem.shown) == 1
        and problem.shown[0] is not None
        and options.preset == DEFAULT_PRESET
        and options.max_error_px is None
        and options.registration.min_inliers <= as_usual.min_inliers
        and options.registration.min_inlier_ratio <= as_usual.min_inlier_ratio
    )


def expected_pose(
    problem: Problem, proposed: Proposed, best: GeneralizedPose | None
) -> GeneralizedPose | None:
    """Return a pose at which the photo surely shows what the map has there; None without one.

    Args:
        problem: of one view, whose best pose was refused.
        proposed: of this view.
        best: that pose.

    Returns:
        A pose refined on the landmarks that it predicts; its inliers and covariance are those of
        the problem's matches.
    """
    (view,), max_error_px = problem.views, problem.registration.max_error_px
    for pose, support in tried_poses(problem, proposed, best):
        if support >= SURE:
            return refine_generalized_pose([view], pose, max_error_px=max_error_px)
    return None


def tried_poses(
    problem: Problem, proposed: Proposed, best: GeneralizedPose | None
) -> Iterator[tuple[Pose, float]]:
    """Yield doubtful poses, and how many more landmarks than by chance are where they predict them.

    In standard deviations, as ``Guided.support``; the arguments are those of ``expected_pose``.
    """
    (view,), geometry = problem.views, problem.constraints.geometry
    max_error_px = problem.registration.max_error_px
    tree = KDTree(proposed.shown.keypoints.astype(np.float64), balanced_tree=False)
    for start in _starts(problem, proposed, best):
        pose = start
        found = guided_matches(geometry, proposed.shown, tree, view.camera, pose, max_error_px)
        if found is None or found.support < _PROMISING:
            continue
        own = replace(view, pixels=found.pixels, points=found.points)
        refined = refine_generalized_pose([own], pose, max_error_px=max_error_px)
        if refined is not None:
            again = guided_matches(
                geometry, proposed.shown, tree, view.camera, refined.rig_from_world, max_error_px
            )
            if again is not None and again.support > found.support:
                found, pose = again, refined.rig_from_world
        yield pose, found.support


def guided_matches(
    geometry: MapGeometry,
    shown: Shown,
    tree: KDTree,
    camera: Camera,
    cam_from_world: Pose,
    max_error_px: float,
) -> Guided | None:
    """Look for the landmarks that a camera at a pose would see; None when there are too few.

    Args:
        geometry: of the map.
        shown: all that was found in the photo.
        tree: of its keypoints.
        camera: that took it.
        cam_from_world: the pose, relative to the map's origin.
        max_error_px: how far from its predicted pixel a landmark is looked for.
    """
    _, expected = expected_landmarks(geometry, camera, cam_from_world, _MAX_EXPECTED)
    if len(expected.pixels) < _FEWEST:
        return None
    distances, near = map(
        np.asarray,
        tree.query(
            expected.pixels, k=range(1, _NUM_KEYPOINTS + 2), distance_upper_bound=max_error_px
        ),
    )
    compared = np.flatnonzero(np.isfinite(distances[:, 0]))
    if len(compared) < _FEWEST:
        return None
    # Where more are near than are compared, these lie in the smaller disc up to the next one.
    radii = np.minimum(distances[compared, -1], max_error_px)
    distances, near = distances[:, :-1], near[:, :-1]
    distances, points = distances[compared], expected.points[compared]
    there = np.isfinite(distances)
    near = np.where(there, near[compared], 0)
    theirs = shown.descriptors.rows[near].astype(np.float32)
    ours = expected.descriptors[compared].astype(np.float32)
    products = np.where(there, np.einsum("nkd,nd->nk", theirs, ours), -np.inf)
    # As similar would be any other landmark in its place.
    chance = best_products(theirs, np.roll(ours, len(ours) // 2, axis=0), there)
    column = products.argmax(axis=1)
    rows = np.arange(len(products))
    similarity, keypoints = products[rows, column], near[rows, column]
    order = np.argsort(-similarity, kind="stable")
    order = order[similarity[order] > np.quantile(chance, _CHANCE)]
    _, first = np.unique(keypoints[order], return_index=True)  # of each keypoint, the most similar
    chosen = order[first]
    scores = score(distances[rows, column][chosen] / radii[chosen])
    support = float(scores.sum() / max(np.sqrt(np.sum(scores * scores)), 1.0))
    pixels = shown.keypoints[keypoints[chosen]].astype(np.float64)
    return Guided(pixels, points[chosen], support)


def _starts(problem: Problem, proposed: Proposed, best: GeneralizedPose | None) -> Iterator[Pose]:
    """Yield the pose of all matches, and that of each searched place with its own matches."""
    if best is not None:
        yield best.rig_from_world
    (view,) = problem.views
    max_error_px, pairs = problem.registration.max_error_px, proposed.pairs
    for photos in _places(problem.constraints.geometry, proposed.photos):
        rows = np.flatnonzero(np.isin(proposed.photos, photos)[pairs.ranks])
        if len(rows) < _FEWEST:
            continue
        rows = rows[pairs.of(rows).settled_rows()]
        own = _view_of(view, proposed, rows)
        found = search_with_pycolmap(
            [own],
            max_error_px=max_error_px,
            seed=problem.options.seed,
            max_trials=_MAX_TRIALS,
        )
        refined = (
            refine_generalized_pose([own], found[0], max_error_px=max_error_px) if found else None
        )
        if refined is not None:
            yield refined.rig_from_world


def _view_of(view: MatchedView, proposed: Proposed, rows: NDArray[np.intp]) -> MatchedView:
    return replace(
        view,
        pixels=proposed.shown.keypoints[proposed.pairs.keypoints[rows]].astype(np.float64),
        points=proposed.points[rows].astype(np.float64),
    )


def _places(geometry: MapGeometry, photos: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Group photos, best first, with those that see about the same as the best that is left."""
    viewpoints, left = geometry.viewpoints, photos
    for _ in range(_MAX_PLACES):
        if len(left) == 0:
            return
        near = viewpoints.apart_from(viewpoints.pose(int(left[0])))[left] <= _SAME_PLACE
        near[0] = True
        yield left[near][:_MAX_PHOTOS]
        left = left[~near]
