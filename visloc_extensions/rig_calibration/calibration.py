"""Where cameras sit on a rig, estimated from posed photos.

At every instant at which two cameras took photos with poses, those poses give one sample of where
one camera is in the frame of the other. A rig has one such relative pose; the samples scatter
around it by the errors of the poses, and a few are far off. So it is estimated by medians: the L1
mean of the rotations (Hartley, Aftab, Trumpf 2011: L1 rotation averaging using the Weiszfeld
algorithm) and the geometric median of the camera centres in the frame of the other camera. Unlike
the translation of ``b_from_a``, a centre there does not depend on how camera b is turned, so that
an error of its rotation does not move it. Humenberger et al. 2020 estimated the rigs of Extended
CMU-Seasons and SILDa from their mapping poses too; how they averaged is not said.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.errors import VislocError, refuse
from visloc.geometry import Pose
from visloc.kapture import Dataset
from visloc.kapture.writer import write_rigs

# Fewer instants cannot tell a good sample from a bad one.
MIN_INSTANTS = 3
# A sample this many times further off than the median is an outlier. Errors that are normal along
# three axes exceed it once in 10 000 times.
OUTLIER_MULTIPLE = 3.0
# Cameras that are no rig turn and move on their own. Poses of photos are hardly ever off by 5
# degrees in the median.
MAX_ROTATION_DEG = 5.0
# Median deviation of a position, of the larger of two lengths: the distance between the cameras,
# and how far they move from one instant to the next. Cameras close together have no distance to
# compare with; cameras that move on their own, or whose photos are not of the same time, differ
# by as much as they move.
MAX_POSITION_SHARE = 0.25
MAX_CAMERAS = 64

_MAX_STEPS = 200
_MAX_CANDIDATES = 100
# Deviations below are round-off; of lengths, as a part of the largest coordinate.
_ROUND_OFF_RAD, _ROUND_OFF_PART = 1e-8, 1e-11


@dataclass(frozen=True, slots=True)
class Spread:
    """How far samples are from their estimate: the median and the 90 % quantile."""

    median: float
    p90: float


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """One camera in the frame of another, estimated over instants.

    Attributes:
        outliers: those further off than ``OUTLIER_MULTIPLE`` times the median, in rotation or in
            position.
        rotation_deg: deviation of the rotations, degrees.
        position: deviation of the camera centre in the frame of the other, units of the world.
    """

    pose: Pose
    instants: int
    outliers: int
    rotation_deg: Spread
    position: Spread


@dataclass(frozen=True, slots=True, eq=False)
class MountedCamera:
    """A camera of a calibrated rig.

    Attributes:
        relative_to: the camera that it was compared with; None for the reference camera.
        relative: how they compared; None for the reference camera.
    """

    cam_from_rig: Pose
    relative_to: str | None
    relative: RelativePose | None


@dataclass(frozen=True, slots=True, eq=False)
class RigCalibration:
    """A rig whose frame is that of its reference camera.

    Attributes:
        reference: id of the camera at the identity.
        notes: what a reader should know, one sentence each.
    """

    rig: str
    reference: str
    cameras: Mapping[str, MountedCamera]
    notes: tuple[str, ...]


def calibrate_rig(
    dataset: Dataset,
    *,
    rig: str = "rig",
    reference: str | None = None,
    cameras: Sequence[str] | None = None,
) -> RigCalibration:
    """Estimate ``cam_from_rig`` of cameras from the poses of their photos.

    A camera that has no instants in common with the reference is compared with one that has, and
    so on: of all chains, the one whose links rest on most instants.

    Args:
        reference: the camera that is the frame of the rig; None: the one that shares most instants
            with the others, of equal ones the first by id.
        cameras: ids of its cameras; None: all cameras of the dataset.
    """
    if not rig or rig in dataset.sensors:
        raise refuse(
            "rig.id",
            "this is not a valid id of a rig",
            field="--rig",
            expected="an id that no sensor has",
            got=rig,
        )
    names = _chosen(dataset, cameras)
    if reference is not None and reference not in names:
        raise refuse(
            "rig.reference", field="--reference", expected=f"one of {_some(names)}", got=reference
        )
    poses, notes = _poses_of(dataset, names)
    shared = _shared_instants(poses)
    if reference is None:
        row = int(np.argmax(shared.sum(axis=1)))  # the first of equal ones, and they are sorted
        reference = names[row]
    links = _links(names, shared, reference)
    unconnected = [name for name in names if name not in links]
    if unconnected:
        raise _unconnected(dataset, names, shared, unconnected)
    mounted = {reference: MountedCamera(Pose.identity(), None, None)}
    for name, other in links.items():
        if other is not None:
            with np.errstate(over="ignore", invalid="ignore"):  # refused then, not warned of
                relative = _relative_pose(poses[other], poses[name])
                _refuse_loose(dataset, (name, other), relative, poses[other])
            cam_from_rig = relative.pose @ mounted[other].cam_from_rig
            mounted[name] = MountedCamera(cam_from_rig, other, relative)
    return RigCalibration(rig, reference, mounted, notes)


def refuse_known_rigs(output: Path) -> None:
    """Refuse to write rigs where there is something."""
    if output.exists() or output.is_symlink():
        raise refuse("rig.exists", field=str(output))


def write_calibration(calibration: RigCalibration, output: Path) -> None:
    """Write a rig as kapture's ``rigs.txt``, complete or not at all."""
    refuse_known_rigs(output)
    members = {name: one.cam_from_rig for name, one in calibration.cameras.items()}
    write_rigs(output, {calibration.rig: members})


