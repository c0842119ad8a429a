"""Whether the matches of photos agree with the poses and the depth maps of their dataset.

Matches alone determine the rotation between two photos, and the direction from one camera to the
other. Poses of another convention contradict both in most pairs. The conventions of other programs
are tried, and the one that makes poses and matches agree names the mistake. Noise of positions
turns the directions between near photos most, so those between the farther ones are compared.

Matches and poses together determine depth, and depth maps of another unit contradict it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.methods.matching.two_views import relative_pose
from mapping.methods.rgbd import lift_keypoints
from mapping.pairing.retrieval import most_alike
from mapping.progress import ItemProgress
from mapping.stages.context import BuildContext
from mapping.stages.local_features import LocalFeaturesSource
from mapping.stages.photos import MappingPhoto
from visloc.archive import GlobalFeatures
from visloc.archive.schema import Doubt
from visloc.geometry import Pose, rotation_angle
from visloc.kapture import Dataset
from visloc.matching.correspondences import mutual_nearest_neighbours
from visloc.matching.products import round_descriptors
from visloc.matching.verification import epipolar_errors
from visloc.pose.reprojection import normalized_rays
from visloc.pose_conventions import READINGS

STAGE = "given poses"
# Photos that are asked, evenly chosen, and partners of each among those that look most like it.
_ASKED, _PARTNERS, _MOST_ALIKE = 60, 2, 10
_MAX_ERROR_PX = 4.0
# Fewer matches, photos or pairs do not tell.
_LEAST_MATCHES, _LEAST_PHOTOS, _LEAST_PAIRS = 30, 4, 5
# Between rays at smaller angles, matches do not fix the direction of the other camera.
_LEAST_PARALLAX_DEG = 2.0
# A degree of rotation weighs as much as ten of direction, which is measured less well.
_DIRECTION_WEIGHT = 0.1
# A reading is named if it leaves a third of the disagreement, and little of it. Right poses leave
# 0.2 to 2.0 degrees, and no reading of them leaves less than three times as much (red kitchen,
# castle, kitti_curve, gardenspoint, virtual gallery, the sample).
_NAMED_SHARE, _NAMED_MOST, _NAMED_LESS = 1 / 3, 4.0, 0.4
# Medians that contradict the poses whatever other reading fits. Noise of 20 cm and one degree gives
# 2.6 and at most 45 degrees there.
_ROTATION_DEG, _DIRECTION_DEG = 5.0, 75.0
# Few matches of a wall fit many relative poses. They contradict poses only if less than this part
# of them fits, to this share of the longer side (``mapping.methods.sparse.pair_agreement``).
_LEAST_FITTING, _ABOUT = 0.4, 0.01
# Around closed ways of pairs, rotations add up to less than this if the photos overlap. What photos
# of a repeating floor have in common tells of rotations that have nothing to do with one another.
_CLOSED_DEG = 15.0
# Depth that fits the poses to less than this share is right. Kinect's is 1 to 2 % off.
_DEPTH_OFF = 0.05
# Only pairs whose relative pose is the given one to within this rotation tell of depth.
_AGREEING_DEG = 3.0
_STANDARD_ERRORS = 4.0
_MAX_NAMES = 100
_ALONG_RAY = "the distance along the ray"


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Two photos, as their matches have them.

    Attributes:
        b_from_a: pose of the second camera in the first one's frame, one unit away.
        pixels: (k, 2) of matches in the first photo.
        distances: (k,) their depth in the first photo, in distances between the cameras.
        rays: (n, 3) of all matches that fit, in the first camera and in the second.
        about: how far rays may miss each other at depth 1 without contradicting poses.
    """

    first: int
    second: int
    b_from_a: Pose
    parallax_deg: float
    pixels: NDArray[np.float32]
    distances: NDArray[np.float64]
    rays: tuple[NDArray[np.float64], NDArray[np.float64]]
    about: float


@dataclass(frozen=True, slots=True, eq=False)
class _Written:
    """The pose of a photo as the dataset has it: of its camera, or of the rig that carries it."""

    device: str
    timestamp: int
    camera_from_device: Pose
    device_from_world: Pose


