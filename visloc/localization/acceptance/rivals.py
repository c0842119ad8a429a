"""A second place that explains an instant nearly as well as its best pose does.

RANSAC over all matches returns the pose with the most inliers. If two places look alike, that is a
coin toss: a door has more inliers than its twin because more photos were taken of it. So the
searched photos that the best pose leaves unexplained are solved again, place by place. Then both
poses are compared on equal terms: keypoint by keypoint, each place with the same number of its best
photos.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose, rotation_angle
from visloc.localization.acceptance.evidence import Shown
from visloc.localization.acceptance.gates import (
    GATES,
    Problem,
    contradicts_priors,
    enough_inliers,
    enough_of_the_matches,
    first_refusal,
)
from visloc.localization.acceptance.preference import SURE, preference
from visloc.localization.map_view.constraints import MapGeometry
from visloc.matching.correspondences import Proposals, propose_landmarks
from visloc.matching.products import round_descriptors
from visloc.pose.generalized import GeneralizedPose, refine_generalized_pose
from visloc.pose.motion import largest_std, moved_origin
from visloc.pose.reprojection import MatchedView, reprojection_errors
from visloc.pose.search import MAX_TRIALS, search_with_pycolmap
from visloc.types import Candidate, LocalFeatures, Reason, Refusal

# So many photos of each place are compared.
NUM_COMPARED = 5
# At most so many other places are solved for, those with the most unexplained matches first.
_MAX_PLACES = 4
# The photo that speaks most for the best place is the measure. A photo shows another place if its
# score is below the first share of that, and if it has unexplained matches that are as similar, at
# least the second share of the measure's agreeing matches.
_OF_THE_PLACE, _LEAST_SHARE = 0.25, 0.5
# Photos are of one place if they are nearer to each other than this share of their reach.
_PLACE_REACH_SHARE = 0.5
# Poses of two places differ by more than this (share of the reach, angle) plus three deviations.
_APART_REACH_SHARE, _APART_ANGLE, _STDS = 0.2, math.radians(10.0), 3.0
# If the best pose is more likely right than this, a rival must pass the gates on its own. For a
# search always finds some place that explains a little more than chance.
_MORE_LIKELY_RIGHT = 0.5
# Probability of missing a pose with half the best one's share of inliers; fewest trials.
_MISSED, _MIN_TRIALS = 0.01, 100
# Matches by chance spread evenly over the disc of the inlier threshold; right ones lie in its
# middle. A match within this share of the radius counts for a pose ...
_MIDDLE = 1 / 3
# ... and one in the ring around it counts against it, so that chance adds nothing on average.
_RING_WEIGHT = -(_MIDDLE**2) / (1.0 - _MIDDLE**2)


@dataclass(frozen=True, slots=True, eq=False)
class Proposed:
    """Pairs that the searched photos proposed for one image, before conflicts were settled.

    Attributes:
        shown: all keypoints of the image.
        pairs: of keypoints and landmarks; ranks are rows of ``photos``.
        points: (n, 3) float32 landmarks of the pairs, relative to the map's origin.
        photos: (r,) int64 rows of the map's photos.
        ratio: with which the pairs were tested; None when they were not.
    """

    shown: Shown
    pairs: Proposals
    points: NDArray[np.float32]
    photos: NDArray[np.int64]
    ratio: float | None = None

    @staticmethod
    def none(features: LocalFeatures) -> Proposed:
        """Return no proposals, for a photo without features."""
        shown = Shown(features.keypoints, round_descriptors(features.descriptors))
        return Proposed(
            shown, Proposals.none(), np.empty((0, 3), np.float32), np.empty(0, np.int64)
        )

    def matched_with(self, photos: NDArray[np.int64], geometry: MapGeometry) -> Proposed:
        """Add the pairs that further photos propose.

        They are matched as the others were, with one exception. LightGlue's network is not passed
        from process to process, so its photos are matched by mutual nearest neighbours.
        """
        further = photos[~np.isin(photos, self.photos)]
        found = propose_landmarks(
            self.shown.descriptors, [geometry.observed(photo) for photo in further], self.ratio
        )
        return replace(
            self,
            pairs=self.pairs.followed_by(found, len(self.photos)),
            points=np.concatenate([self.points, geometry.points(found.landmarks)]),
            photos=np.concatenate([self.photos, further]),
        )


def score(errors: NDArray[np.floating]) -> NDArray[np.float64]:
    """Say how much each keypoint (k,) speaks for a pose.

    Args:
        errors: (k,) reprojection errors in units of the inlier threshold; infinity where the place
            has no match.
    """
    inside = np.where(errors <= _MIDDLE, 1.0, _RING_WEIGHT)
    return np.where(errors <= 1.0, inside, 0.0)


class _Pairs:
    """All proposed pairs of an instant's images in one table; keypoints of all images counted on.

    Args:
        problem: its views are those of the images; those without matches, as of a camera that was
            left out, have no pairs.
        best: the focal length that was found with it counts.
    """

    def __init__(
        self, problem: Problem, proposed: Sequence[Proposed], best: GeneralizedPose
    ) -> None:
        proposed = [
            each if len(view) else replace(each, pairs=Proposals.none(), points=each.points[:0])
            for view, each in zip(problem.views, proposed, strict=True)
        ]
        self._problem, self._proposed = problem, proposed
        self._views = [
            replace(
                view,
                camera=best.camera or view.camera,
                pixels=each.shown.keypoints[each.pairs.keypoints].astype(np.float64),
                points=each.points.astype(np.float64),
                focal_unknown=False,
            )
            for view, each in zip(problem.views, proposed, strict=True)
        ]
        starts = np.cumsum([0, *(len(each.shown.keypoints) for each in proposed)])
        self.num_keypoints = int(starts[-1])
        self.keypoints = np.concatenate(
            [each.pairs.keypoints + start for each, start in zip(proposed, starts, strict=False)]
        )
        self.photos = np.concatenate([each.photos[each.pairs.ranks] for each in proposed])
        self.similarities = np.concatenate([each.pairs.similarities for each in proposed])
        self.all_photos, self._photo = np.unique(self.photos, return_inverse=True)
        self._image = np.repeat(np.arange(len(proposed)), [len(e.points) for e in proposed])

    def errors(self, pose: Pose) -> NDArray[np.float64]:
        """Return each pair's reprojection error in units of the inlier threshold."""
        threshold = self._problem.registration.max_error_px
        errors = np.concatenate([reprojection_errors(view, pose) for view in self._views])
        return np.where(np.isnan(errors), np.inf, errors / threshold)

    def showing(self, errors: NDArray[np.float64], photos: NDArray[np.int64]) -> NDArray[np.int64]:
        """Sort photos by how much their pairs speak for a pose, most first."""
        scores = np.bincount(self._photo, score(errors), minlength=len(self.all_photos))
        of_photos = scores[np.searchsorted(self.all_photos, photos)]
        return photos[np.argsort(-of_photos, kind="stable")]

    def showing_by_image(
        self, errors: NDArray[np.float64], photos: NDArray[np.int64]
    ) -> list[NDArray[np.int64]]:
        """Sort photos as ``showing``, by the pairs of each image that speaks for the pose at all.

        Cameras of a rig that look apart are shown by different photos.
        """
        num = len(self.all_photos)
        rows = np.searchsorted(self.all_photos, photos)
        sorted_photos = []
        for image in range(len(self._proposed)):
            scores = np.where(self._image == image, score(errors), 0.0)
            of_photos = np.bincount(self._photo, scores, minlength=num)[rows]
            if of_photos.max(initial=0.0) > 0.0:
                sorted_photos.append(photos[np.argsort(-of_photos, kind="stable")])
        return sorted_photos or [self.showing(errors, photos)]

    def places_elsewhere(
        self, errors: NDArray[np.float64], geometry: MapGeometry
    ) -> Iterator[NDArray[np.int64]]:
        """Yield the photos of other places that may explain the images about as well.

        A photo shows another place when few of its pairs agree with the best pose and about as
        many others are as similar as those that do agree elsewhere.
        """
        explained = errors <= 1.0
        strong = self.similarities >= np.median(self.similarities[explained])
        num = len(self.all_photos)
        agreeing = np.bincount(self._photo[strong & explained], minlength=num)
        unexplained = np.bincount(self._photo[strong & ~explained], minlength=num)
        scores = np.bincount(self._photo, score(errors), minlength=num)
        elsewhere = np.flatnonzero(scores < _OF_THE_PLACE * scores.max())
        elsewhere = elsewhere[elsewhere != scores.argmax()]  # where hardly anything speaks for it
        left = elsewhere[np.argsort(-unexplained[elsewhere], kind="stable")]
        for _ in range(_MAX_PLACES):
            if len(left) == 0 or unexplained[left[0]] < _LEAST_SHARE * agreeing.max():
                return
            centers = geometry.centers[self.all_photos[left]]
            near = (
                np.linalg.norm(centers - centers[0], axis=1) <= _PLACE_REACH_SHARE * geometry.reach
            )
            yield self.all_photos[left[near]]
            left = left[~near]

    def solve(self, photos: NDArray[np.int64], best: GeneralizedPose) -> GeneralizedPose | None:
        """Find the pose that the pairs of some photos agree on best.

        The search stops where a pose with half the best one's share of inliers is found surely.
        """
        views = self.views(photos)
        num = sum(map(len, views))
        ratio = 0.5 * best.num_inliers / max(self._problem.num_matches, 1)
        trials = math.ceil(math.log(_MISSED) / math.log1p(-(ratio**3)))
        threshold = self._problem.registration.max_error_px
        starts = search_with_pycolmap(
            views,
            max_error_px=threshold,
            seed=self._problem.options.seed,
            max_trials=min(max(trials, _MIN_TRIALS), MAX_TRIALS),
        )
        if num == 0 or not starts:
            return None
        return refine_generalized_pose(views, starts[0], max_error_px=threshold)

    def refined(self, problem: Problem, other: GeneralizedPose) -> GeneralizedPose | None:
        """Refine the pose of another place on all matches of the problem."""
        views = [
            replace(view, camera=known.camera)
            for view, known in zip(problem.views, self._views, strict=True)
        ]
        threshold = problem.registration.max_error_px
        return refine_generalized_pose(views, other.rig_from_world, max_error_px=threshold)

    def by_keypoint(
        self, errors: NDArray[np.float64], photos: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the error of each keypoint's most similar landmark in some photos.

        Infinity for a keypoint without a landmark there.
        """
        rows = np.flatnonzero(np.isin(self.photos, photos))
        rows = rows[np.argsort(self.similarities[rows], kind="stable")]
        found = np.full(self.num_keypoints, np.inf)
        found[self.keypoints[rows]] = errors[rows]  # the last one counts, the most similar
        return found

    def scores(self, errors: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return how much each keypoint speaks for a pose, with the photos that show it best."""
        shown = self.showing(errors, self.all_photos)[:NUM_COMPARED]
        return score(self.by_keypoint(errors, shown)).astype(np.float32)

    def views(self, photos: NDArray[np.int64]) -> list[MatchedView]:
        """Return the views with the pairs of some photos, conflicts settled."""
        views = []
        for view, each in zip(self._views, self._proposed, strict=True):
            rows = np.flatnonzero(np.isin(each.photos, photos)[each.pairs.ranks])
            views.append(view.selected(rows[each.pairs.of(rows).settled_rows()]))
        return views


def stronger_place(
    problem: Problem,
    geometry: MapGeometry,
    proposed: Sequence[Proposed],
    best: GeneralizedPose,
) -> tuple[GeneralizedPose, Refusal | None, NDArray[np.float32]]:
    """Compare the best pose with those of other places, and let the photo's evidence decide.

    Another place counts when its pose differs from the best one by more than their uncertainty.
    The difference of the scores (``score``) of all keypoints, over its standard deviation, tells
    which place is right; a keypoint that both places explain equally well tells nothing.

    Returns:
        The pose of the place that explains the photo better, and no refusal; or ``best`` and a
        refusal, ``ambiguous``. The scores (k,) of all keypoints in the place of that pose.
    """
    pairs = _Pairs(problem, proposed, best)
    errors = pairs.errors(best.rig_from_world)
    for photos in pairs.places_elsewhere(errors, geometry):
        other = pairs.solve(photos, best)
        if other is None or not _is_rival(problem, best, other, geometry.reach):
            continue
        verdict, compared = _compared(problem, geometry, proposed, best, other, photos)
        if verdict >= SURE:
            continue
        if verdict <= -SURE:
            found = pairs.refined(problem, other)
            if found is not None and first_refusal(GATES, problem, found) is None:
                errors = pairs.errors(found.rig_from_world)
                return found, None, pairs.scores(errors)
        first, second = (_described(*each, geometry) for each in compared)
        refusal = Refusal(
            "gate",
            Reason.AMBIGUOUS,
            f"two places of {geometry.ref} explain the photo about equally well: {first}, and "
            f"{second}; send priors that exclude one of them, or a photo with more of the scene",
            _candidates(compared, verdict, geometry),
        )
        return best, refusal, pairs.scores(errors)
    return best, None, pairs.scores(errors)


def _compared(
    problem: Problem,
    geometry: MapGeometry,
    proposed: Sequence[Proposed],
    best: GeneralizedPose,
    other: GeneralizedPose,
    photos: NDArray[np.int64],
) -> tuple[float, list[tuple[GeneralizedPose, int, int]]]:
    """Compare two poses on equal terms: each with as many photos, those that show it best.

    Few photos of a place may have been searched. So photos taken next to the one that shows it best
    are matched too; for a rig, next to the one that shows it best to each camera.

    Args:
        photos: of the other place, among those that were searched.

    Returns:
        ``preference`` for the best pose, infinite where the other pose is no rival: it explains
        no more than chance, or too little for an answer while the best pose is likely. Of each
        pose its inliers and the photo that shows it best.
    """
    pairs = _Pairs(problem, proposed, best)
    seeds = pairs.showing_by_image(pairs.errors(other.rig_from_world), photos)
    here = np.setdiff1d(pairs.all_photos, photos)
    shown_best = pairs.showing_by_image(pairs.errors(best.rig_from_world), here)
    most = NUM_COMPARED * max(len(seeds), len(shown_best))
    theirs = _in_turn([geometry.nearest_photos(seed[0], NUM_COMPARED + 1) for seed in seeds])
    # In a small map even the photos that show the best place best are among the nearest.
    theirs = theirs[~np.isin(theirs, [each[0] for each in shown_best])][:most]
    beside = [geometry.nearest_photos(each[0], NUM_COMPARED) for each in shown_best]
    # One camera of a rig may not have searched a photo that another one found.
    further = _in_turn([theirs, *beside, *(each[:NUM_COMPARED] for each in shown_best)])
    pairs = _Pairs(problem, [each.matched_with(further, geometry) for each in proposed], best)
    here = np.setdiff1d(pairs.all_photos, np.concatenate([photos, theirs]))
    own = _in_turn(pairs.showing_by_image(pairs.errors(best.rig_from_world), here))[:most]
    views, threshold = pairs.views(theirs), problem.registration.max_error_px
    again = refine_generalized_pose(views, other.rig_from_world, max_error_px=threshold) or other
    scores, compared = [], []
    for pose, shown in ((best, own), (again, theirs[: len(own)])):
        errors = pairs.by_keypoint(pairs.errors(pose.rig_from_world), shown)
        scores.append(score(errors))
        compared.append((pose, int((errors <= 1.0).sum()), int(shown[0])))
    first, second = scores
    refusal = first_refusal((enough_inliers, enough_of_the_matches), problem.of(views), again)
    is_no_answer = refusal is not None and (best.probability or 0.0) >= _MORE_LIKELY_RIGHT
    if is_no_answer or preference(second, np.zeros_like(second)) < SURE:
        return math.inf, compared
    return preference(first, second), compared


def _in_turn(lists: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Take the first of each list, then the second of each, and so on, each photo once."""
    in_turn = itertools.chain.from_iterable(itertools.zip_longest(*lists))
    return np.array([photo for photo in dict.fromkeys(in_turn) if photo is not None], np.int64)


def _is_rival(
    problem: Problem, best: GeneralizedPose, other: GeneralizedPose, reach: float
) -> bool:
    """Tell whether a pose lies elsewhere, and where the priors allow it."""
    if best.covariance is None or other.covariance is None:
        return False  # without an uncertainty, nothing says that they differ
    a, b = best.rig_from_world, other.rig_from_world
    # The photo's part alone: both poses share the errors of one map, and the wider whole would take
    # a twin next door for the same place.
    std = math.hypot(largest_std(a, best.covariance), largest_std(b, other.covariance))
    away = float(np.linalg.norm(a.center - b.center))
    turned = rotation_angle(a.rotation @ b.rotation.T)
    if away <= _APART_REACH_SHARE * reach + _STDS * std and turned <= _APART_ANGLE:
        return False
    whole = problem.constraints.errors.whole(b, other.covariance, other.of_camera)
    return contradicts_priors(problem.constraints, b, whole) is None


def _candidates(
    compared: Sequence[tuple[GeneralizedPose, int, int]], verdict: float, geometry: MapGeometry
) -> tuple[Candidate, ...]:
    """State both places that were compared, most inliers first."""
    candidates = [
        Candidate(
            moved_origin(pose.rig_from_world, geometry.origin),
            num,
            geometry.ref,
            image=geometry.photo_name(photo),
            preference=preference_for,
        )
        for (pose, num, photo), preference_for in zip(
            compared, (verdict, 0.0 - verdict), strict=True
        )
    ]
    return tuple(sorted(candidates, key=lambda each: -each.num_inliers))


def _described(pose: GeneralizedPose, num: int, photo: int, geometry: MapGeometry) -> str:
    x, y, z = pose.rig_from_world.center + geometry.origin
    return f"({x:.2f}, {y:.2f}, {z:.2f}) with {num} inliers in {geometry.photo_name(photo)}"
