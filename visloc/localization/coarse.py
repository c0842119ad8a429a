"""Coarse poses: where a photo was taken, judged only by the mapping photos that look like it.

The pose of the query is interpolated from those of the best retrieved photos (BDI,
``visloc.retrieval.interpolation``). No keypoint confirms it, so it is never an answer of status
``localized``. Its spread is learned from the map. Each of its photos is approximated without itself
and its neighbours, and the errors are compared with the scatter of the retrieved photos.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from visloc.evaluation import CHI2_95_OF_3
from visloc.features.framing import turned_points
from visloc.geometry import Pose, covariance_from_center
from visloc.localization.map_view.constraints import Constraints, MapGeometry
from visloc.options import ReadAs
from visloc.photos.reading import turn_of, upright_from_stored
from visloc.pose.average import average_pose, deviations
from visloc.pose.motion import with_origin
from visloc.retrieval.fusion import LateFusion
from visloc.retrieval.index import retrieve
from visloc.retrieval.interpolation import WEIGHTINGS, cosine_similarity, joined
from visloc.types import CoarseMethod, CoarsePose, Evidence

# Chosen on mapping photos that were left out of their maps (docs/decisions/0044-coarse-poses.md).
METHOD = CoarseMethod.BDI
NUM_AVERAGED = 3
NUM_SCATTER = 10
# Trials approximate photos of the map. Each leaves out so many photos nearest to it, itself
# included, but at most a third of the map.
_MAX_TRIALS = 60
_LEFT_OUT = (1, 5, 10)
_LARGEST_SHARE = 3
_CERTAIN = 0.95
_LEAST_VARIANCE = 1e-30  # of a map whose photos were all taken from one pose

_Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Approximation:
    """A pose relative to the map's origin, as if its photo had been upright.

    Attributes:
        rotation_scatter: (3, 3) of the retrieved photos about it, rad^2, in the camera's axes.
        position_scatter: (3, 3) likewise, along the world's axes.
    """

    pose: Pose
    rotation_scatter: _Matrix
    position_scatter: _Matrix


@dataclass(frozen=True, slots=True)
class _Widening:
    """How the scatter S of retrieved photos becomes a covariance: ``factor (S + least I)``."""

    factor: float
    least: float

    def covariance(self, scatter: _Matrix) -> _Matrix:
        return self.factor * (scatter + self.least * np.eye(3))

    @staticmethod
    def learned(errors: _Matrix, scatters: _Matrix) -> _Widening:
        """Learn from trials: errors (n, 3) and scatters (n, 3, 3).

        The ellipsoid of 95 % holds that share of the errors, as in conformal prediction: it
        reaches the error at rank ``ceil(0.95 (n + 1))``, or the largest if there are fewer.
        """
        # All retrieved photos may stand together where the query was not taken.
        least = max(float(np.median((errors**2).sum(axis=1))) / 3.0, _LEAST_VARIANCE)
        weighed = np.linalg.solve(scatters + least * np.eye(3), errors[:, :, None])[:, :, 0]
        squares = np.sort(np.einsum("ni,ni->n", errors, weighed))
        enough = int(np.ceil(_CERTAIN * (len(squares) + 1)))
        return _Widening(float(squares[min(enough, len(squares)) - 1]) / CHI2_95_OF_3, least)


class CoarsePoses:
    """Approximates poses in one map; learns the spread when it is first asked."""

    def __init__(self, geometry: MapGeometry) -> None:
        self._geometry = geometry

    def approximate(
        self,
        query: Mapping[str, NDArray[np.float32]],
        retrieved: NDArray[np.int64],
        fusion: LateFusion,
        evidence: Evidence,
        constraints: Constraints,
    ) -> CoarsePose | None:
        """Approximate the pose of a query.

        Args:
            query: unit vector (D,) by global descriptor that ``fusion`` uses.
            retrieved: rows of the map's photos, best first; at least one.
            evidence: how the photo was turned before it was compared.

        Returns:
            The pose in the world. None if the map has too few photos to learn a spread from, or if
            the pose contradicts a prior by more than the spread allows.
        """
        if self._spread is None:
            return None
        found = self._approximated(query, retrieved, fusion)
        turn = turn_of(evidence.exif_orientation) if evidence.read_as is ReadAs.UPRIGHT else 1
        # The approximated camera is upright. Turned back, it is that of the photo as stored.
        stored_from_upright = _upright_from_stored(turn, evidence.turned).T
        pose = Pose(
            stored_from_upright @ found.pose.rotation, stored_from_upright @ found.pose.translation
        )
        rotation, position = self._spread
        about_center = np.zeros((6, 6))
        turned = stored_from_upright @ rotation.covariance(found.rotation_scatter)
        about_center[:3, :3] = turned @ stored_from_upright.T
        about_center[3:, 3:] = position.covariance(found.position_scatter)
        covariance = covariance_from_center(pose, about_center)
        if constraints.contradiction(pose, covariance) is not None:
            return None
        cam_from_world, covariance = with_origin(pose, covariance, self._geometry.origin)
        stds = np.sqrt(np.diag(about_center))
        return CoarsePose(cam_from_world, covariance, stds[3:], stds[:3], METHOD)

    @cached_property
    def _spread(self) -> tuple[_Widening, _Widening] | None:
        """Widenings of rotation and position, learned from the map's own photos."""
        geometry = self._geometry
        fusion = geometry.opened.fusion
        num = len(geometry.centers)
        most = num // _LARGEST_SHARE
        if most < 1:
            return None
        names = fusion.counted(geometry.opened.global_descriptors)
        index = {name: geometry.opened.global_descriptors[name] for name in names}
        rotations, centers = self._upright_rotations, geometry.centers
        found, errors = [], []
        for row in np.unique(np.linspace(0, num - 1, min(num, _MAX_TRIALS)).astype(int)):
            query = {name: rows[np.array([row])][0] for name, rows in index.items()}
            top_k = NUM_SCATTER + min(most, _LEFT_OUT[-1])
            ranked = retrieve(query, index, top_k, fusion=fusion).images
            for count in sorted({min(left_out, most) for left_out in _LEFT_OUT}):
                near = geometry.nearest_photos(row, count)
                others = ranked[~np.isin(ranked, [row, *near])]
                found.append(self._approximated(query, others, fusion))
                turned, moved = deviations(
                    found[-1].pose, rotations[row : row + 1], centers[row : row + 1]
                )
                errors.append((turned[0], moved[0]))
        turned, moved = (np.array([each[part] for each in errors]) for part in range(2))
        return (
            _Widening.learned(turned, np.array([each.rotation_scatter for each in found])),
            _Widening.learned(moved, np.array([each.position_scatter for each in found])),
        )

    def _approximated(
        self,
        query: Mapping[str, NDArray[np.float32]],
        retrieved: NDArray[np.int64],
        fusion: LateFusion,
    ) -> _Approximation:
        index, photos = self._geometry.opened.global_descriptors, retrieved[:NUM_SCATTER]
        vector = joined(query, fusion.weights)
        rows = joined({name: index[name][photos] for name in query}, fusion.weights)
        rotations, centers = self._upright_rotations[photos], self._geometry.centers[photos]
        best = slice(NUM_AVERAGED)
        weights = WEIGHTINGS[METHOD](vector, rows[best])
        pose = average_pose(rotations[best], centers[best], weights)
        similar = cosine_similarity(vector, rows)[:, None]
        turned, moved = deviations(pose, rotations, centers)
        return _Approximation(pose, (similar * turned).T @ turned, (similar * moved).T @ moved)

    @cached_property
    def _upright_rotations(self) -> _Matrix:
        """Return (n, 3, 3) upright cameras from the world: the mapping photos as they were read."""
        turns = [image.turn for image in self._geometry.opened.images]
        upright = {turn: _upright_from_stored(turn, 0) for turn in set(turns)}
        stacked = np.stack([upright[turn] for turn in turns])
        return np.asarray(stacked @ self._geometry.rotations)


def _upright_from_stored(exif_orientation: int, turned: int) -> _Matrix:
    """Return the rotation (3, 3) from the camera of the stored photo to that of the upright one.

    Args:
        exif_orientation: by which it was turned: 1, 3, 6 or 8.
        turned: degrees clockwise by which it was turned beyond that.
    """
    axes = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    origin, *ends = turned_points(upright_from_stored(axes, exif_orientation, 1, 1), turned, 1, 1)
    rotation = np.eye(3)
    rotation[:2, :2] = (np.array(ends) - origin).T
    return rotation
