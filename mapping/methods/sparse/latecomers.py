"""Photos that incremental mapping left out, placed in the finished model.

The mapper uses believed pairs only (``mapping.methods.sparse.look_alikes``), because it cannot know
yet what a photo should show. A finished model knows. So here any verified pair may propose a pose,
and the photo itself decides: it must show what photos near that pose observe. If another floor of
the same design proposes the pose, the photo shows one landmark in ten.

Photos that are in the model already stay where they are.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.methods.matching.stages import Matches, fits_poses
from mapping.methods.sparse.contradictions import ModelPhoto, share_shown
from mapping.methods.sparse.look_alikes import ranks_in_time
from mapping.methods.sparse.model import MapperConfig, SfmPhoto, SparseModel
from mapping.progress import ItemProgress
from mapping.stages.landmarks import View
from visloc.geometry import Camera, Pose
from visloc.pose.generalized import GeneralizedPose, estimate_generalized_pose
from visloc.pose.reprojection import MatchedView, normalized_rays, project

# Matches with photos at most so many steps away in time are tried alone first, because repeated
# things also match photos of other parts of the place.
_NEAR_STEPS = 6
# Least share of landmarks that a photo must show. Right poses have 0.54 to 0.93; poses in another
# part of the place, or on another floor, 0.12 at most (measured:
# docs/decisions/0037-places-that-contradict.md).
_LEAST_SHOWN = 0.5
# Fewer landmarks do not tell.
_LEAST_EXPECTED = 20
# A pose with fewer inliers is not looked at. In the end, as many landmarks as the mapper asks for
# must be inliers, or shown.
_LEAST_PROPOSING = 20
# Pairs that were not believed make landmarks if this share of their matches fits the poses.
_LEAST_FITTING = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Late:
    """Photos that found a place late.

    Attributes:
        views: of all photos, those of the model as they were.
        rows: of the photos that were placed.
        matches: those between them and the other photos that fit the poses.
    """

    views: tuple[View | None, ...]
    rows: tuple[int, ...]
    matches: tuple[Matches, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Proposed:
    """A pose of a photo, with the landmarks that propose it: rows of keypoints and of points."""

    pose: GeneralizedPose
    landmarks: NDArray[np.int64]

    @property
    def inliers(self) -> NDArray[np.int64]:
        return self.landmarks[self.pose.inliers[0]]


def place_latecomers(
    photos: Sequence[SfmPhoto],
    describe: Callable[[int], NDArray[np.int8]],
    matches: Sequence[Matches],
    model: SparseModel,
    config: MapperConfig,
    progress: ItemProgress,
) -> Late:
    """Place photos without a pose in a finished model, one after another.

    A photo that is placed adds the landmarks that it shares with others, so the next may find a
    place by it. Photos of cameras that the model does not know, or that are in doubt, are left out.

    Args:
        describe: returns the descriptors (k, D) of a photo's keypoints, all with one scale.
        matches: verified, between all photos, believed or not.
        progress: called with the number of photos placed, and of all that had no place.
    """
    growing = _Growing(photos, describe, matches, model, config)
    waiting = {row for row, view in enumerate(model.views) if view is None}
    changed = set(waiting)
    proposed: dict[int, list[_Proposed]] = {}
    placed: list[int] = []
    total = len(waiting)
    while changed:
        progress(min(len(placed), total - 1), total)  # extending the model takes time too
        proposed |= {row: growing.propose(row) for row in sorted(changed)}
        changed = set()
        best = [(row, each) for row in sorted(waiting) for each in proposed[row]]
        best.sort(key=lambda each: -each[1].pose.num_inliers)
        for row, each in best:
            proposed[row].remove(each)  # until photos that it shares matches with are placed
            if growing.shows(row, each) and growing.place(row, each):
                placed.append(row)
                waiting.discard(row)
                changed = waiting & growing.partners(row)
                break
    return Late(tuple(growing.views), tuple(placed), tuple(growing.fitting(placed)))


class _Growing:
    """A model to which photos are added."""

    def __init__(
        self,
        photos: Sequence[SfmPhoto],
        describe: Callable[[int], NDArray[np.int8]],
        matches: Sequence[Matches],
        model: SparseModel,
        config: MapperConfig,
    ) -> None:
        self.views = list(model.views)
        self._photos, self._describe, self._config = photos, describe, config
        self._points = model.points
        self._cameras: dict[str, Camera] = {
            photo.sensor: view.camera
            for photo, view in zip(photos, model.views, strict=True)
            if view is not None and photo.sensor not in model.doubts
        }
        self._ranks = ranks_in_time(photos)
        self._landmarks = [np.full(len(photo.keypoints), -1) for photo in photos]
        seen = model.observations
        for row, landmarks in enumerate(self._landmarks):
            own = seen.views == row
            landmarks[seen.rows[own]] = seen.points[own]
        # Rows of own keypoints, and of those of the partner, by partner.
        self._pairs: list[dict[int, NDArray[np.uint32]]] = [{} for _ in photos]
        for pair in matches:
            self._pairs[pair.first][pair.second] = pair.rows
            self._pairs[pair.second][pair.first] = pair.rows[:, ::-1]
        self._looks: dict[int, NDArray[np.int8]] = {}

    def partners(self, row: int) -> set[int]:
        """Return the photos with which one has verified matches."""
        return set(self._pairs[row])

    def propose(self, row: int) -> list[_Proposed]:
        """Return the poses that landmarks propose: of photos near in time, and of all."""
        camera = self._cameras.get(self._photos[row].sensor)
        if camera is None:
            return []
        placed = [other for other in self._pairs[row] if self.views[other] is not None]
        near = [other for other in placed if self._near_in_time(row, other)]
        return [
            found
            for partners in ([near, placed] if len(near) < len(placed) else [placed])
            if (found := self._solved(row, camera, partners)) is not None
        ]

    def _near_in_time(self, row: int, other: int) -> bool:
        same = self._photos[row].sensor == self._photos[other].sensor
        return same and abs(self._ranks[row] - self._ranks[other]) <= _NEAR_STEPS

    def _solved(self, row: int, camera: Camera, partners: Sequence[int]) -> _Proposed | None:
        found = [np.empty((0, 2), np.int64)]
        for other in partners:
            own, theirs = self._pairs[row][other].T
            landmarks = self._landmarks[other][theirs]
            found.append(np.column_stack([own, landmarks])[landmarks >= 0])
        both = np.unique(np.concatenate(found).astype(np.int64), axis=0)
        if len(both) < _LEAST_PROPOSING:
            return None
        pixels = self._photos[row].keypoints[both[:, 0]].astype(np.float64)
        seen = MatchedView(camera, Pose.identity(), pixels, self._points[both[:, 1]])
        pose = estimate_generalized_pose(
            [seen], max_error_px=self._config.abs_pose_max_error, seed=0
        )
        if (
            pose is None
            or pose.num_inliers < _LEAST_PROPOSING
            or pose.num_inliers < self._config.abs_pose_min_inlier_ratio * len(both)
        ):
            return None
        return _Proposed(pose, both)

    def shows(self, row: int, proposed: _Proposed) -> bool:
        """Tell whether a photo shows what photos near its pose observe."""
        view = View(self._cameras[self._photos[row].sensor], proposed.pose.rig_from_world)
        keypoints, landmarks = proposed.inliers.T
        others = [
            self._model_photo(other, known, np.flatnonzero(self._landmarks[other] >= 0))
            for other, known in enumerate(self.views)
            if known is not None
        ]
        own = ModelPhoto(view, self._photos[row].keypoints, self._look(row), landmarks, keypoints)
        shown, expected = share_shown([*others, own], self._points, len(others))
        return (
            expected >= _LEAST_EXPECTED
            and shown >= _LEAST_SHOWN * expected
            and max(shown, len(landmarks)) >= self._config.abs_pose_min_num_inliers
        )

    def _model_photo(self, row: int, view: View, rows: NDArray[np.int64]) -> ModelPhoto:
        landmarks = self._landmarks[row][rows]
        return ModelPhoto(view, self._photos[row].keypoints, self._look(row), landmarks, rows)

    def _look(self, row: int) -> NDArray[np.int8]:
        if row not in self._looks:
            self._looks[row] = self._describe(row)
        return self._looks[row]

    def place(self, row: int, proposed: _Proposed) -> bool:
        """Give a photo its pose, and make landmarks of what it shares with others.

        Returns:
            False if no pair fits the pose. Then the photo would see no landmark, and gets no pose.
        """
        camera = self._cameras[self._photos[row].sensor]
        view = self.views[row] = View(camera, proposed.pose.rig_from_world)
        pairs = self.fitting([row])
        if not pairs:
            self.views[row] = None
            return False
        own, landmarks = proposed.inliers.T
        self._landmarks[row][own] = landmarks
        for pair in pairs:
            other = pair.second if pair.first == row else pair.first
            rows, theirs = (pair.rows if pair.first == row else pair.rows[:, ::-1]).T
            known = self.views[other]
            assert known is not None  # of a pair that fits
            new = (self._landmarks[row][rows] < 0) & (self._landmarks[other][theirs] < 0)
            rows, theirs = rows[new], theirs[new]
            points, good = _triangulated(
                (view, known),
                self._photos[row].keypoints[rows].astype(np.float64),
                self._photos[other].keypoints[theirs].astype(np.float64),
                self._config,
            )
            numbers = len(self._points) + np.arange(good.sum())
            self._landmarks[row][rows[good]] = numbers
            self._landmarks[other][theirs[good]] = numbers
            self._points = np.concatenate([self._points, points[good]])
        return True

    def fitting(self, rows: Collection[int]) -> list[Matches]:
        """Return the matches that fit the poses, of those pairs of some photos that fit them."""
        found = []
        for row in rows:
            for other, matched in self._pairs[row].items():
                first, second = sorted((row, other))
                views = self.views[first], self.views[second]
                if (other in rows and other < row) or views[0] is None or views[1] is None:
                    continue
                both = matched if first == row else matched[:, ::-1]
                fits = fits_poses(
                    (views[0], views[1]),
                    self._photos[first].keypoints[both[:, 0]],
                    self._photos[second].keypoints[both[:, 1]],
                    self._config.abs_pose_max_error,
                )
                if fits.sum() >= max(self._config.min_num_matches, _LEAST_FITTING * len(fits)):
                    found.append(Matches(first, second, both[fits]))
        return found


def _triangulated(
    views: tuple[View, View],
    pixels_a: NDArray[np.float64],
    pixels_b: NDArray[np.float64],
    config: MapperConfig,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the points (n, 3) midway between two rays each, and which of them are good."""
    a, b = (
        normalized_rays(view.camera, pixels) @ view.cam_from_world.rotation
        for view, pixels in zip(views, (pixels_a, pixels_b), strict=True)
    )
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    start, end = (view.cam_from_world.center for view in views)
    way = end - start
    cosines = np.sum(a * b, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel rays are not good
        along_a = (a @ way - cosines * (b @ way)) / (1 - cosines**2)
        along_b = (cosines * (a @ way) - b @ way) / (1 - cosines**2)
        points = (start + along_a[:, None] * a + end + along_b[:, None] * b) / 2
        good = (along_a > 0) & (along_b > 0)
        good &= cosines < np.cos(np.radians(config.min_angle_deg))
        for view, pixels in zip(views, (pixels_a, pixels_b), strict=True):
            errors = project(view.camera, view.cam_from_world.apply(points)) - pixels
            good &= np.linalg.norm(errors, axis=1) <= config.abs_pose_max_error
    return points, good
