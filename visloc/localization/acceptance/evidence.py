"""Evidence for and against a pose: what a camera there would see, and what the photo shows.

The mapping photos nearest to the pose tell which landmarks a camera there sees; nothing hides
these, as the photos see them. Each such landmark is expected at a pixel of the photo. There the
photo may have a keypoint that looks like the landmark, one that looks different, or none. A print
leaves most of the photo unexplained, a mirror image agrees in a sliver, and another floor
contradicts where the floors differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from visloc.geometry import Camera, Pose
from visloc.localization.map_view.constraints import MapGeometry
from visloc.matching.products import EightBitRows
from visloc.pose.motion import position_covariance
from visloc.pose.reprojection import MatchedView, project, reprojection_errors

# How many mapping photos stand for a camera at the pose; landmarks of each, and of all.
_NUM_PHOTOS = 8
_MAX_SEEN, _MAX_EXPECTED = 1000, 1500
# A landmark should look the same within this angle, and this ratio of distances (in octaves).
_MAX_ANGLE = np.radians(30.0)
_MAX_OCTAVES = 1.0
# At most so many keypoints may show a landmark, within this share of the inlier threshold.
_NUM_KEYPOINTS = 4
_NEAR_SHARE = 0.5
# A landmark counts as shown if its similarity is above this quantile of similarities by chance.
_CHANCE = 0.95
# The photo is divided into so many cells along its longer side.
_CELLS = 8
# Cells with fewer compared landmarks do not count on their own.
_MIN_IN_CELL = 5
_CONTRADICTED = 0.15  # a cell contradicts the pose if a smaller share of them is explained
# Cells with fewer keypoints than this, or than this share of the mean, need no inliers.
_MIN_KEYPOINTS, _RICH = 3.0, 0.25
_MIN_INLIERS = 2  # as many explain a cell
_TIGHT_SHARE = 0.5
_LEAST_DEVIATION = 1e-3  # of similarities by chance, as a part of the largest
_MOST = 30.0  # stands for a feature that is not finite
# How many inliers are compared with their neighbours, and how many neighbours each has.
_MAX_COHERENT, _NUM_NEIGHBOURS = 600, 3
_LEAST = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """All that was found in one photo, matched or not.

    Attributes:
        keypoints: (k, 2) float32 pixels of the photo as stored.
        descriptors: (k, D) unit rows, rounded.
    """

    keypoints: NDArray[np.float32]
    descriptors: EightBitRows


@dataclass(frozen=True, slots=True, eq=False)
class SeenView:
    """One photo of an instant under a pose.

    Attributes:
        view: its camera and matches, relative to the map's origin.
        shown: all that was found in it.
        inliers: (n,) bool, matches that the pose explains.
    """

    view: MatchedView
    shown: Shown
    inliers: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _Expected:
    """Landmarks that a camera at a pose sees.

    Attributes:
        pixels: (e, 2) float64.
        descriptors: (e, D) int8, of the observation from the most similar viewpoint.
    """

    pixels: NDArray[np.float64]
    descriptors: NDArray[np.int8]


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """One view, compared with what was expected of it.

    Attributes:
        apart: radians to the nearest mapping photo.
        pixels: (e, 2) float64 where landmarks are expected.
        comparable: (e,) bool, whether a keypoint lies where the landmark is expected.
        explained: (e,) bool, whether it looks like the landmark.
        above_chance: (e,) float64, similarity above chance, in its standard deviations; 0 where
            nothing is comparable.
        cells: (e,) int64 cells of the expected pixels.
        num_keypoints: (c,) int64 keypoints in each cell.
        num_inliers: (c,) int64 inliers in each cell.
    """

    apart: float
    pixels: NDArray[np.float64]
    comparable: NDArray[np.bool_]
    explained: NDArray[np.bool_]
    above_chance: NDArray[np.float64]
    cells: NDArray[np.int64]
    num_keypoints: NDArray[np.int64]
    num_inliers: NDArray[np.int64]


# The order of ``evidence_of``; docs/decisions/0029-evidence-against.md explains each.
FEATURES = (
    "ratio",  # log odds of a match to be an inlier
    "supported",  # logarithm of inliers by keypoints
    "tight",  # share of inliers within half the threshold
    "coherent",  # how much errors of inliers are like those of their neighbours, -1 to 1
    "scatter",  # logarithm of the position's deviation by the reach of the map's photos
    "apart",  # logarithm of the angle to the nearest mapping photo
    "shown",  # log odds of an expected landmark to look like itself
    "similar",  # mean similarity of compared landmarks above chance, in its deviations
    "weak_cells",  # lower quartile over cells of the share that looks like itself
    "contradicted",  # share of compared landmarks in cells where next to nothing does
    "covered",  # share of the cells with keypoints in which there are inliers
    "keypoints_outside",  # share of keypoints in cells without inliers
    "expected_outside",  # share of expected landmarks in cells without inliers
)


def evidence_of(
    geometry: MapGeometry,
    seen: Sequence[SeenView],
    rig_from_world: Pose,
    covariance: NDArray[np.float64],
    max_error_px: float,
) -> NDArray[np.float64]:
    """Compare all photos of an instant with the map around a pose.

    Args:
        seen: the photos, at least one.
        rig_from_world: the pose, relative to the map's origin.
        covariance: (6, 6) of the pose.

    Returns:
        (f,) finite numbers, in the order of ``FEATURES``.
    """
    compared = [_compare(geometry, each, rig_from_world, max_error_px) for each in seen]
    explaining = [each.view.selected(each.inliers) for each in seen]
    num_matches = sum(len(each.view) for each in seen)
    num_inliers = sum(map(len, explaining))
    num_keypoints = sum(len(each.shown.keypoints) for each in seen)
    errors = np.concatenate([reprojection_errors(view, rig_from_world) for view in explaining])
    variance = float(np.trace(position_covariance(rig_from_world, covariance)))
    values = (
        _log_odds(num_inliers, num_matches),
        np.log((num_inliers + 1.0) / (num_keypoints + 1.0)),
        _share(int(np.sum(errors <= _TIGHT_SHARE * max_error_px)), num_inliers),
        _coherence(explaining, rig_from_world),
        np.log(np.sqrt(max(variance, 0.0)) / max(geometry.reach, _LEAST) + 1e-4),
        np.log(min(each.apart for each in compared) + 0.05),
        *_shown_features(compared),
        *_cover_features(compared),
    )
    return np.nan_to_num(np.array(values, dtype=np.float64), posinf=_MOST, neginf=-_MOST)


def compared_landmarks(
    geometry: MapGeometry, seen: SeenView, rig_from_world: Pose, max_error_px: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the pixels (n, 2) where keypoints were compared with landmarks, and which look alike.

    For pictures of what speaks for and against a pose; arguments as of ``evidence_of``.
    """
    compared = _compare(geometry, seen, rig_from_world, max_error_px)
    there = compared.comparable
    return compared.pixels[there], compared.explained[there]