def _chosen(dataset: Dataset, cameras: Sequence[str] | None) -> list[str]:
    known = sorted(key for key, sensor in dataset.sensors.items() if sensor.kind == "camera")
    names = sorted(known if cameras is None else cameras)
    unknown = [name for name in names if name not in known]
    if unknown or len(set(names)) < len(names) or len(names) < 2:
        raise refuse(
            "rig.cameras",
            "the dataset does not have these cameras"
            if unknown
            else "a rig needs at least two cameras, each named once",
            field="--cameras",
            expected=f"two or more of {_some(known)}" if len(known) > 1 else "two cameras or more",
            got=_some(unknown or names) or "none",
        )
    if len(names) > MAX_CAMERAS:
        raise refuse(
            "rig.too_many_cameras",
            field="--cameras",
            expected=f"at most {MAX_CAMERAS}",
            got=len(names),
        )
    return names


def _poses_of(
    dataset: Dataset, names: Sequence[str]
) -> tuple[dict[str, dict[int, Pose]], tuple[str, ...]]:
    """``cam_from_world`` by camera and timestamp, and notes."""
    poses: dict[str, dict[int, Pose]] = {name: {} for name in names}
    num_through_rig = 0
    for record in dataset.images:
        if record.sensor_id in poses and (pose := dataset.pose(record)) is not None:
            poses[record.sensor_id][record.timestamp] = pose
            num_through_rig += (record.timestamp, record.sensor_id) not in dataset.trajectories
    if not num_through_rig:
        return poses, ()
    num_all = sum(len(one) for one in poses.values())
    return poses, (
        f"{num_through_rig} of {num_all} poses are those of a rig that the dataset knows, "
        "so they repeat what its rigs.txt says",
    )


def _shared_instants(poses: Mapping[str, Mapping[int, Pose]]) -> NDArray[np.int64]:
    """(k, k) numbers of instants at which two cameras have poses; 0 on the diagonal."""
    row_of_instant = {
        instant: row for row, instant in enumerate(sorted(set().union(*poses.values())))
    }
    present = np.zeros((len(row_of_instant), len(poses)))
    for column, instants in enumerate(poses.values()):
        present[[row_of_instant[instant] for instant in instants], column] = 1
    shared = (present.T @ present).astype(np.int64)
    np.fill_diagonal(shared, 0)
    return shared


def _links(
    names: Sequence[str], shared: NDArray[np.int64], reference: str
) -> dict[str, str | None]:
    """Return which camera each camera is compared with, nearest to the reference first.

    The variance of an average over n instants is proportional to 1 / n, and variances add up along
    a chain. So the links are the tree of shortest paths from the reference, where a link between
    two cameras with n shared instants has the length 1 / n.
    """
    links: dict[str, str | None] = {}
    queue: list[tuple[float, str, str | None]] = [(0.0, reference, None)]
    while queue:
        length, name, other = heapq.heappop(queue)
        if name in links:
            continue
        links[name] = other
        for column, count in enumerate(shared[names.index(name)].tolist()):
            if count >= MIN_INSTANTS and names[column] not in links:
                heapq.heappush(queue, (length + 1.0 / count, names[column], name))
    return links


def _unconnected(
    dataset: Dataset, names: Sequence[str], shared: NDArray[np.int64], unconnected: Sequence[str]
) -> VislocError:
    connected = [row for row, name in enumerate(names) if name not in unconnected]
    counts = {name: int(shared[names.index(name), connected].max()) for name in unconnected}
    return refuse(
        "rig.unconnected",
        field=str(dataset.root / "sensors"),
        expected=f"{MIN_INSTANTS} such instants or more",
        got=_some([f"{name}: {count}" for name, count in counts.items()]),
        names=_some(unconnected),
    )


