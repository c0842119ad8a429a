"""Find photos of a finished model that contradict each other, as a wrong loop closure makes them.

Two hallways that look alike may be joined to one. Then both stand in the same space, and photos of
both seem to be taken beside each other. Here each photo is searched for the landmarks that it
should show by its pose. What two neighbouring photos find is then

- positively correlated, if both show the same hallway: both find its landmarks, and miss those of
  the other hallway;
- negatively correlated, if they show different hallways: one finds what the other misses;
- independent in a model of one place, where landmarks are missed by chance, or because something
  stands in front.

The photos are grouped by these correlations, by greedy additive edge contraction (Keuper et al.,
"Efficient decomposition of image and mesh graphs by lifted multicuts", 2015).
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from mapping.progress import ItemProgress, not_told
from mapping.stages.landmarks import View
from visloc.pose.covariance import viewpoints_apart
from visloc.pose.reprojection import project

# Photos near one, by ``viewpoints_apart`` (radians). What they observe it should show, and it is
# compared with them.
_MOST_NEAR, _NEAR = 30, 0.7
# A landmark should look the same within this angle, and this ratio of distances.
_LEAST_COSINE, _MOST_OCTAVES = np.cos(np.radians(20.0)), 0.7
# Only landmarks that so many photos observe are used. Two photos alone would always agree.
_LEAST_TRACK = 3
# Mean number of a photo's landmarks that are searched for in others: the same for all others.
_LOOKED_FOR = 400
# Landmarks stand in front if their depth is less than this part of another's, and these nearest
# ones lie within this part of the longer side.
_IN_FRONT, _NUM_BESIDE, _BESIDE = 0.75, 3, 0.03
# A keypoint shows a landmark if it is expected within this share of the longer side. The share is
# generous, because slightly wrong poses are not two places.
_ABOUT = 0.015
# Fewest landmarks that two photos are compared by; more than the second number weigh no more.
_LEAST_COMPARED, _FULL_WEIGHT = 40, 300
# Photos of one place may have a slightly negative correlation. Measured:
# docs/decisions/0037-places-that-contradict.md.
_SLACK = 0.05
# Two groups of at least so many photos show two places if at least so many pairs across them have a
# mean correlation of at most this, and pairs within the groups one that is so much larger.
_LEAST_PHOTOS = 3
_LEAST_PAIRS, _CONTRADICT, _LEAST_CONTRAST = 4, -0.07, 0.25
# A pair with such a correlation shows one place, whatever its groups say.
_AGREE = 0.15
_TINY = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class ModelPhoto:
    """A photo of a model, with what was found in it.

    Attributes:
        keypoints: (k, 2) pixels.
        descriptors: (k, D) int8, all with one scale.
        landmarks: (m,) int64 rows of the points that it observes.
        rows: (m,) int64 rows of the keypoints that observe them.
    """

    view: View
    keypoints: NDArray[np.floating]
    descriptors: NDArray[np.int8]
    landmarks: NDArray[np.int64]
    rows: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The places that photos of a model seem to show.

    Attributes:
        groups: (n,) int64 number of each photo's group; those of one group show one place.
        contradicting: pairs of groups that show two places.
        agreeing: pairs of photos that show one place, whatever their groups.
    """

    groups: NDArray[np.int64]
    contradicting: frozenset[tuple[int, int]]
    agreeing: frozenset[tuple[int, int]]

    def tell_apart(self, first: int, second: int) -> bool:
        """Tell whether two photos show two places."""
        a, b = sorted((int(self.groups[first]), int(self.groups[second])))
        pair = (first, second) if first < second else (second, first)
        return (a, b) in self.contradicting and pair not in self.agreeing

    def doubted(self) -> NDArray[np.int64]:
        """Return the rows of photos in groups that a larger group contradicts."""
        sizes = np.bincount(self.groups)
        smaller = {b if sizes[a] >= sizes[b] else a for a, b in self.contradicting}
        return np.flatnonzero(np.isin(self.groups, sorted(smaller)))


def find_places(
    photos: Sequence[ModelPhoto],
    points: NDArray[np.float64],
    progress: ItemProgress = not_told,
) -> Places:
    """Group the photos of a model by the place that they seem to show.

    Args:
        points: (P, 3) its points.
    """
    model = _Model(photos, points)
    expected, shown = [], []
    for row in range(len(photos)):
        progress(row, len(photos))
        landmarks = model.expected(row)
        expected.append(landmarks)
        shown.append(landmarks[model.shown(row, landmarks)])
    pairs, correlations, counts = _correlations(
        _table(expected, len(points)),
        _table(shown, len(points)),
        [model.near(row) for row in range(len(photos))],
    )
    progress(len(photos), len(photos))
    weights = (correlations + _SLACK) * np.minimum(counts, _FULL_WEIGHT) / _FULL_WEIGHT
    groups = _contracted(len(photos), pairs, weights)
    return Places(
        groups,
        _contradicting(groups, pairs, correlations, counts),
        frozenset(map(tuple, pairs[correlations >= _AGREE].tolist())),
    )