def doubts_about_given(
    context: BuildContext,
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    global_features: Sequence[GlobalFeatures],
    depth_scale: float | None = None,
) -> tuple[Doubt, ...]:
    """Return what matches say against the given poses, or else against the depth maps.

    Args:
        depth_scale: metres per unit of PNG depth maps; None where depth is not used.
    """
    written = [_written(dataset, photo) for photo in photos]
    asked = [
        (photos[a], photos[b], a, b)
        for a, b in _pairs(global_features)
        if (written[a].device, written[a].timestamp) != (written[b].device, written[b].timestamp)
    ]
    measure = partial(_measured, context.features)
    progress: ItemProgress = partial(context.progress, STAGE)
    pairs = [each for each in context.workers.run_here(measure, asked, progress) if each]
    involved = {row for pair in pairs for row in (pair.first, pair.second)}
    if len(pairs) < _LEAST_PAIRS or len(involved) < _LEAST_PHOTOS:
        return ()
    doubt = _doubt_about_poses(photos, written, pairs)
    if doubt is None and depth_scale is not None:
        doubt = _doubt_about_depth(dataset, photos, pairs, depth_scale)
    return () if doubt is None else (doubt,)


def readings_of(
    dataset: Dataset, photos: Sequence[MappingPhoto]
) -> Mapping[str, Callable[[], list[Pose]]]:
    """Return the poses of all photos as other conventions have them, by the name of each."""
    return _readings([_written(dataset, photo) for photo in photos])


def _written(dataset: Dataset, photo: MappingPhoto) -> _Written:
    record = photo.record
    for rig in dataset.rigs_of(record.sensor_id):
        camera_from_rig = dataset.rigs[rig][record.sensor_id]
        rig_from_world = dataset.trajectories.get((record.timestamp, rig))
        own = dataset.trajectories.get((record.timestamp, record.sensor_id))
        if own is None and camera_from_rig is not None and rig_from_world is not None:
            return _Written(rig, record.timestamp, camera_from_rig, rig_from_world)
    return _Written(record.sensor_id, record.timestamp, Pose.identity(), photo.pose)


def _pairs(global_features: Sequence[GlobalFeatures]) -> list[tuple[int, int]]:
    """Return pairs of photos that look alike, each once."""
    tables = [each.descriptors for each in global_features]
    count = len(tables[0])
    asked = np.unique(np.linspace(0, count - 1, min(count, _ASKED)).round().astype(np.int64))
    photos, others, _ = most_alike(tables, asked, _MOST_ALIKE)
    random, found = np.random.default_rng(0), set()
    for photo in asked.tolist():
        partners = others[photos == photo]
        for other in random.permutation(partners)[:_PARTNERS].tolist():
            found.add((min(photo, other), max(photo, other)))
    return sorted(found)


def _measured(
    features: LocalFeaturesSource, asked: tuple[MappingPhoto, MappingPhoto, int, int]
) -> _Pair | None:
    a, b, first, second = asked
    own, theirs = features.read(a), features.read(b)
    rows = mutual_nearest_neighbours(
        round_descriptors(own.descriptors), round_descriptors(theirs.descriptors)
    )
    pixels = own.keypoints[rows[0]], theirs.keypoints[rows[1]]
    if (a.camera.width, a.camera.height) == (b.camera.width, b.camera.height):
        # What keeps its pixel may be fixed to the picture, such as a logo or part of a vehicle.
        moves = np.linalg.norm(pixels[0] - pixels[1], axis=1) > _MAX_ERROR_PX
        pixels = pixels[0][moves], pixels[1][moves]
    found = relative_pose((a.camera, b.camera), *pixels, _MAX_ERROR_PX)
    if found is None or found[1].sum() < _LEAST_MATCHES:
        return None
    b_from_a, fits = found
    rays_a, rays_b = (
        normalized_rays(photo.camera, each[fits])
        for photo, each in zip((a, b), pixels, strict=True)
    )
    turned = rays_a @ b_from_a.rotation.T
    cosines = np.einsum("ij,ij->i", turned, rays_b) / (
        np.linalg.norm(turned, axis=1) * np.linalg.norm(rays_b, axis=1)
    )
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    clear = angles > _LEAST_PARALLAX_DEG
    distances = _distances(turned[clear], rays_b[clear], b_from_a.translation)
    pixels_a = pixels[0][fits][clear]
    longest = max(a.camera.width, a.camera.height, b.camera.width, b.camera.height)
    about = _ABOUT * longest / min(a.camera.focal_length, b.camera.focal_length)
    parallax_deg = float(np.median(angles))
    rays = rays_a, rays_b
    return _Pair(first, second, b_from_a, parallax_deg, pixels_a, distances, rays, about)