def _shown_features(compared: Sequence[_Compared]) -> tuple[float, ...]:
    """Return the features that tell which of the expected landmarks the photos show."""
    num = sum(len(each.comparable) for each in compared)
    num_explained = sum(int(each.explained.sum()) for each in compared)
    above = np.concatenate([each.above_chance[each.comparable] for each in compared])
    in_cells = [
        np.bincount(each.cells[which], minlength=len(each.num_keypoints))
        for each in compared
        for which in (each.comparable, each.explained)
    ]
    compared_in, explained_in = np.concatenate(in_cells[::2]), np.concatenate(in_cells[1::2])
    telling = compared_in >= _MIN_IN_CELL
    compared_in, explained_in = compared_in[telling], explained_in[telling]
    shares = explained_in / compared_in
    return (
        _log_odds(num_explained, num),
        float(above.mean()) if len(above) else 0.0,
        float(np.quantile(shares, 0.25)) if len(shares) else 0.0,
        _share(compared_in[shares < _CONTRADICTED].sum(), compared_in.sum()),
    )


def _cover_features(compared: Sequence[_Compared]) -> tuple[float, ...]:
    """Return the features that tell which parts of the photos the pose explains."""
    keypoints = np.concatenate([each.num_keypoints for each in compared])
    inliers = np.concatenate([each.num_inliers for each in compared])
    expected = np.concatenate(
        [np.bincount(each.cells, minlength=len(each.num_keypoints)) for each in compared]
    )
    rich = keypoints >= np.maximum(_MIN_KEYPOINTS, _RICH * keypoints.mean())
    return (
        _share(int(np.sum(inliers[rich] >= _MIN_INLIERS)), int(rich.sum())),
        _share(keypoints[inliers == 0].sum(), keypoints.sum()),
        _share(expected[inliers == 0].sum(), expected.sum()),
    )


