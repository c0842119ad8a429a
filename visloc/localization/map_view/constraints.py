"""Where the photos of a map stand; by priors, which to search and which poses to refuse.

All coordinates are relative to the map's origin, where numbers are small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.archive import Manifest, Map, SetWorld, World
from visloc.archive.places import located
from visloc.errors import refuse
from visloc.features.resolution import Resolution, WorkingResolution
from visloc.geometry import Pose
from visloc.localization.map_view.local_model import LocalModel
from visloc.matching.products import EightBitRows
from visloc.pose.covariance import mahalanobis2, viewpoints_apart
from visloc.pose.generalized import MAX_FOCAL, MIN_FOCAL
from visloc.pose.gravity import KnownGravity, gravity_deviation
from visloc.pose.motion import PHOTO_ONLY, MapErrors, largest_std, with_origin
from visloc.pose.reprojection import MatchedView, normalized_rays
from visloc.priors import HEIGHT_REACH, POSE_PRIOR_STDS, REACH, GnssPrior, Priors

_LEAST_REACH = 1e-9  # of a map whose photos see nothing
# A pose contradicts a prior beyond this many of its own standard deviations.
_OWN_STDS = 3.0
# Chi-square with six degrees of freedom is above this once in 10 000 times.
_MAX_MAHALANOBIS2 = 27.86
# Largest angle between the down direction of a request and that of the map.
_MAX_DOWN_DIFFERENCE = math.radians(5.0)
_LEAST_TANGENT = 1e-12  # of the angle between a ray and the camera's axis
_NUM_REACH_PHOTOS, _NUM_REACH_LANDMARKS = 100, 200
# Of a map without landmarks: each photo takes a tenth of a second.
_NUM_REACH_TRIANGULATED = 10


def _errors_of(manifest: Manifest) -> MapErrors:
    """Return the errors that a map knows of itself.

    If its poses were estimated and then laid over given positions, the misfit shows how bent the
    map is, which its own photos cannot see. So the misfit is added. That to GNSS fixes is not,
    because fixes scatter by themselves.
    """
    test = manifest.parts.own_test
    if test is None:
        return PHOTO_ONLY
    anchor = manifest.world.anchor
    bent = anchor.rms if anchor is not None and anchor.kind == "positions" else None
    return MapErrors(
        test.position_factor,
        test.orientation_factor,
        position_std=(bent or 0.0) / math.sqrt(3.0),
    )


class Frame(Protocol):
    """What poses and priors refer to: the world of a map, or of many."""

    @property
    def world(self) -> World | SetWorld: ...

    @property
    def origin(self) -> NDArray[np.float64]:
        """(3,) where the frame's own coordinates begin, in its world."""

    @property
    def down(self) -> NDArray[np.float64] | None:
        """(3,) unit vector; None when unknown."""

    def leads_out(self, center: NDArray[np.float64]) -> float | None:
        """Return how far a centre (3,) is from the nearest photo, if that is out of its sight.

        ``center`` is relative to the origin; None within sight.
        """


