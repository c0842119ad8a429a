"""A map's own photos, each localized in the map without itself and its nearest neighbours.

The errors that this shows are stored in the map (docs/map-format.md) and widen every answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mapping.cluster.executors import Executor
from mapping.cluster.workers import THIS_PROCESS
from mapping.frames.stored_queries import solve_stored
from mapping.own_test.error_model import fitted_factor, mahalanobis2
from mapping.own_test.held_out import match_held_out, spread_photos, taken_with
from mapping.progress import ItemProgress, not_told
from visloc.archive import Map, open_map
from visloc.archive.schema import MAX_FACTOR, MAX_WRONG_SCORES, OwnTest, Score
from visloc.geometry import Pose, center_covariance
from visloc.localization.acceptance.judge import TIE_ANGLE, TIE_REACH_SHARE
from visloc.localization.map_view.constraints import MapGeometry, Viewpoints
from visloc.options import LocalizeOptions
from visloc.pose.motion import PHOTO_ONLY

# How many photos are tried: a fifth of the map, within these limits. The test then takes a tenth of
# the time of a build (docs/decisions/0028-the-maps-own-test.md).
_LEAST_PHOTOS, _SHARE_OF_PHOTOS, _MOST_PHOTOS = 12, 5, 60
# The usual distance of a query from the nearest mapping photo, by ``Viewpoints.apart_from`` (rad).
_LEFT_OUT_WITHIN = 0.2
# Fewer than online, which takes 20: the last ones add little, and each costs as much.
_PHOTOS_ASKED = 8
# As many keypoints as a query has. Stored photos may have more, which would make a trial's own
# scatter smaller than a query's.
_MOST_KEYPOINTS = 2500
# Photos whose poses were estimated together with the landmarks fit them better than a query does.
# The factor was measured on a painted room, built with its exact poses and without
# (docs/decisions/0028-the-maps-own-test.md).
_FLATTERED = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One photo, localized.

    Attributes:
        error: (6,) rotation (rad) then centre, in the camera's axes, estimated minus true.
        photo_covariance: (6, 6) of it, as far as the photo's own measurements tell.
    """

    error: NDArray[np.float64]
    photo_covariance: NDArray[np.float64]
    score: Score


@dataclass(frozen=True, slots=True)
class OwnTestRun:
    """The own test of a map, photo by photo.

    Attributes:
        wrong: rows of the photos that were localized at another place.
        refused: rows of those that got no pose.
    """

    test: OwnTest
    wrong: tuple[int, ...] = ()
    refused: tuple[int, ...] = ()


def own_test(opened: Map) -> OwnTest:
    """Test a map; see ``run_own_test``."""
    return run_own_test(opened).test