def _distances(
    turned: NDArray[np.float64], rays: NDArray[np.float64], way: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return s (n,) of the nearest points of s turned + way and r rays."""
    aa, bb, ab = (
        np.einsum("ij,ij->i", p, q) for p, q in ((turned, turned), (rays, rays), (turned, rays))
    )
    return np.asarray((ab * (rays @ way) - bb * (turned @ way)) / (aa * bb - ab**2))


def _doubt_about_poses(
    photos: Sequence[MappingPhoto], written: Sequence[_Written], pairs: Sequence[_Pair]
) -> Doubt | None:
    given = [photo.pose for photo in photos]
    rotation_deg, direction_deg = _disagreement(given, pairs)
    total = rotation_deg + _DIRECTION_WEIGHT * direction_deg
    left = {
        name: rotation + _DIRECTION_WEIGHT * direction
        for name, read in _readings(written).items()
        for rotation, direction in [_disagreement(read(), pairs)]
    }
    name = min(left, key=lambda each: left[each])
    is_named = left[name] <= min(_NAMED_SHARE * total, _NAMED_MOST, total - _NAMED_LESS)
    if not is_named and (
        (rotation_deg <= _ROTATION_DEG and direction_deg <= _DIRECTION_DEG)
        or _median([_fitting(given, pair) for pair in pairs], pairs) >= _LEAST_FITTING
        or not _agree_with_each_other(pairs)
    ):
        return None
    advice = (
        f"They look like {name}."
        if is_named
        else "No usual convention explains them. Do they belong to these photos?"
    )
    message = (
        f"the matches of {len(pairs)} pairs of photos contradict the given poses, by "
        f"{rotation_deg:.1f} degrees of rotation and {direction_deg:.0f} of direction in "
        f"the median. {advice} Poses must be cam_from_world: world to camera, x right, y down, "
        "z forward (docs/conventions.md)"
    )
    errors = np.array([_errors(given, pair)[0] for pair in pairs])
    worst = [pairs[row] for row in np.argsort(-errors, kind="stable")]
    names = dict.fromkeys(photos[row].name for pair in worst for row in (pair.first, pair.second))
    return Doubt(kind="poses", message=message, photos=tuple(names)[:_MAX_NAMES])


def _readings(written: Sequence[_Written]) -> Mapping[str, Callable[[], list[Pose]]]:
    def read(reading: Callable[[Pose], Pose]) -> list[Pose]:
        return [one.camera_from_device @ reading(one.device_from_world) for one in written]

    def moved(steps: int) -> list[Pose]:
        poses = {(one.device, one.timestamp): one.device_from_world for one in written}
        instants: dict[str, list[int]] = {}
        for device, timestamp in sorted(poses):
            instants.setdefault(device, []).append(timestamp)
        there = {
            (device, instant): poses[device, own[(place + steps) % len(own)]]
            for device, own in instants.items()
            for place, instant in enumerate(own)
        }
        return [one.camera_from_device @ there[one.device, one.timestamp] for one in written]

    return {
        **{name: partial(read, reading) for name, reading in READINGS.items()},
        "the poses of the next photo": partial(moved, -1),
        "the poses of the photo before": partial(moved, 1),
    }


def _disagreement(poses: Sequence[Pose], pairs: Sequence[_Pair]) -> tuple[float, float]:
    """Return the median errors of poses in degrees: of rotations, and of directions."""
    errors = np.array([_errors(poses, pair) for pair in pairs])
    rotation_deg = _median(errors[:, 0], pairs)
    clear = [row for row, pair in enumerate(pairs) if pair.parallax_deg > _LEAST_PARALLAX_DEG]
    if not clear:
        return rotation_deg, 0.0
    least = np.median(errors[clear, 2])
    far = [row for row in clear if errors[row, 2] >= least]
    return rotation_deg, _median(errors[far, 1], [pairs[row] for row in far])


def _agree_with_each_other(pairs: Sequence[_Pair]) -> bool:
    """Tell whether rotations add up around closed ways of pairs; so they do where there are none.

    Pairs of most matches come first. Those that join no photos close a way.
    """
    rotations: dict[int, NDArray[np.float64]] = {}  # of each photo, in the frame of its group
    groups: dict[int, list[int]] = {}
    errors_deg, closing = [], []
    for pair in sorted(pairs, key=lambda each: -len(each.rays[0])):
        for row in (pair.first, pair.second):
            rotations.setdefault(row, np.eye(3))
            groups.setdefault(row, [row])
        second = pair.b_from_a.rotation @ rotations[pair.first]
        correction = rotations[pair.second].T @ second
        first_group, second_group = groups[pair.first], groups[pair.second]
        if first_group is second_group:
            errors_deg.append(math.degrees(rotation_angle(correction)))
            closing.append(pair)
            continue
        for row in second_group:
            rotations[row] = rotations[row] @ correction
            groups[row] = first_group
        first_group.extend(second_group)
    return not closing or _median(errors_deg, closing) <= _CLOSED_DEG


def _median(values: ArrayLike, pairs: Sequence[_Pair]) -> float:
    """Return the median of a value (n,) of n pairs, each weighed by its matches.

    Pairs of few matches are more often of places that look alike.
    """
    each = np.asarray(values, np.float64)
    order = np.argsort(each)
    weights = np.cumsum([len(pairs[row].rays[0]) for row in order])
    return float(each[order[np.searchsorted(weights, weights[-1] / 2)]])


def _fitting(poses: Sequence[Pose], pair: _Pair) -> float:
    """Return the share of a pair's matches that fit poses."""
    b_from_a = poses[pair.second] @ poses[pair.first].inverse()
    return float(np.mean(epipolar_errors(*pair.rays, b_from_a) <= pair.about))


def _errors(poses: Sequence[Pose], pair: _Pair) -> tuple[float, float, float]:
    """Return the errors of rotation and direction in degrees, and the length of the way."""
    b_from_a = poses[pair.second] @ poses[pair.first].inverse()
    length = float(np.linalg.norm(b_from_a.translation))
    rotation = rotation_angle(b_from_a.rotation @ pair.b_from_a.rotation.T)
    cosine = float(b_from_a.translation @ pair.b_from_a.translation) / max(length, 1e-12)
    return math.degrees(rotation), math.degrees(math.acos(min(max(cosine, -1), 1))), length


def _doubt_about_depth(
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    pairs: Sequence[_Pair],
    depth_scale: float,
) -> Doubt | None:
    """Compare the ways between cameras that depth tells with those of the poses.

    A pair's matches tell depth in units of its way, so each depth tells the way. The slope of given
    ways over these is 1. Noise of the given positions is in the former only, and cancels.
    """
    ways, given, stretches, slants = [], [], [], []
    poses = [photo.pose for photo in photos]
    for pair in pairs:
        # Few matches of a wall may have a relative pose far from the given one, which fits as well.
        rotation_deg, direction_deg, _ = _errors(poses, pair)
        if rotation_deg > _AGREEING_DEG or direction_deg > _AGREEING_DEG / _DIRECTION_WEIGHT:
            continue
        photo = photos[pair.first]
        lifted = lift_keypoints(dataset, photo, pair.pixels, depth_scale)
        if len(lifted.rows) < _LEAST_MATCHES:
            continue
        depths = photo.pose.apply(lifted.points)[:, 2]
        all_ways = depths / pair.distances[lifted.rows]
        way = float(np.median(all_ways))
        if not way > 0:
            continue
        b_from_a = poses[pair.second] @ poses[pair.first].inverse()
        ways.append(way)
        given.append(float(b_from_a.translation @ pair.b_from_a.translation))
        rays = normalized_rays(photo.camera, lifted.pixels)
        good = all_ways > 0
        stretches.append(np.log(all_ways[good] / way))
        slants.append(np.log(np.linalg.norm(rays[good], axis=1)))
    if len(ways) < _LEAST_PAIRS:
        return None
    factor, error = _factor(np.array(ways), np.array(given))
    off = abs(math.log(factor))
    if off <= _DEPTH_OFF + _STANDARD_ERRORS * error:
        return None
    message = (
        f"the depth maps contradict the poses: by matches of {len(ways)} pairs of photos, depth is "
        f"{factor:.4g} times what it should be"
    )
    if _is_along_ray(np.concatenate(stretches), np.concatenate(slants), factor):
        message += f". It looks like {_ALONG_RAY}; depth must be along the optical axis (z)"
    else:
        message += (
            ". Is the unit of the depth maps or of the poses another? For PNG, --depth-scale "
            f"{depth_scale / factor:.3g} would fit; raw maps are in the unit of the poses"
        )
    return Doubt(kind="depth", message=message)


def _factor(ways: NDArray[np.float64], given: NDArray[np.float64]) -> tuple[float, float]:
    """Return how much longer ways by depth are than given ones, and its relative error.

    The weighted median of their ratios, and the error of the slope by the median deviation.
    """
    order = np.argsort(given / ways)
    weights = np.cumsum(ways[order] ** 2)
    slope = float((given / ways)[order][np.searchsorted(weights, weights[-1] / 2)])
    if slope <= 0:
        return math.inf, math.inf
    # Of a normal distribution: the standard deviation, and how much wider a median scatters.
    deviation = 1.4826 * float(np.median(np.abs(given - slope * ways)))
    return 1 / slope, 1.2533 * deviation / (slope * math.sqrt(float(ways @ ways)))


def _is_along_ray(
    stretches: NDArray[np.float64], slants: NDArray[np.float64], factor: float
) -> bool:
    """Tell whether depth grows towards the edges of photos as distances along rays do."""
    scatter = [
        float(np.median(np.abs(rest - np.median(rest)))) for rest in (stretches, stretches - slants)
    ]
    mean_slant = math.exp(float(np.median(slants)))
    return scatter[1] < scatter[0] and abs(math.log(factor / mean_slant)) <= _DEPTH_OFF