class MapGeometry:
    """Where a map's photos were taken and how far they see; in the map's own coordinates."""

    def __init__(self, opened: Map) -> None:
        self.opened = opened
        self.origin = np.array(opened.manifest.world.origin)
        self.down = opened.gravity
        self._local: LocalModel | None = None
        if not opened.has_landmarks:
            self._local = LocalModel(opened, self.centers, self.rotations)
        self.errors = _errors_of(opened.manifest)

    @property
    def ref(self) -> str:
        """The map, ``id@version``."""
        return self.opened.ref

    @property
    def world(self) -> World:
        return self.opened.manifest.world

    def leads_out(self, center: NDArray[np.float64]) -> float | None:
        """Return how far a centre (3,) is from the nearest photo; None within its sight."""
        away = float(np.linalg.norm(self.centers - center, axis=1).min())
        return away if away > self.reach else None

    def photo_name(self, row: int) -> str:
        """Return the name of a photo of the map."""
        return self.opened.images[int(row)].name

    def observed(self, row: int) -> tuple[NDArray[np.integer], EightBitRows]:
        """Return the landmarks (m,) that a photo sees, and their descriptors."""
        landmarks, descriptors = self.opened.observations(int(row))
        if self._local is not None:
            placed = np.isfinite(self._local.of_photo(int(row))[:, 0])
            landmarks, descriptors = landmarks[placed], descriptors[placed]
        return landmarks, EightBitRows(
            descriptors, self.opened.manifest.local_features.descriptor_scale
        )

    def points(self, landmarks: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return landmarks (n, 3), relative to the origin.

        NaN for those of a map without landmarks that cannot be triangulated.
        """
        if self._local is not None:
            return self._local.points(landmarks)
        return np.asarray(np.take(self.opened.landmarks, landmarks, axis=0))

    def without(self, photos: NDArray[np.int64]) -> MapGeometry:
        """Return the same of a map without landmarks that does not have some photos (k,)."""
        if self._local is None:
            raise AssertionError("the landmarks of this map were made of all its photos")
        geometry = MapGeometry(self.opened)
        geometry._local = self._local.without(photos)
        geometry.reach, geometry.errors = self.reach, self.errors
        return geometry

    def nearest_photos(self, row: int, count: int) -> NDArray[np.int64]:
        """Return the photos taken most like one of them, itself first."""
        viewpoints = self.viewpoints
        apart = viewpoints.apart_from(viewpoints.pose(int(row)))
        return np.argsort(apart, kind="stable")[:count]

    @cached_property
    def viewpoints(self) -> Viewpoints:
        """Where the photos were taken, and which way they look, relative to the origin."""
        return Viewpoints(self.centers, self.rotations, max(self.reach, _LEAST_REACH))

    @cached_property
    def resolution(self) -> WorkingResolution:
        """The resolution that the photos have in common (pixels per radian)."""
        cameras = {key: Resolution.of(camera) for key, camera in self.opened.cameras.items()}
        photos = [cameras[image.camera] for image in self.opened.images]
        features = self.opened.manifest.local_features.fingerprint
        return WorkingResolution.of(photos, features.parameters)

    @cached_property
    def rotations(self) -> NDArray[np.float64]:
        """(n, 3, 3) cameras of the photos from the world."""
        rotations = Rotation.from_quat(self.opened.image_poses[:, :4], scalar_first=True)
        return np.asarray(rotations.as_matrix())

    @cached_property
    def centers(self) -> NDArray[np.float64]:
        """(n, 3) camera centres of the photos, relative to the origin."""
        poses = self.opened.image_poses
        rotations = Rotation.from_quat(poses[:, :4], scalar_first=True)
        return np.asarray(-rotations.inv().apply(poses[:, 4:]) - self.origin)

    @cached_property
    def reach(self) -> float:
        """Median distance from photos to the landmarks that they see, in units of the world."""
        num_photos = len(self.centers)
        distances = []
        offsets = self.opened.observation_offsets
        most = _NUM_REACH_PHOTOS if self._local is None else _NUM_REACH_TRIANGULATED
        for photo in range(0, num_photos, max(1, num_photos // most)):
            start, stop = int(offsets[photo]), int(offsets[photo + 1])
            step = max(1, (stop - start) // _NUM_REACH_LANDMARKS)
            points = self.points(self.opened.observation_landmarks[start:stop:step])
            away = points[np.isfinite(points[:, 0])].astype(np.float64) - self.centers[photo]
            if len(away):
                distances.append(float(np.median(np.linalg.norm(away, axis=1))))
        return float(np.median(distances)) if distances else 0.0


class PosePriors:
    """The priors of one query in one frame: whether a pose obeys them.

    Args:
        frame: the frame.
    """

    def __init__(self, frame: Frame, priors: Priors) -> None:
        self._origin = frame.origin
        if priors.gnss is not None:
            priors = located(priors, frame.world)
        self._priors = priors
        gravity = priors.gravity
        down = frame.down
        if gravity is not None and gravity.world is not None:
            if down is not None and gravity.world @ down < math.cos(_MAX_DOWN_DIFFERENCE):
                raise refuse(
                    "priors.gravity",
                    field="priors.gravity.world",
                    expected=f"none, or {' '.join(f'{x:.3f}' for x in down)}",
                    got=" ".join(f"{x:.3f}" for x in gravity.world),
                )
            down = gravity.world
        band = priors.height
        if down is None and (gravity is not None or (band is not None and band.down is None)):
            name = "gravity" if gravity is not None else "height"
            raise refuse(
                f"priors.{name}",
                "the down direction of this map is unknown",
                field=f"priors.{name}",
                expected="a map that was built with --gravity, or priors.gravity with its world",
            )
        self.gravity = (
            None
            if gravity is None or down is None
            else KnownGravity(gravity.direction, down, gravity.std)
        )
        if band is not None and band.down is not None:
            down = np.array(band.down)
        self._up = None if down is None else -down  # that heights are measured along
        self._pose = None
        if priors.pose is not None:
            self._pose = with_origin(
                priors.pose.device_from_world, priors.pose.covariance, -frame.origin
            )

    def contradiction(self, pose: Pose, covariance: NDArray[np.float64]) -> str | None:
        """Say which prior a pose contradicts, and by how much; None when it obeys all.

        Args:
            pose: ``device_from_world`` relative to the origin.
            covariance: (6, 6) of it, the errors of the map included.
        """
        own = _OWN_STDS * largest_std(pose, covariance)
        center = pose.center + self._origin
        position = self._priors.position
        if position is not None:
            away = float(np.linalg.norm(center - position.position))
            if away > position.radius + own:
                return (
                    f"it lies {away:.2f} from the prior position, but at most "
                    f"{position.radius:g} is allowed"
                )
        fix = self._priors.gnss
        if fix is not None:
            beyond = float(fix.beyond(center[None])[0]) / _metres(fix)
            if beyond > own:
                return f"it lies {beyond:.2f} outside what the GNSS prior allows"
        band = self._priors.height
        if band is not None and self._up is not None:
            height = float(center @ self._up)
            if not band.min - own <= height <= band.max + own:
                return (
                    f"its height is {height:.2f}, but the prior says {band.min:g} to {band.max:g}"
                )
        if self.gravity is not None:
            angle = gravity_deviation(pose, self.gravity)
            allowed = _OWN_STDS * math.hypot(
                self.gravity.std, math.sqrt(covariance[:3, :3].trace())
            )
            if angle > allowed:
                return (
                    f"its down direction is {math.degrees(angle):.2g} degrees from the prior "
                    f"gravity, but at most {math.degrees(allowed):.2g} is allowed"
                )
        if self._pose is not None:
            excess = mahalanobis2(pose, covariance, *self._pose)
            if excess > _MAX_MAHALANOBIS2:
                away = float(np.linalg.norm(pose.center - self._pose[0].center))
                turned = Rotation.from_matrix(pose.rotation @ self._pose[0].rotation.T).magnitude()
                return (
                    f"it lies {away:.2f} and {math.degrees(turned):.1f} degrees from the prior "
                    f"pose, which is {math.sqrt(excess):.0f} combined standard deviations"
                )
        return None

    def near_pose_prior(
        self, views: Sequence[MatchedView], max_error_px: float
    ) -> list[MatchedView] | None:
        """Keep the correspondences that a pose within the pose prior can explain.

        If the focal length is unknown, any plausible one may explain them.

        Returns:
            The views with fewer correspondences; None without a pose prior.
        """
        if self._pose is None:
            return None
        pose, covariance = self._pose
        turn = POSE_PRIOR_STDS * math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
        move = POSE_PRIOR_STDS * largest_std(pose, covariance)
        kept = []
        for view in views:
            seen = (view.cam_from_rig @ pose).apply(view.points)
            # The angle between where the landmark should be and where it was seen.
            expected = seen / np.linalg.norm(seen, axis=1, keepdims=True)
            if view.focal_unknown:
                rays = _nearest_rays(view, expected)
            else:
                rays = normalized_rays(view.camera, view.pixels)
            angle = _angles(expected, rays / np.linalg.norm(rays, axis=1, keepdims=True))
            depth = np.linalg.norm(seen, axis=1)
            slack = max_error_px / view.camera.focal_length
            near = angle <= turn + slack + np.arctan2(move, depth)
            kept.append(replace(view, pixels=view.pixels[near], points=view.points[near]))
        return kept


class Constraints(PosePriors):
    """The priors of one query in one map.

    Args and errors are those of ``PosePriors``.
    """

    def __init__(self, geometry: MapGeometry, priors: Priors) -> None:
        super().__init__(geometry, priors)
        self.geometry = geometry

    @property
    def errors(self) -> MapErrors:
        """The map's own errors, which widen every covariance."""
        return self.geometry.errors

    @property
    def narrow(self) -> bool:
        """Whether the priors exclude photos or poses from the search."""
        priors = self._priors
        return any((priors.position, priors.height, priors.pose, priors.gravity, priors.gnss))

    @cached_property
    def photo_weights(self) -> NDArray[np.float64] | None:
        """Return weights (n,) of the map's photos, 0 to 1; None when all count the same."""
        spheres = []
        if self._priors.position is not None:
            prior = self._priors.position
            spheres.append((prior.position - self.geometry.origin, prior.radius))
        if self._pose is not None:
            spheres.append((self._pose[0].center, POSE_PRIOR_STDS * largest_std(*self._pose)))
        if not spheres and self._priors.height is None and self._priors.gnss is None:
            return None
        centers = self.geometry.centers
        weights = np.ones(len(centers))
        reach = max(self.geometry.reach, _LEAST_REACH)
        for center, radius in spheres:
            beyond = (np.linalg.norm(centers - center, axis=1) - radius) / reach
            weights *= _weight(beyond)
        fix = self._priors.gnss
        if fix is not None:
            weights *= _weight(fix.beyond(centers + self.geometry.origin) / (_metres(fix) * reach))
        band = self._priors.height
        if band is not None and self._up is not None:
            slack = HEIGHT_REACH * (band.max - band.min)
            heights = (centers + self.geometry.origin) @ self._up
            weights[(heights < band.min - slack) | (heights > band.max + slack)] = 0.0
        return weights


def _weight(beyond: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much photos (n,) count that lie so far outside an area, in viewing distances."""
    return np.where(beyond <= REACH, np.exp(-0.5 * np.maximum(beyond, 0.0) ** 2), 0.0)


def _metres(fix: GnssPrior) -> float:
    """Return the metres in a unit of the world."""
    assert fix.fix_from_world is not None  # by ``located``
    return fix.fix_from_world.scale


def _nearest_rays(view: MatchedView, expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return, over all focal lengths, the ray of each pixel that is nearest to an expected ray.

    Args:
        view: of an unknown focal length.
        expected: (n, 3) of length 1, in the camera's frame.

    Returns:
        (n, 3) of length 1. With the focal length, a pixel's ray turns in a plane, from the optical
        axis to the side.
    """
    across = normalized_rays(view.camera, view.pixels)[:, :2]
    tangent = np.linalg.norm(across, axis=1)
    side = across / np.maximum(tangent, _LEAST_TANGENT)[:, None]
    focal = view.camera.focal_length / max(view.camera.width, view.camera.height)
    angle = np.clip(
        np.arctan2(np.einsum("ni,ni->n", side, expected[:, :2]), expected[:, 2]),
        np.arctan(tangent * focal / MAX_FOCAL),
        np.arctan(tangent * focal / MIN_FOCAL),
    )
    return np.column_stack([np.sin(angle)[:, None] * side, np.cos(angle)])


def _angles(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (n,) between unit vectors (n, 3), rad."""
    return np.asarray(
        np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ni,ni->n", a, b))
    )


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoints:
    """The mapping photos' poses, relative to the map's origin.

    Attributes:
        centers: (n, 3) float64.
        rotations: (n, 3, 3) float64, camera from world.
        reach: median distance from photos to what they see, units of the world; above 0.
    """

    centers: NDArray[np.float64]
    rotations: NDArray[np.float64]
    reach: float

    def __len__(self) -> int:
        return len(self.centers)

    def of(self, images: NDArray[np.int64]) -> Viewpoints:
        """Return the viewpoints of some photos."""
        return Viewpoints(self.centers[images], self.rotations[images], self.reach)

    def pose(self, image: int) -> Pose:
        """``cam_from_local`` of one photo."""
        rotation = self.rotations[image]
        return Pose(rotation, -rotation @ self.centers[image])

    def apart_from(self, pose: Pose) -> NDArray[np.float64]:
        """Return the distance (n,) of each photo from a pose, in radians (``viewpoints_apart``)."""
        return viewpoints_apart(self.rotations, self.centers, pose, self.reach)