def run_own_test(
    opened: Map, progress: ItemProgress = not_told, workers: Executor = THIS_PROCESS
) -> OwnTestRun:
    """Test a map with what it stores of its own photos.

    The photos are spread evenly and every random choice has a seed, so that equal maps have equal
    tests.
    """
    geometry = MapGeometry(opened)
    geometry.errors = PHOTO_ONLY  # they are what is learned, with cameras as they are
    most = min(max(_LEAST_PHOTOS, len(opened.images) // _SHARE_OF_PHOTOS), _MOST_PHOTOS)
    images = spread_photos(len(opened.images), most)
    asked = [
        (image, left_out)
        for image in images
        if (left_out := left_out_with(opened, geometry.viewpoints, image)) is not None
    ]
    tried = workers.run_here(_Trials(geometry), asked, progress)
    found = [(image, trial) for (image, _), trial in zip(asked, tried, strict=True)]
    refused = [image for image, trial in found if trial is None]
    localized = [image for image, trial in found if trial is not None]
    trials = [trial for _, trial in found if trial is not None]
    test = learned(trials, len(asked), geometry.reach, independent=_independent(opened))
    are_wrong = _are_wrong([trial.error for trial in trials], geometry.reach)
    wrong = [image for image, is_wrong in zip(localized, are_wrong, strict=True) if is_wrong]
    return OwnTestRun(test, tuple(wrong), tuple(refused))


def learned(trials: Sequence[Trial], tested: int, reach: float, *, independent: bool) -> OwnTest:
    """Learn the errors of a map from its trials.

    A pose that is off by more than a tenth of the photos' reach, or by five degrees, is at another
    place and counts as wrong. The factors are learned from the others.

    Args:
        reach: how far the map's photos see, units of the world.
        independent: whether the photos' poses came from elsewhere than the map's landmarks.
    """
    errors = np.array([trial.error for trial in trials]).reshape(-1, 6)
    covariances = np.array([trial.photo_covariance for trial in trials]).reshape(-1, 6, 6)
    wrong = _are_wrong(errors, reach)
    errors, covariances = errors[~wrong], covariances[~wrong]
    scores = [trial.score for trial, is_wrong in zip(trials, wrong, strict=True) if is_wrong]
    scores.sort(key=lambda score: (-score.inliers, -score.inlier_ratio))
    return OwnTest(
        tested=tested,
        localized=len(trials),
        wrong=len(scores),
        position_factor=_factor(errors[:, 3:], covariances[:, 3:, 3:], independent),
        orientation_factor=_factor(errors[:, :3], covariances[:, :3, :3], independent),
        independent=independent,
        wrong_at=tuple(scores[:MAX_WRONG_SCORES]),
    )


def _are_wrong(errors: ArrayLike, reach: float) -> NDArray[np.bool_]:
    """Tell which errors (n, 6) are of poses at another place."""
    both = np.asarray(errors, dtype=np.float64).reshape(-1, 6)
    turned, moved = np.linalg.norm(both[:, :3], axis=1), np.linalg.norm(both[:, 3:], axis=1)
    return np.asarray((turned > TIE_ANGLE) | (moved > TIE_REACH_SHARE * reach))


def _factor(
    errors: NDArray[np.float64], covariances: NDArray[np.float64], independent: bool
) -> float:
    factor = fitted_factor(mahalanobis2(errors, covariances))
    if not independent:
        factor = min(_FLATTERED * factor, MAX_FACTOR)
    # Two digits, so that last bits, which differ between machines, do not change the map.
    return round(factor, 2)


def left_out_with(opened: Map, viewpoints: Viewpoints, image: int) -> NDArray[np.int64] | None:
    """Return the photos (k,) to leave out with one, and itself; None when nothing would remain."""
    apart = viewpoints.apart_from(viewpoints.pose(image))
    left_out = np.flatnonzero(taken_with(opened, image) | (apart < _LEFT_OUT_WITHIN))
    if len(left_out) == len(opened.images):
        left_out = np.flatnonzero(taken_with(opened, image))
    return left_out if len(left_out) < len(opened.images) else None


class _Trials:
    """A worker's part of the own test. Each process opens the map once."""

    def __init__(self, geometry: MapGeometry) -> None:
        self._geometry = geometry

    def __call__(self, asked: tuple[int, NDArray[np.int64]]) -> Trial | None:
        return _trial(self._geometry, *asked)

    def __reduce__(self) -> tuple[Callable[[Path, str], _Trials], tuple[Path, str]]:
        opened = self._geometry.opened
        return _trials_of, (opened.path, opened.manifest.content_hash)


@lru_cache(maxsize=1)
def _trials_of(folder: Path, _content_hash: str) -> _Trials:
    return _Trials(MapGeometry(open_map(folder)))


def _trial(geometry: MapGeometry, image: int, left_out: NDArray[np.int64]) -> Trial | None:
    """Localize one photo in what the map would be without some; None when it is refused."""
    opened, viewpoints = geometry.opened, geometry.viewpoints
    options = LocalizeOptions(top_k=_PHOTOS_ASKED)
    num = len(opened.observations(image)[0])
    rows = np.random.default_rng(image).permutation(num)[:_MOST_KEYPOINTS]
    if not opened.has_landmarks:
        geometry = geometry.without(left_out)
    matched = match_held_out(geometry, image, left_out, options, np.sort(rows))
    solved = solve_stored(opened, image, geometry, matched, options)
    if solved.pose is None or solved.pose.covariance is None:
        return None
    found, true = solved.pose.rig_from_world, viewpoints.pose(image)
    covariance = _in_camera_axes(found, solved.pose.covariance)
    score = Score(
        inliers=solved.answer.num_inliers,
        inlier_ratio=solved.answer.num_inliers / solved.answer.num_correspondences,
    )
    return Trial(_error(found, true), covariance, score)


def _error(found: Pose, true: Pose) -> NDArray[np.float64]:
    turned = Rotation.from_matrix(found.rotation @ true.rotation.T).as_rotvec()
    return np.concatenate([turned, found.rotation @ (found.center - true.center)])


def _in_camera_axes(pose: Pose, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance (6, 6) of rotation and centre, the latter in the camera's axes too."""
    turn = np.eye(6)
    turn[3:, 3:] = pose.rotation
    return np.asarray(turn @ center_covariance(pose, covariance) @ turn.T)


def _independent(opened: Map) -> bool:
    """Whether the photos' poses came from elsewhere than the landmarks.

    Where both were estimated together, a photo that is left out has its pose from landmarks that
    are still there. Poses in a unit that nobody knows were estimated from photos too, by another
    tool: photos alone tell no scale. Editing a map, or tying it to the Earth, changes none of that:
    then the test before it counts.
    """
    manifest, before = opened.manifest, opened.manifest.parts.own_test
    if before is not None:
        return before.independent
    from_photos = (
        manifest.method.name == "model" or manifest.method.settings.get("poses") == "estimate"
    )
    return manifest.world.metric and not from_photos
