"""Poses that are known to be right or wrong, and the evidence for each.

The mapping photos of a map are asked of the map without them, or without all that stand near; they
are made harder, mirrored, and printed into other scenes. Painted rooms give rooms that resemble
each other. Queries of benchmarks teach nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.probability.disguises import DISGUISES, Image, printed, resembling
from benchmarks.probability.held_out_maps import without
from samples.render import render_photo
from samples.scene import NUM_SURFACES, make_room
from samples.trajectories import query_trajectory, stereo_rig
from visloc.archive import Map
from visloc.evaluation import pose_error
from visloc.features.base import LocalFeatureExtractor
from visloc.geometry import Camera, Pose
from visloc.localization.acceptance.evidence import SeenView, evidence_of
from visloc.localization.acceptance.gates import CONFIRMATIONS, GATES, Problem, first_refusal
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import Constraints, MapGeometry
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo, read_photo_file
from visloc.pose.reprojection import MatchedView
from visloc.priors import NO_PRIORS
from visloc_extensions.report.look_alikes import shares_place

# A pose is right this near to the truth, as a part of the distance from which photos see, and
# wrong beyond twice as much. What lies between teaches nothing.
_RIGHT_OF_REACH, _RIGHT_DEG = 0.1, 4.0
_LEAST_MATCHES, _LEAST_INLIERS = 20, 12  # far below what any gate lets through
# How many parts of a map are left out in turn: every third photo, then two quarters in a row.
_THIRDS, _QUARTERS = 3, (1, 2)
_APART = (0.35, 0.6, 0.9)  # radians, within which all photos are left out
_DISGUISES_PER_PHOTO, _PRINTS_PER_PHOTO = 3, 2
# Of painted rooms: shares of surfaces that are painted anew, and from which share of a photo's
# pixels on it shows another room. With less it shows the same room, changed.
_REPAINTED = (0.0, 0.15, 0.5, 0.8, 0.92)
_OTHER_ROOM, _SAME_ROOM = 0.6, 0.3
_CHANGED_GREY_LEVELS = 12


@dataclass(frozen=True, slots=True, eq=False)
class Taught:
    """One pose.

    Attributes:
        kind: what was done to the photo, or to the map.
        right: whether it is right.
        believed: whether the other gates let it through.
        features: (f,) as ``evidence_of``.
    """

    kind: str
    right: bool
    believed: bool
    features: NDArray[np.float64]


class Teacher:
    """Asks a map about photos whose poses are known.

    Args:
        full: the map.
        photos: folder of its photos, by their names.
        extractor: of its local features.
        foreign: photos of other places.
        seed: equal seeds ask equal questions.
    """

    def __init__(
        self,
        full: Map,
        photos: Path,
        extractor: LocalFeatureExtractor,
        foreign: Sequence[Path],
        seed: int = 0,
    ) -> None:
        self._full, self._photos, self._extractor = full, photos, extractor
        self._foreign, self._random = foreign, np.random.default_rng(seed)
        self._viewpoints = MapGeometry(full).viewpoints
        stamps = np.array([image.timestamp for image in full.images])
        _, self._instants = np.unique(stamps, return_inverse=True)

    def held_out(self, num_photos: int) -> Iterator[Taught]:
        """Ask about photos that are not in the map: as they are, harder, mirrored, printed."""
        parts = list(self._parts())
        for part in parts:
            localizer = self._localizer(part)
            count = max(1, round(num_photos * len(part) / sum(map(len, parts))))
            for image in _evenly(part, count):
                rgb, camera, truth = self._taken(image)
                yield from self._ask(localizer, "plain", rgb, camera, truth)
                kinds = self._random.choice(list(DISGUISES), _DISGUISES_PER_PHOTO, replace=False)
                for kind in map(str, kinds):
                    harder = DISGUISES[kind](rgb, camera, self._scene(), self._random)
                    yield from self._ask(localizer, kind, *harder, truth)
                alike = resembling(rgb, self._scene(), self._random)
                yield from self._ask(localizer, "resembling", alike, camera, None)
                yield from self._ask(localizer, "mirrored", rgb[:, ::-1], camera, None)
                for _ in range(_PRINTS_PER_PHOTO):
                    disguised = printed(rgb, self._scene(), self._random)
                    yield from self._ask(localizer, "print", *disguised, None)

    def from_afar(self, num_photos: int) -> Iterator[Taught]:
        """Ask about photos when nobody photographed anything near to them."""
        for image in _evenly(np.arange(len(self._full.images)), num_photos):
            apart = self._viewpoints.apart_from(self._viewpoints.pose(image))
            same = self._instants == self._instants[image]
            for within in _APART:
                left_out = np.flatnonzero((apart < within) | same)
                yield from self._ask_without(image, left_out, f"from afar {within}")

    def from_elsewhere(self, num_photos: int) -> Iterator[Taught]:
        """Ask about photos of a part of the place of which the map has nothing."""
        for image in _evenly(np.arange(len(self._full.images)), num_photos):
            left_out = np.flatnonzero(shares_place(self._full, self._viewpoints, image))
            yield from self._ask_without(image, left_out, "elsewhere")

    def painted(self, seed: int, num_photos: int) -> Iterator[Taught]:
        """Ask a map of the sample room about the same room, changed, and about other rooms."""
        localizer, rig = self._localizer(np.empty(0, np.int64)), stereo_rig(640, 480)
        origin = np.array(self._full.manifest.world.origin)
        places = [
            (mounted.camera, mounted.cam_from_rig @ pose)
            for pose in query_trajectory(num_photos, num_photos)
            for mounted in rig.values()
        ][::2]
        before: list[Image] = []
        for share in _REPAINTED:
            changed = np.flatnonzero(self._random.random(NUM_SURFACES) < share)
            scene = make_room(seed, frozenset(changed.tolist()), seed + 1000)
            photos = [render_photo(scene, *place, np.random.default_rng(0)) for place in places]
            before = before or photos
            for photo, old, (camera, pose) in zip(photos, before, places, strict=True):
                differs = np.abs(photo.astype(np.int16) - old).max(axis=2) > _CHANGED_GREY_LEVELS
                truth = Pose(pose.rotation, pose.translation + pose.rotation @ origin)
                if differs.mean() >= _OTHER_ROOM:
                    yield from self._ask(localizer, "other room", photo, camera, None)
                elif differs.mean() <= _SAME_ROOM:
                    yield from self._ask(localizer, "changed room", photo, camera, truth)

    def _parts(self) -> Iterator[NDArray[np.int64]]:
        for third in range(_THIRDS):
            yield np.flatnonzero(self._instants % _THIRDS == third)
        for quarter in _QUARTERS:
            yield np.flatnonzero(self._instants * 4 // (self._instants.max() + 1) == quarter)

    def _localizer(self, left_out: NDArray[np.int64]) -> Localizer:
        return Localizer(without(self._full, left_out), self._extractor)

    def _ask_without(self, image: int, left_out: NDArray[np.int64], kind: str) -> Iterator[Taught]:
        if len(self._full.images) - len(left_out) >= 4:
            yield from self._ask(self._localizer(left_out), kind, *self._taken(image))

    def _taken(self, image: int) -> tuple[Image, Camera, Pose]:
        record = self._full.images[image]
        rgb = read_photo_file(self._photos / record.name).rgb
        return rgb, self._full.cameras[record.camera], self._viewpoints.pose(image)

    def _scene(self) -> Image:
        return read_photo_file(self._foreign[int(self._random.integers(len(self._foreign)))]).rgb

    def _ask(
        self, localizer: Localizer, kind: str, rgb: Image, camera: Camera, truth: Pose | None
    ) -> Iterator[Taught]:
        """Find the best pose; without truth every pose is wrong."""
        options = LocalizeOptions()
        look = localizer.look(Photo(np.ascontiguousarray(rgb)), camera, options)
        if look.shown is None or len(look.matches.pixels) < _LEAST_MATCHES:
            return
        matches = look.matches
        view = MatchedView(look.evidence.camera, Pose.identity(), matches.pixels, matches.points)
        constraints = Constraints(localizer.geometry, NO_PRIORS)
        problem = Problem((view,), (look.evidence.camera_source,), options, constraints)
        pose = problem.solve()
        if pose is None or pose.covariance is None or pose.num_inliers < _LEAST_INLIERS:
            return
        right = self._is_right(pose.rig_from_world, truth)
        if right is not None:
            features = evidence_of(
                localizer.geometry,
                [SeenView(view, look.shown, pose.inliers[0])],
                pose.rig_from_world,
                pose.covariance,
                problem.registration.max_error_px,
            )
            refusal = first_refusal((*GATES, *CONFIRMATIONS), problem, pose)
            yield Taught(kind, right, refusal is None, features)

    def _is_right(self, pose: Pose, truth: Pose | None) -> bool | None:
        """Whether a pose is right; None when it is neither right nor clearly wrong."""
        if truth is None:
            return False
        away, turned = pose_error(pose, truth)
        off = max(away / (_RIGHT_OF_REACH * self._viewpoints.reach), turned / _RIGHT_DEG)
        return True if off <= 1.0 else None if off <= 2.0 else False


def _evenly(rows: NDArray[np.int64], count: int) -> list[int]:
    chosen = np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(np.int64)
    return [int(row) for row in rows[np.unique(chosen)]]
