"""Where would a photo be localized: learned from held-out runs, asked of any pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.own_test.held_out import HeldOut, Within, too_seldom_seen
from visloc.archive import Map
from visloc.geometry import Camera, Pose
from visloc.localization.map_view.constraints import Viewpoints
from visloc_extensions.report.chance import (
    Chance,
    Outlook,
    Precision,
    fit_chance,
    fit_precision,
    outlook_of,
)
from visloc_extensions.report.places import Places, sample_places
from visloc_extensions.report.rematch import Counted, Rematch, count, fit_rematch
from visloc_extensions.report.sight import Absent, Sight, look_around

_NUM_FOLDS = 5
_NOISE_PX = 1.0  # of a map without runs
_MEDIAN_OF_RAYLEIGH = 1.1774  # by the standard deviation along each axis


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """The prediction for a photo at a pose.

    Attributes:
        outlook: what of it is expected to be found again, and how well that determines the pose.
        probability: that it is localized well.
        position_std: where it is localized, units of the world; infinity where so little is in
            view that no position is determined.
    """

    sight: Sight
    outlook: Outlook
    probability: float
    position_std: float


@dataclass(frozen=True, slots=True, eq=False)
class CoverageModel:
    """A map's landmarks and what held-out runs taught about them."""

    viewpoints: Viewpoints
    places: Places
    rematch: Rematch
    chance: Chance
    precision: Precision
    noise_px: float

    def forecast(self, pose: Pose, camera: Camera) -> Forecast:
        """Predict what happens to a photo.

        Args:
            pose: ``cam_from_local``, relative to the map's origin.
        """
        sight = look_around(self.places, self.viewpoints, pose, camera)
        outlook = _outlook(sight, self.rematch, self.places, camera, self.noise_px)
        chance = float(self.chance.of([outlook])[0])
        return Forecast(sight, outlook, chance, self.precision.std(outlook))


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """The model, and what others that did not know a run's photo expected of the run.

    Attributes:
        model: made from all runs.
        expected_inliers: (r,) of each run.
        probabilities: (r,) of each run.
    """

    model: CoverageModel
    expected_inliers: NDArray[np.float64]
    probabilities: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A run, with what was in view."""

    run: HeldOut
    camera: Camera
    sight: Sight
    counted: Counted


def learn(
    opened: Map,
    viewpoints: Viewpoints,
    runs: Sequence[HeldOut],
    within: Within,
    progress: Callable[[int, int], None],
) -> Learned:
    """Make the model of a map.

    Photos are dealt into groups of neighbours. What is said of a run comes from a model that saw
    no run of its group.

    Args:
        runs: may be none: then the model knows what was thought before.
        progress: told how many runs were looked at, and of how many.
    """
    places = sample_places(opened, viewpoints)
    seen = []
    progress(0, len(runs))
    for done, run in enumerate(runs, 1):
        seen.append(_seen(opened, viewpoints, places, run))
        progress(done, len(runs))
    model = _fit(viewpoints, places, seen, within)
    expected, probabilities = np.zeros(len(runs)), np.zeros(len(runs))
    groups = _neighbours(viewpoints, np.array([run.image for run in runs], dtype=np.int64))
    for group in np.unique(groups):
        others = _fit(
            viewpoints, places, [s for s, g in zip(seen, groups, strict=True) if g != group], within
        )
        mine = np.flatnonzero(groups == group)
        outlooks = [
            _outlook(seen[i].sight, others.rematch, places, seen[i].camera, others.noise_px)
            for i in mine
        ]
        expected[mine] = [outlook.expected_inliers for outlook in outlooks]
        probabilities[mine] = others.chance.of(outlooks)
    return Learned(model, expected, probabilities)


def _seen(opened: Map, viewpoints: Viewpoints, places: Places, run: HeldOut) -> _Seen:
    camera = opened.cameras[opened.images[run.image].camera]
    # Of landmarks that are not drawn, nothing is asked.
    rows, _ = places.rows(run.left_out)
    absent = Absent(run.left_out, too_seldom_seen(opened, places.landmarks[rows]))
    sight = look_around(places, viewpoints, viewpoints.pose(run.image), camera, absent)
    matched = places.of_landmark[run.correct]
    matches = np.bincount(matched[matched >= 0], minlength=len(places.points))[sight.places]
    return _Seen(run, camera, sight, count(sight, matches))


def _fit(
    viewpoints: Viewpoints, places: Places, seen: Sequence[_Seen], within: Within
) -> CoverageModel:
    rematch = fit_rematch([s.counted for s in seen])
    errors_px = np.concatenate([np.empty(0), *(s.run.errors_px for s in seen)])
    noise_px = float(np.median(errors_px)) / _MEDIAN_OF_RAYLEIGH if len(errors_px) else _NOISE_PX
    noise_px = max(noise_px, 0.01)  # exact maps, as in tests, have none
    outlooks = [_outlook(s.sight, rematch, places, s.camera, noise_px) for s in seen]
    succeeded = np.array([within.holds(s.run) for s in seen], dtype=np.bool_)
    chance = fit_chance(outlooks, succeeded, within.position)
    errors = np.array([s.run.position_error for s in seen])
    precision = fit_precision(outlooks, errors, within.position)
    return CoverageModel(viewpoints, places, rematch, chance, precision, noise_px)


def _outlook(
    sight: Sight, rematch: Rematch, places: Places, camera: Camera, noise_px: float
) -> Outlook:
    return outlook_of(sight, rematch.expected(sight), places.share, camera, noise_px)


def _neighbours(viewpoints: Viewpoints, images: NDArray[np.int64]) -> NDArray[np.int64]:
    """Deal photos (n,) into groups of neighbours: those nearest to some that lie far apart."""
    groups = np.zeros(len(images), dtype=np.int64)
    nearest = np.full(len(images), np.inf)
    middle = 0
    for group in range(_NUM_FOLDS if len(images) else 0):
        apart = viewpoints.apart_from(viewpoints.pose(int(images[middle])))[images]
        if nearest.max() == 0.0:  # all photos are the middle of a group
            break
        groups[apart < nearest] = group
        nearest = np.minimum(nearest, apart)
        middle = int(np.argmax(nearest))
    return groups
