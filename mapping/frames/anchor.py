"""Where a reconstruction lies in the world: aligned to known poses, positions or GNSS fixes.

Positions are believed only where they determine the similarity. To first order, independent errors
of a standard deviation sigma along each axis give the least-squares fit of n positions, whose root
mean square extents along the principal axes of the reconstructed centres are e1 >= e2 >= e3, the
standard errors

    of the scale, relative:          sigma / (sqrt(n) sqrt(e1^2 + e2^2 + e3^2)),
    of the rotation about axis 1:    sigma / (sqrt(n) sqrt(e2^2 + e3^2)),

the latter the largest of the three rotations: the weak one of a street. sigma^2 is estimated by the
squared misfit over the 3 n - 7 degrees of freedom that are left, and Student's t of as many turns
standard errors into intervals of 95 % confidence. They must not exceed ``MAX_SCALE_ERROR`` and
``MAX_DIRECTION_ERROR_DEG``. Photos with the very same position, such as those of a rig at the time
of one fix, count as one. Errors that photos share, such as the slow drift of GNSS, stay unseen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
from numpy.typing import NDArray
from scipy.special import stdtrit

from mapping.stages.photos import MappingPhoto
from visloc.archive import Anchor, Geodetic
from visloc.archive.places import origin_of, similarity_on_earth
from visloc.errors import refuse
from visloc.geodesy import enu_from_geodetic, geodetic_from_enu, middle_of
from visloc.geometry import Pose, Similarity
from visloc.kapture import Dataset

# A fix of a phone or a consumer receiver is seldom further off.
GNSS_ERROR_M = 10.0
# Known positions further off than this part of their spread are mistakes.
_POSITION_ERROR = 0.05
# Positions further out than this many times the median do not count as their spread.
_STRAY = 10.0
# Fewer leave a rotation open.
_MIN_POSITIONS = 3
# The widest intervals (95 %, plus or minus) with which positions fix a world.
MAX_SCALE_ERROR = 0.05
MAX_DIRECTION_ERROR_DEG = 5.0
# Centres that extend less to the second side than this part of the first lie in a line: bends of a
# reconstruction could be as large.
_LINE = 0.05
_EPSG_WGS84 = "EPSG:4326"
# Longitude and latitude in degrees, and height in metres. 4326 has no height by the letter.
EPSG_GEODETIC = (_EPSG_WGS84, "EPSG:4979")
# Universal Transverse Mercator on WGS84, north and south: metres.
_EPSG_UTM = tuple(f"EPSG:32{half}{zone:02}" for half in (6, 7) for zone in range(1, 61))


@dataclass(frozen=True, slots=True, eq=False)
class KnownPositions:
    """What is known of where the photos were taken, before they are reconstructed.

    Attributes:
        anchor: what kind of knowledge; its ``rms`` is not known yet.
        photos: (n,) rows of the photos.
        positions: (n, 3) in the world that the map is to have.
        max_error: RANSAC's threshold, in the unit of the positions.
    """

    anchor: Anchor
    photos: NDArray[np.int64]
    positions: NDArray[np.float64]
    max_error: float


class Alignment(NamedTuple):
    """How a reconstruction lies in the world.

    Attributes:
        similarity: maps the reconstruction to the world.
        agrees: (n,) which known positions it agrees with.
    """

    similarity: Similarity
    agrees: NDArray[np.bool_]


def known_positions(dataset: Dataset, photos: Sequence[MappingPhoto]) -> KnownPositions | None:
    """Find the poses of at least three photos, else the GNSS fixes at their timestamps, if any.

    GNSS fixes in degrees become metres east, north and up of their middle; those in UTM are metres
    already.
    """
    posed = [row for row, photo in enumerate(photos) if photo.cam_from_world is not None]
    fixes = {fix.timestamp: fix for fix in dataset.gnss}
    rows = [row for row, photo in enumerate(photos) if photo.record.timestamp in fixes]
    if len(posed) >= _MIN_POSITIONS or (posed and not rows):
        positions = np.array([photos[row].pose.center for row in posed])
        anchor = Anchor(kind="positions", images=len(posed))
        error = _POSITION_ERROR * spread_of(positions)
        return KnownPositions(anchor, np.array(posed), positions, error)
    if not rows:
        return None
    chosen = [fixes[photos[row].record.timestamp] for row in rows]
    xyz = np.array([[fix.x, fix.y, fix.z] for fix in chosen])
    if coordinate_system(dataset, {fix.sensor_id for fix in chosen}) not in EPSG_GEODETIC:
        return KnownPositions(
            Anchor(kind="gnss", images=len(rows)), np.array(rows), xyz, GNSS_ERROR_M
        )
    geodetic = xyz[:, [1, 0, 2]]
    check_on_earth(geodetic, str(dataset.root / "sensors" / "records_gnss.txt"))
    origin = middle_of(geodetic)
    anchor = Anchor(kind="gnss", images=len(rows), geodetic=_at(origin))
    return KnownPositions(anchor, np.array(rows), enu_from_geodetic(geodetic, origin), GNSS_ERROR_M)


def about_rows(known: KnownPositions, rows: NDArray[np.int64]) -> tuple[KnownPositions, Similarity]:
    """Move the origin of fixes in degrees amid those of some rows; return also new_from_old."""
    old = known.anchor.geodetic
    if old is None:
        return known, Similarity.identity()
    new = _at(middle_of(geodetic_from_enu(known.positions[rows], origin_of(old))))
    moved = similarity_on_earth(new, old)
    anchor = known.anchor.model_copy(update={"geodetic": new})
    return replace(known, anchor=anchor, positions=moved.apply(known.positions)), moved


def spread_of(positions: NDArray[np.float64]) -> float:
    """Return how far positions (n, 3) extend from their median, without far strays."""
    away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    moved = away[away > 0]
    return float(moved[moved <= _STRAY * np.median(moved)].max()) if len(moved) else 0.0


def check_on_earth(positions: NDArray[np.float64], field: str) -> None:
    """Raise ``anchor.position`` unless (n, 3) are latitude, longitude (deg) and height (m)."""
    latitude, longitude, height = positions.T
    # NaN fails too.
    fine = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180) & (np.abs(height) <= 100_000)
    if not fine.all():
        wrong = positions[~fine][0]
        raise refuse("anchor.position", field=field, got=", ".join(f"{value:g}" for value in wrong))


def _at(origin: NDArray[np.float64]) -> Geodetic:
    return Geodetic(latitude_deg=origin[0], longitude_deg=origin[1], altitude_m=origin[2])


def coordinate_system(dataset: Dataset, receivers: set[str]) -> str:
    """Return the coordinate system that all of these receivers' fixes are in."""
    systems = {(dataset.sensors[one].params or (_EPSG_WGS84,))[0]: one for one in receivers}
    known = (*EPSG_GEODETIC, *_EPSG_UTM)
    for system, receiver in sorted(systems.items()):
        if len(systems) > 1 or system not in known:
            raise refuse(
                "gnss.epsg",
                f"the coordinate system of the fixes of receiver {receiver!r} is unknown"
                if system not in known
                else "the GNSS fixes use several coordinate systems; convert them to one",
                field=str(dataset.root / "sensors" / "sensors.txt"),
                expected=f"{' or '.join(EPSG_GEODETIC)} (degrees), or WGS84 / UTM in metres, "
                "EPSG:32601 to 32660 and 32701 to 32760",
                got=", ".join(sorted(systems)),
            )
    return next(iter(systems))