def share_shown(
    photos: Sequence[ModelPhoto], points: NDArray[np.float64], row: int
) -> tuple[int, int]:
    """Return how many landmarks one photo of a model shows, of how many that it should show.

    It should show what photos near it observe, as in ``find_places``.

    Args:
        points: (P, 3) its points.
    """
    model = _Model(photos, points)
    expected = model.expected(row)
    return int(model.shown(row, expected).sum()), len(expected)


class _Model:
    """Photos and points, to look for what each photo should show."""

    def __init__(self, photos: Sequence[ModelPhoto], points: NDArray[np.float64]) -> None:
        self._photos, self._points = photos, points
        self._place = np.full(len(points), -1)
        tracks = np.bincount(
            np.concatenate([np.empty(0, np.int64), *(photo.landmarks for photo in photos)]),
            minlength=len(points),
        )
        confirmed = tracks >= _LEAST_TRACK
        step = int(tracks[confirmed].sum()) // max(1, _LOOKED_FOR * len(photos))
        confirmed &= np.arange(len(points)) % max(1, step) == 0
        chosen = [confirmed[photo.landmarks] for photo in photos]
        self._landmarks = [p.landmarks[which] for p, which in zip(photos, chosen, strict=True)]
        self._rows = [p.rows[which] for p, which in zip(photos, chosen, strict=True)]
        self._centers = np.array([p.view.cam_from_world.center for p in photos]).reshape(-1, 3)
        self._rotations = np.array([p.view.cam_from_world.rotation for p in photos]).reshape(
            -1, 3, 3
        )
        self._depths = [p.view.cam_from_world.apply(points[p.landmarks])[:, 2] for p in photos]

    def near(self, row: int) -> NDArray[np.int64]:
        """Return the photos near one, the nearest first."""
        photo, depths = self._photos[row], self._depths[row]
        reach = max(float(np.median(depths)) if len(depths) else 0.0, _TINY)
        pose = photo.view.cam_from_world
        apart = viewpoints_apart(self._rotations, self._centers, pose, reach)
        apart[row] = np.inf
        nearest = np.argsort(apart, kind="stable")[:_MOST_NEAR]
        return np.asarray(nearest[apart[nearest] <= _NEAR])

    def expected(self, row: int) -> NDArray[np.int64]:
        """Return the landmarks that photos near one observe and that it should show, in order."""
        photo, own = self._photos[row], self._depths[row]
        camera, pose = photo.view.camera, photo.view.cam_from_world
        photos = self.near(row)
        near = [self._landmarks[other] for other in photos.tolist()]
        if not near or not len(own):
            return np.empty(0, np.int64)
        landmarks = np.concatenate(near)
        observers = np.repeat(self._centers[photos], [len(each) for each in near], axis=0)
        alike = _look_alike(self._points[landmarks], observers, pose.center)
        landmarks = np.unique(landmarks[alike])
        in_cam = pose.apply(self._points[landmarks])
        pixels = project(camera, in_cam)
        with np.errstate(invalid="ignore"):  # NaN behind the camera is not inside
            inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
        inside &= in_cam[:, 2] > 0
        landmarks, pixels, depths = landmarks[inside], pixels[inside], in_cam[inside, 2]
        distances, beside = KDTree(photo.keypoints[photo.rows].astype(np.float64)).query(
            pixels,
            k=range(1, _NUM_BESIDE + 1),
            distance_upper_bound=_BESIDE * max(camera.width, camera.height),
        )
        there = np.isfinite(distances)
        front = np.where(there, own[np.where(there, beside, 0)], np.inf).min(axis=1)
        return np.asarray(landmarks[front >= _IN_FRONT * depths])

    def shown(self, row: int, landmarks: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which of the expected landmarks a photo shows.

        The keypoint of the whole photo that is most like the landmark must lie where it should be:
        at the corner of another door there is a keypoint, too.
        """
        photo = self._photos[row]
        found = np.isin(landmarks, photo.landmarks)
        missing = np.flatnonzero(~found)
        if len(missing) == 0:
            return found
        camera, pose = photo.view.camera, photo.view.cam_from_world
        pixels = project(camera, pose.apply(self._points[landmarks[missing]]))
        wanted = self._descriptors(row, landmarks[missing]).astype(np.float32)
        most_alike = (wanted @ photo.descriptors.T.astype(np.float32)).argmax(axis=1)
        away = np.linalg.norm(photo.keypoints[most_alike] - pixels, axis=1)
        found[missing] = away <= _ABOUT * max(camera.width, camera.height)
        return found

    def _descriptors(self, row: int, landmarks: NDArray[np.int64]) -> NDArray[np.int8]:
        """Return the descriptors of landmarks in the nearest photos that observe them."""
        descriptors = np.zeros((len(landmarks), self._photos[row].descriptors.shape[1]), np.int8)
        self._place[landmarks] = np.arange(len(landmarks))
        for other in self.near(row)[::-1].tolist():  # the nearest comes last, and stays
            places = self._place[self._landmarks[other]]
            wanted = places >= 0
            rows = self._rows[other][wanted]
            descriptors[places[wanted]] = self._photos[other].descriptors[rows]
        self._place[landmarks] = -1
        return descriptors


def _look_alike(
    places: NDArray[np.float64], here: NDArray[np.float64], there: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Tell which places (n, 3) two cameras see from about the same side and distance."""
    a, b = places - here, places - there
    far_a, far_b = (np.maximum(np.linalg.norm(each, axis=1), _TINY) for each in (a, b))
    cosines = np.sum(a * b, axis=1) / (far_a * far_b)
    octaves = np.abs(np.log2(far_b / far_a))
    return np.asarray((cosines >= _LEAST_COSINE) & (octaves <= _MOST_OCTAVES))


def _table(rows: Sequence[NDArray[np.int64]], width: int) -> csr_array:
    """Return a matrix with ones in the columns that each row names."""
    columns = np.concatenate([np.empty(0, np.int64), *rows])
    bounds = np.cumsum([0, *(len(row) for row in rows)])
    return csr_array((np.ones(len(columns)), columns, bounds), (len(rows), width))


def _correlations(
    expected: csr_array, shown: csr_array, near: Sequence[NDArray[np.int64]]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Correlate what photos near each other show of what both should show.

    Returns:
        Pairs (m, 2) of rows in ascending order, with enough landmarks; the correlation
        coefficients (m,), 0 where a photo shows all or nothing; and the landmarks compared (m,).
    """
    first = np.repeat(np.arange(len(near)), [len(rows) for rows in near])
    second = np.concatenate([np.empty(0, np.int64), *near])
    pairs = np.unique(np.sort(np.column_stack([first, second]), axis=1), axis=0).astype(np.int64)

    def counted(a: csr_array, b: csr_array) -> NDArray[np.float64]:
        return np.asarray(a[pairs[:, 0]].multiply(b[pairs[:, 1]]).sum(axis=1), np.float64).ravel()

    total = counted(expected, expected)
    enough = total >= _LEAST_COMPARED
    pairs, total = pairs[enough], total[enough]
    one, other, both = (
        counted(shown, expected),
        counted(expected, shown),
        counted(shown, shown),
    )
    spread = np.sqrt(one * (total - one) * other * (total - other))
    correlations = np.divide(
        total * both - one * other, spread, out=np.zeros(len(pairs)), where=spread > 0
    )
    return pairs, correlations, total


def _contracted(
    num: int, pairs: NDArray[np.int64], weights: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Join the two groups with the largest sum of weights between them, while it is positive."""
    links: list[dict[int, float]] = [{} for _ in range(num)]
    for (a, b), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
        links[a][b] = links[b][a] = weight
    heap = [(-w, a, b) for a, own in enumerate(links) for b, w in own.items() if a < b and w > 0]
    heapq.heapify(heap)
    group = np.arange(num)
    while heap:
        weight, a, b = heapq.heappop(heap)
        if links[a].get(b) != -weight:
            continue  # one of both has been joined since
        group[group == b] = a
        del links[a][b]
        del links[b][a]
        for other, more in links[b].items():
            del links[other][b]
            total = links[a].get(other, 0.0) + more
            links[a][other] = links[other][a] = total
            if total > 0:
                heapq.heappush(heap, (-total, min(a, other), max(a, other)))
        links[b] = {}
    return np.asarray(np.unique(group, return_inverse=True)[1].ravel(), np.int64)


def _contradicting(
    groups: NDArray[np.int64],
    pairs: NDArray[np.int64],
    correlations: NDArray[np.float64],
    counts: NDArray[np.float64],
) -> frozenset[tuple[int, int]]:
    """Return the pairs of groups that show two places."""
    weights = np.minimum(counts, _FULL_WEIGHT)
    sizes = np.bincount(groups).tolist()
    of_groups: dict[tuple[int, int], list[int]] = {}
    for row, (a, b) in enumerate(np.sort(groups[pairs], axis=1).tolist()):
        of_groups.setdefault((a, b), []).append(row)

    def mean(rows: list[int]) -> float:
        return float(np.average(correlations[rows], weights=weights[rows]))

    found = set()
    for (a, b), across in of_groups.items():
        within = [*of_groups.get((a, a), []), *of_groups.get((b, b), [])]
        if a == b or min(sizes[a], sizes[b]) < _LEAST_PHOTOS:
            continue
        if len(across) < _LEAST_PAIRS or not within:
            continue
        if mean(across) <= _CONTRADICT and mean(within) - mean(across) >= _LEAST_CONTRAST:
            found.add((a, b))
    return frozenset(found)
