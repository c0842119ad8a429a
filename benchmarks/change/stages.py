"""Tells at which stage a map loses a photo whose pose is known."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.trust.outcomes import Query
from visloc.evaluation import Threshold, pose_error
from visloc.features import GlobalDescriptor, make_global_descriptor
from visloc.features.local.readymade import is_ready_made
from visloc.geometry import Pose
from visloc.localization.acceptance.gates import Problem
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import Constraints
from visloc.localization.query.feature_cache import FeatureCache
from visloc.localization.solving import Look
from visloc.options import LocalizeOptions
from visloc.pose.generalized import GeneralizedPose, refine_generalized_pose
from visloc.pose.motion import moved_origin, position_covariance
from visloc.pose.reprojection import MatchedView, project
from visloc.priors import NO_PRIORS
from visloc.retrieval.index import retrieve
from visloc.types import Localized

OPTIONS = LocalizeOptions()
# A mapping photo shows the place when the true camera sees this share of its landmarks, from about
# the same side. Of a route whose photos have numbers, when its number is so near.
_SHARED, _MAX_ANGLE = 0.2, np.radians(40.0)
NEAR_NUMBERS = 3
# Refining from the truth begins with a wide threshold, since the truth has errors of its own.
_WIDENED = (4.0, 2.0, 1.0)
STAGES = ("right", "retrieval", "matching", "pose", "gate", "wrong")


@dataclass(frozen=True, slots=True)
class Staged:
    """What a map did with one query.

    Attributes:
        condition: what was done to the photo.
        map_id: the map that was asked.
        photo: its name.
        lost: ``right``; or the stage that lost it; or ``wrong`` for an answer that is not right.
        reason: the reason of the refusal; None for an answer.
        ranks: by global descriptor, and fused: the rank of the first photo that shows the place,
            from 1; 0 when none does.
        retrieved: of the photos that were searched, how many show the place.
        matches: that were given to the solver.
        supported: of these, inliers of the best right pose that could be found with the truth.
        inliers: of the pose that was found.
        turned: degrees by which the photo was turned before it was answered.
        error: distance to the truth, units of the map; None without a pose.
        error_deg: as above, degrees.
        distance2: that distance squared in units of the stated covariance of the position.
        probability: what the answer stated; None for a refusal.
        seconds: until the answer.
    """

    condition: str
    map_id: str
    photo: str
    lost: str
    reason: str | None
    ranks: Mapping[str, int]
    retrieved: int
    matches: int
    supported: int
    inliers: int
    turned: int
    error: float | None
    error_deg: float | None
    distance2: float | None
    probability: float | None
    seconds: float


class Staging:
    """Asks one map, and compares what it did at each stage with the truth."""

    def __init__(self, localizer: Localizer) -> None:
        self.localizer = localizer
        opened = localizer.map
        self._descriptors: dict[str, GlobalDescriptor] = {
            record.fingerprint.name: make_global_descriptor(record.fingerprint.name)
            for record in opened.manifest.global_features
            if not is_ready_made(record.fingerprint.name)
        }
        self._numbers = [_number(image.name) for image in opened.images]

    def ask(self, query: Query, condition: str, *, by_number: bool = False) -> Staged:
        """Ask the map about a photo whose pose is known.

        Args:
            query: of one photo with a truth.
            condition: for the row.
            by_number: whether photos of the place are those of nearby numbers.
        """
        (only,), truth, within = query.photos, query.truth, query.within
        assert truth is not None
        assert within is not None
        cache: FeatureCache = {}
        look = self.localizer.look(only.photo, only.camera, OPTIONS, cache=cache)
        local_truth = moved_origin(truth, -self.localizer.geometry.origin)
        if by_number:
            showing = self._of_nearby_numbers(_number(query.name))
        else:
            showing = self._showing(look, local_truth)
        rows = {image.name: row for row, image in enumerate(self.localizer.map.images)}
        searched = np.array([rows[each.name] for each in look.evidence.retrieved], np.int64)
        problem = self._problem(look)
        supported = self._supported(look, problem, local_truth, showing, within)
        found = problem.solve() if len(look.matches.pixels) else None
        answer = self.localizer.localize(only.photo, only.camera, OPTIONS, cache=cache)
        accepted = isinstance(answer, Localized)
        error = pose_error(answer.cam_from_world, truth) if isinstance(answer, Localized) else None
        needed = problem.registration.min_inliers
        if error is not None:
            lost = "right" if _is_within(error, within) else "wrong"
        elif not showing[searched].any():
            lost = "retrieval"
        elif supported < needed:
            lost = "matching"
        elif found is None or not _is_within(pose_error(found.rig_from_world, local_truth), within):
            lost = "pose"
        else:
            lost = "gate"
        return Staged(
            condition,
            query.map_id,
            query.name,
            lost,
            None if isinstance(answer, Localized) else str(answer.reason),
            self._ranks(look, cache, showing),
            int(showing[searched].sum()),
            len(look.matches.pixels),
            supported,
            0 if found is None else found.num_inliers,
            answer.evidence.turned,
            None if error is None else error[0],
            None if error is None else error[1],
            _distance2(answer, truth) if isinstance(answer, Localized) else None,
            answer.probability if isinstance(answer, Localized) else None,
            sum(answer.evidence.seconds.values()) if accepted else 0.0,
        )

    def _of_nearby_numbers(self, number: int | None) -> NDArray[np.bool_]:
        near = [
            n is not None and number is not None and abs(n - number) <= NEAR_NUMBERS
            for n in self._numbers
        ]
        return np.array(near, dtype=np.bool_)

    def _showing(self, look: Look, truth: Pose) -> NDArray[np.bool_]:
        """Tell which mapping photos share landmarks with the true view."""
        geometry, camera = self.localizer.geometry, look.camera
        showing = np.zeros(len(self._numbers), dtype=np.bool_)
        for row in range(len(showing)):
            landmarks, _ = geometry.observed(row)
            points = geometry.points(landmarks[:: max(1, len(landmarks) // 300)]).astype(float)
            if len(points) == 0:
                continue
            in_cam = truth.apply(points)
            x, y = project(camera, in_cam).T
            ours, theirs = points - truth.center, points - geometry.centers[row]
            cosines = np.sum(ours * theirs, axis=1) / np.maximum(
                np.linalg.norm(ours, axis=1) * np.linalg.norm(theirs, axis=1), 1e-9
            )
            seen = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            seen &= (in_cam[:, 2] > 0) & (cosines >= np.cos(_MAX_ANGLE))
            showing[row] = seen.mean() >= _SHARED
        return showing

    def _problem(self, look: Look) -> Problem:
        view = MatchedView(look.camera, Pose.identity(), look.matches.pixels, look.matches.points)
        constraints = Constraints(self.localizer.geometry, NO_PRIORS)
        return Problem((view,), (look.evidence.camera_source,), OPTIONS, constraints)

    def _supported(
        self,
        look: Look,
        problem: Problem,
        truth: Pose,
        showing: NDArray[np.bool_],
        within: Threshold,
    ) -> int:
        """Count the matches that support a right pose, found with help of the truth.

        Refined from the truth, and from what the photos that show the place agree on.
        """
        threshold = problem.registration.max_error_px
        candidates: list[GeneralizedPose | None] = []
        pose = truth
        for times in _WIDENED:
            found = refine_generalized_pose(problem.views, pose, max_error_px=times * threshold)
            pose = pose if found is None else found.rig_from_world
        candidates.append(found)
        if look.proposed is not None:
            pairs = look.proposed.pairs
            rows = np.flatnonzero(showing[look.proposed.photos][pairs.ranks])
            chosen = rows[pairs.of(rows).settled_rows()] if len(rows) else rows
            view = replace(
                problem.views[0],
                pixels=look.proposed.shown.keypoints[pairs.keypoints[chosen]].astype(np.float64),
                points=look.proposed.points[chosen].astype(np.float64),
            )
            start = problem.of([view]).solve() if len(chosen) >= 4 else None
            if start is not None:
                candidates.append(
                    refine_generalized_pose(
                        problem.views, start.rig_from_world, max_error_px=threshold
                    )
                )
        right = [
            each.num_inliers
            for each in candidates
            if each is not None and _is_within(pose_error(each.rig_from_world, truth), within)
        ]
        return max(right, default=0)

    def _ranks(self, look: Look, cache: FeatureCache, showing: NDArray[np.bool_]) -> dict[str, int]:
        """Return the rank of the first photo that shows the place, by descriptor and fused."""
        opened = self.localizer.map
        found = next(iter(cache.values()))
        local = found.local.reduced(look.reduced)
        query = {
            name: descriptor.describe(found.rgb, local, opened.global_models[name])
            for name, descriptor in self._descriptors.items()
        }
        index = {name: opened.global_descriptors[name] for name in query}
        num = len(showing)
        ranked = {
            name: retrieve({name: row}, {name: index[name]}, num).images
            for name, row in query.items()
        }
        fused = retrieve(query, index, num, fusion=opened.fusion).images
        return {name: _first(showing[rows]) for name, rows in {**ranked, "fused": fused}.items()}


def _distance2(answer: Localized, truth: Pose) -> float:
    """Square the distance of an answer from the truth, in units of its stated covariance."""
    covariance = position_covariance(answer.cam_from_world, answer.covariance)
    error = answer.cam_from_world.center - truth.center
    return float(error @ np.linalg.solve(covariance, error))


def _first(shown: NDArray[np.bool_]) -> int:
    return int(shown.argmax()) + 1 if shown.any() else 0


def _is_within(error: tuple[float, float], within: Threshold) -> bool:
    return error[0] <= within.max_position_error_m and error[1] <= within.max_orientation_error_deg


def _number(name: str) -> int | None:
    """Return the last number of a photo's name."""
    digits = re.findall(r"\d+", name.rsplit(".", 1)[0])
    return int(digits[-1]) if digits else None