def _relative_pose(others: Mapping[int, Pose], cams: Mapping[int, Pose]) -> RelativePose:
    """Estimate ``cam_from_other`` from ``other_from_world`` and ``cam_from_world`` by instant."""
    instants = others.keys() & cams.keys()
    samples = [cams[instant] @ others[instant].inverse() for instant in instants]
    rotations = Rotation.from_matrix(np.array([sample.rotation for sample in samples]))
    centers = np.array([sample.center for sample in samples])

    rotation = _median_rotation(rotations)
    center = _median_point(centers)
    angles = np.linalg.norm(_turns(rotation, rotations), axis=1)
    lengths = np.linalg.norm(centers - center, axis=1)
    outliers = _far_off(angles, _ROUND_OFF_RAD) | _far_off(lengths, _round_off(others))
    matrix = rotation.as_matrix()
    return RelativePose(
        pose=Pose(matrix, -matrix @ center),
        instants=len(instants),
        outliers=int(outliers.sum()),
        rotation_deg=_spread(np.degrees(angles)),
        position=_spread(lengths),
    )


def _median_rotation(samples: Rotation) -> Rotation:
    """The rotation whose summed angle to all samples is smallest."""
    # Start at the best of the samples, because far from a minimum the sum of angles is not convex.
    some = np.unique(np.linspace(0, len(samples) - 1, _MAX_CANDIDATES).astype(int))
    sums = [np.linalg.norm(_turns(samples[row], samples), axis=1).sum() for row in some]
    rotation = samples[some[int(np.argmin(sums))]]

    def residuals(step: NDArray[np.float64]) -> NDArray[np.float64]:
        nonlocal rotation
        rotation = rotation * Rotation.from_rotvec(step)
        return _turns(rotation, samples)

    _descend(residuals)
    return rotation


def _median_point(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """The point (3,) whose summed distance to all samples (n, 3) is smallest."""
    point = np.median(samples, axis=0)

    def residuals(step: NDArray[np.float64]) -> NDArray[np.float64]:
        nonlocal point
        point = point + step
        return samples - point

    _descend(residuals)
    return point


def _descend(residuals: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> None:
    """Weiszfeld's iteration: step to the mean of the residuals, weighted by 1 / length.

    ``residuals`` takes a step (3,) and returns what is left (n, 3) from there. Lengths below a
    hundredth of the median weigh alike: else a sample that is met exactly would hold the estimate.
    """
    left = residuals(np.zeros(3))
    for _ in range(_MAX_STEPS):
        lengths = np.linalg.norm(left, axis=1)
        typical = float(np.median(lengths))
        if not 0 < typical < math.inf:
            return
        weights = 1.0 / np.hypot(lengths, 0.01 * typical)
        step = weights @ left / weights.sum()
        left = residuals(step)
        if np.linalg.norm(step) < 1e-6 * typical:
            return


def _turns(rotation: Rotation, samples: Rotation) -> NDArray[np.float64]:
    """Rotation vectors (n, 3) from one rotation to each sample, radians."""
    return np.asarray((rotation.inv() * samples).as_rotvec())


def _far_off(deviations: NDArray[np.float64], floor: float) -> NDArray[np.bool_]:
    limit = max(OUTLIER_MULTIPLE * float(np.median(deviations)), floor)
    return np.asarray(deviations > limit)


def _spread(deviations: NDArray[np.float64]) -> Spread:
    return Spread(float(np.median(deviations)), float(np.quantile(deviations, 0.9)))


def _round_off(poses: Mapping[int, Pose]) -> float:
    """Return the rounding error of a difference between coordinates as large as these."""
    return _ROUND_OFF_PART * max(float(np.abs(pose.center).max()) for pose in poses.values())


def _refuse_loose(
    dataset: Dataset, pair: tuple[str, str], relative: RelativePose, others: Mapping[int, Pose]
) -> None:
    path = np.array([others[instant].center for instant in sorted(others)])
    step = float(np.median(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    distance = float(np.linalg.norm(relative.pose.center))
    limit = max(MAX_POSITION_SHARE * max(distance, step), _round_off(others))
    turn, shift = relative.rotation_deg.median, relative.position.median
    if turn <= MAX_ROTATION_DEG and shift <= limit < math.inf:
        return
    raise refuse(
        "rig.not_rigid",
        field=str(dataset.root / "sensors" / "trajectories.txt"),
        expected=f"relative poses of {relative.instants} timestamps that agree within "
        f"{MAX_ROTATION_DEG:g} degrees and {limit:.3g} units in the median "
        f"({MAX_POSITION_SHARE:.0%} of their distance, {distance:.3g}, or of their way between "
        f"timestamps, {step:.3g}, whichever is larger)",
        got=f"{turn:.3g} degrees and {shift:.3g} units",
        first=pair[1],
        second=pair[0],
    )


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f", ... ({len(names)})" if len(names) > 5 else "")