def align_positions(
    centers: NDArray[np.float64], known: NDArray[np.float64], max_error: float
) -> Alignment | str:
    """Find the similarity that maps camera centres (n, 3) to known positions (n, 3), robustly.

    Returns:
        The alignment; or why there is none, in words to follow "but": fewer than three positions,
        not more than half of them agree, the centres of those that do lie in a line, or they do
        not fix scale and directions well enough (see the top of this module).
    """
    if len(centers) < _MIN_POSITIONS:
        return f"only {len(centers)} of them can be compared, and three are needed"
    doubt = _line_doubt(centers)  # in which nothing can be fitted
    if doubt is not None:
        return doubt
    options = pycolmap.RANSACOptions(max_error=max(max_error, 1e-9), random_seed=0)
    # pycolmap finds nothing for points in a plane through the origin: both are moved off it.
    source, target = _off_plane(centers), _off_plane(known)
    moved = centers + source, known + target
    # Its stub promises a Sim3d; what comes is a dict.
    found = cast("dict[str, Any] | None", pycolmap.estimate_sim3d_robust(*moved, options))
    agrees = np.zeros(len(centers), bool) if found is None else np.array(found["inlier_mask"], bool)
    # Any three agree nearly, and of many wrong ones a few do by chance.
    if found is None or agrees.sum() < max(_MIN_POSITIONS, len(centers) // 2 + 1):
        return (
            f"only {agrees.sum()} of {len(centers)} agree with the reconstruction to "
            f"{max_error:.3g}, and more than half must, three at least"
        )
    sim = found["tgt_from_src"]
    scale, rotation = float(sim.scale), np.array(sim.rotation.matrix())
    translation = scale * rotation @ source + np.array(sim.translation) - target
    similarity = Similarity(scale, rotation, translation)
    doubt = _doubt(similarity.apply(centers[agrees]), known[agrees])
    return doubt or Alignment(similarity, agrees)


def _off_plane(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what moves points (n, 3) as far off the origin as they extend, across their plane."""
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    return np.asarray(extents[0] * axes[2] - middle)


def _doubt(aligned: NDArray[np.float64], known: NDArray[np.float64]) -> str | None:
    """Why positions (n, 3) do not fix the similarity that aligned centres (n, 3) to them."""
    num_photos = len(aligned)
    doubt = _line_doubt(aligned)
    if doubt is not None:
        return doubt
    extents = _extents(aligned)
    num = len(np.unique(known, axis=0))
    rms = math.sqrt(np.sum((aligned - known) ** 2) / num_photos)
    scale = scale_margin(aligned, known)
    angle = math.degrees(scale * math.hypot(*extents) / math.hypot(extents[1], extents[2]))
    if scale > MAX_SCALE_ERROR or angle > MAX_DIRECTION_ERROR_DEG:
        return (
            f"they are too inexact for their extent: {num} positions, {rms:.2g} from the "
            f"reconstruction (rms), which extends {extents[0]:.2g}, {extents[1]:.2g} and "
            f"{extents[2]:.2g} (rms), tell its scale to {scale:.0%} and its directions to "
            f"{min(angle, 180.0):.0f} degrees; needed are {MAX_SCALE_ERROR:.0%} and "
            f"{MAX_DIRECTION_ERROR_DEG:.0f}"
        )
    return None


def scale_margin(aligned: NDArray[np.float64], known: NDArray[np.float64]) -> float:
    """Half of the 95 % interval, as a part, of the scale that aligned centres (n, 3)."""
    num = len(np.unique(known, axis=0))
    squared_misfit = float(np.sum((aligned - known) ** 2)) * num / len(aligned)
    margin = _margin(squared_misfit, 3 * num - 7) / math.sqrt(num)
    return margin / math.hypot(*_extents(aligned))


def at_own_scale(
    similarity: Similarity, centers: NDArray[np.float64], known: NDArray[np.float64]
) -> Similarity:
    """Return the rigid fit of the centres (n, 3) that a similarity fits to known positions."""
    rotation = similarity.rotation  # that of the best fit does not depend on the scale
    return Similarity(1.0, rotation, known.mean(axis=0) - rotation @ centers.mean(axis=0))


def _line_doubt(centers: NDArray[np.float64]) -> str | None:
    along, across, _ = _extents(centers)
    if across > _LINE * along:
        return None
    return (
        f"{len(centers)} of them lie in a line, about which the world could turn: across it the "
        f"reconstruction extends {across / along if along else 0.0:.2%} of what it does along it, "
        f"and more than {_LINE:.0%} are needed"
    )


def _extents(centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square extents along the principal axes, the largest first."""
    singular = np.linalg.svd(centers - centers.mean(axis=0), compute_uv=False)
    return np.asarray(singular / math.sqrt(len(centers)))


def _margin(squared_misfit: float, freedom: int) -> float:
    """Half of the 95 % interval of a mean of one measurement, its sigma estimated by a misfit."""
    if freedom < 1:
        return math.inf
    return float(stdtrit(freedom, 0.975)) * math.sqrt(squared_misfit / freedom)


def scale_doubt(centers: NDArray[np.float64], known: NDArray[np.float64]) -> str | None:
    """Tell why aligned centres (n, 2) are not shown to be in metres by known positions (n, 2).

    The criterion of ``align_positions`` for the scale alone, in the plane, where the positions may
    lie in a line: the interval of the scale that fits best must lie within ``MAX_SCALE_ERROR``
    of 1.

    Returns:
        The reason with its numbers; None where the scale is known.
    """
    num = len(np.unique(known, axis=0))
    if num < _MIN_POSITIONS:
        return f"{num} different positions do not tell the scale, three are needed"
    # In the complex plane a similarity is w = a z + b, and its scale is |a|.
    z, w = ((xy - xy.mean(axis=0)) @ [1.0, 1j] for xy in (centers, known))
    squares = float(np.sum(np.abs(z) ** 2))
    if squares == 0:
        return "all photos are at one place"
    a = complex(np.vdot(z, w)) / squares
    misfit = float(np.mean(np.abs(w - a * z) ** 2))
    margin = _margin(misfit * num, 2 * num - 4) / math.sqrt(num * squares / len(centers))
    if abs(abs(a) - 1) + margin > MAX_SCALE_ERROR:
        return (
            f"{num} positions, {math.sqrt(misfit):.2g} m from the reconstruction (rms), tell a "
            f"scale of {abs(a):.3g} +- {margin:.2g}; within {MAX_SCALE_ERROR:.0%} of 1 is needed"
        )
    return None


def align_poses(moved: Sequence[Pose], given: Sequence[Pose]) -> Similarity:
    """Find the similarity that brings poses back to where they were given, in the mean.

    The rotation comes from the orientations, so that positions in a line do no harm.
    """
    nearest = np.sum([b.rotation.T @ a.rotation for a, b in zip(moved, given, strict=True)], axis=0)
    u, _, vt = np.linalg.svd(nearest)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    source = np.array([pose.center for pose in moved]) @ rotation.T
    target = np.array([pose.center for pose in given])
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    variance = float(np.sum((source - source_mean) ** 2))
    shared = float(np.sum((source - source_mean) * (target - target_mean)))
    scale = shared / variance if variance > 0 and shared > 0 else 1.0
    return Similarity(scale, rotation, target_mean - scale * source_mean)