def _coherence(explaining: Sequence[MatchedView], rig_from_world: Pose) -> float:
    """Compare the errors of inliers with the mean error of their neighbours in the photo.

    Under a right pose, errors of neighbours are independent. In another room of the same design,
    a thing that stands a little elsewhere is off as a whole, so its errors are alike.
    """
    along, total = 0.0, _LEAST
    for view in explaining:
        if len(view) <= 2 * _NUM_NEIGHBOURS:
            continue
        some = view.selected(np.arange(0, len(view), max(1, -(-len(view) // _MAX_COHERENT))))
        in_cam = (some.cam_from_rig @ rig_from_world).apply(some.points)
        errors = project(some.camera, in_cam) - some.pixels
        tree = KDTree(some.pixels, balanced_tree=False)
        _, near = tree.query(some.pixels, k=range(2, _NUM_NEIGHBOURS + 2))
        along += float(np.sum(errors * errors[np.asarray(near)].mean(axis=1)))
        total += float(np.sum(errors * errors))
    return along / total


def _compare(
    geometry: MapGeometry, seen: SeenView, rig_from_world: Pose, max_error_px: float
) -> _Compared:
    """Look for the landmarks that a camera at the pose sees."""
    camera, shown = seen.view.camera, seen.shown
    apart, expected = _expected(geometry, camera, seen.view.cam_from_rig @ rig_from_world)
    keypoints = shown.keypoints.astype(np.float64)
    num, grid = len(expected.pixels), _Grid.of(camera)
    comparable, explained = np.zeros(num, dtype=np.bool_), np.zeros(num, dtype=np.bool_)
    above_chance = np.zeros(num)
    if num and len(keypoints):
        # An unbalanced tree is built in half the time, and this one is asked only once.
        distances, near = KDTree(keypoints, balanced_tree=False).query(
            expected.pixels,
            k=range(1, _NUM_KEYPOINTS + 1),  # a range keeps the axis
            distance_upper_bound=_NEAR_SHARE * max_error_px,
        )
        there = np.isfinite(distances)
        comparable = np.asarray(there.any(axis=1), dtype=np.bool_).reshape(num)
        near, there = np.where(there, near, 0)[comparable], there[comparable]
        theirs = shown.descriptors.rows[near].astype(np.float32)
        ours = expected.descriptors[comparable].astype(np.float32)
        if len(ours):
            similarity = _best(theirs, ours, there)
            # By chance: the similarity of any other landmark in its place.
            chance = _best(theirs, np.roll(ours, len(ours) // 2, axis=0), there)
            deviation = max(
                float(chance.std()), _LEAST_DEVIATION * float(np.abs(chance).max()), 1.0
            )
            above_chance[comparable] = (similarity - chance.mean()) / deviation
            explained[comparable] = similarity > np.quantile(chance, _CHANCE)
    return _Compared(
        apart,
        expected.pixels,
        comparable,
        explained,
        above_chance,
        grid.cells(expected.pixels),
        np.bincount(grid.cells(keypoints), minlength=grid.num_cells),
        np.bincount(grid.cells(seen.view.pixels[seen.inliers]), minlength=grid.num_cells),
    )


@dataclass(frozen=True, slots=True)
class _Grid:
    """Square cells that cover a photo."""

    size: float
    columns: int
    rows: int

    @staticmethod
    def of(camera: Camera) -> _Grid:
        size = max(camera.width, camera.height) / _CELLS
        columns, rows = (math.ceil(side / size) for side in (camera.width, camera.height))
        return _Grid(size, columns, rows)

    @property
    def num_cells(self) -> int:
        return self.columns * self.rows

    def cells(self, pixels: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the cell of each pixel (n, 2); those outside count as at the edge."""
        across, down = np.floor(pixels.T / self.size).astype(np.int64)
        columns, rows = self.columns - 1, self.rows - 1
        return np.asarray(np.clip(down, 0, rows) * self.columns + np.clip(across, 0, columns))


def _best(
    theirs: NDArray[np.float32], ours: NDArray[np.float32], there: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the largest product of each landmark (n, D) with keypoints (n, k, D) near it.

    Up to about a thousand dimensions, sums of 8-bit products are exact in single precision, so
    they are equal on every machine.
    """
    products = np.einsum("nkd,nd->nk", theirs, ours)
    return np.asarray(np.where(there, products, -np.inf).max(axis=1), dtype=np.float64)


def _expected(
    geometry: MapGeometry, camera: Camera, cam_from_world: Pose
) -> tuple[float, _Expected]:
    """Return how far the nearest mapping photo is, and the landmarks that a camera sees.

    A landmark counts if a photo near the pose sees it from about the same side and distance.
    """
    opened, apart = geometry.opened, geometry.viewpoints.apart_from(cam_from_world)
    nearest = np.argpartition(apart, min(_NUM_PHOTOS, len(apart)) - 1)[:_NUM_PHOTOS]
    nearest = nearest[np.lexsort((nearest, apart[nearest]))]
    seen = [_some_rows(opened.observation_offsets, image) for image in nearest.tolist()]
    observations, photos = np.concatenate(seen), np.repeat(nearest, [len(each) for each in seen])
    landmarks = np.asarray(opened.observation_landmarks)[observations].astype(np.int64)
    points = geometry.points(landmarks).astype(np.float64)
    in_cam = cam_from_world.apply(points)
    pixels = project(camera, in_cam)
    (x, y), (width, height) = pixels.T, (camera.width, camera.height)
    # False for NaN.
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (in_cam[:, 2] > 0)
    unlike = np.full(len(points), np.inf)
    unlike[inside] = _unlike(
        points[inside], cam_from_world.center, geometry.centers[photos[inside]]
    )
    kept = np.flatnonzero(np.isfinite(unlike))
    order = kept[np.argsort(unlike[kept], kind="stable")]
    _, first = np.unique(landmarks[order], return_index=True)  # of each, the most alike
    rows = order[first][:: max(1, -(-len(first) // _MAX_EXPECTED))]
    descriptors = np.asarray(opened.observation_descriptors)[observations[rows]]
    return float(apart[nearest[0]]), _Expected(pixels[rows], descriptors)


def _unlike(
    points: NDArray[np.float64], center: NDArray[np.float64], photo_centers: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how differently landmarks (n, 3) look from two viewpoints; infinity beyond limits."""
    from_pose, from_photo = points - center, points - photo_centers
    away, photo_away = (
        np.maximum(np.sqrt(_dots(rays, rays)), _LEAST) for rays in (from_pose, from_photo)
    )
    cosines = _dots(from_pose, from_photo) / (away * photo_away)
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    octaves = np.abs(np.log2(away / photo_away))
    alike = (angles <= _MAX_ANGLE) & (octaves <= _MAX_OCTAVES)
    return np.asarray(np.where(alike, angles / _MAX_ANGLE + octaves, np.inf))


def _dots(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the dot products (n,) of rows (n, 3)."""
    x, y, z = (a * b).T  # faster than a sum over rows of three
    return np.asarray(x + y + z)


def _some_rows(offsets: NDArray[np.int64], image: int) -> NDArray[np.int64]:
    """Return rows of a photo's observations, evenly many."""
    start, stop = int(offsets[image]), int(offsets[image + 1])
    return np.arange(start, stop, max(1, -(-(stop - start) // _MAX_SEEN)))


def _share(part: float, whole: float) -> float:
    """Return a share that tends to a half if there is little to count."""
    return float((part + 1.0) / (whole + 2.0))


def _log_odds(part: float, whole: float) -> float:
    return float(np.log((part + 1.0) / (whole - part + 1.0)))
