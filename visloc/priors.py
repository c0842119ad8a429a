"""Priors: what a caller knows about a pose before any photo is looked at.

A prior is taken at its word: it narrows the search, and a pose that contradicts it is refused. It
never bends a pose towards itself, so that a wrong one costs an answer and not the truth of one
(docs/decisions/0010-priors-restrict-and-refuse.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.errors import VislocError, refuse
from visloc.geometry import Pose, Similarity

# A gravity prior of a larger spread says too little to search by.
MAX_GRAVITY_STD = math.radians(15.0)
# How far beyond an area a photo may have been taken and still show it, in units of how far the
# map's photos see; within that, photos further away count less.
REACH = 2.0
# How far beyond a height band a photo may have been taken, in units of its height. On the floors
# above and below, photos are further away than this from the band of a floor: they are taken from
# the middle half of their own.
HEIGHT_REACH = 0.25
# An area of so many standard deviations around a pose prior is searched.
POSE_PRIOR_STDS = 3.0
# The device may be so many times the accuracy of a GNSS fix away from it: beside buildings, errors
# have long tails.
GNSS_ACCURACIES = 3.0
# Most tiles of a set of maps. The manifest lists them, which takes about 12 MB for so many.
MAX_TILES = 10_000
# Limit on positions and uncertainties. It exceeds any real value, and its squares stay finite.
_MOST = 1e15
# Smallest eigenvalue of a covariance scaled to unit variances. Covariances of poses 5000 km from
# the origin come close to singular, because t moves by kilometres with the rotation.
_LEAST_EIGENVALUE = 1e-15


@dataclass(frozen=True, slots=True, eq=False)
class PositionPrior:
    """The device is within a sphere.

    Attributes:
        position: (3,) its centre in the world.
        radius: in units of the world, positive.
    """

    position: NDArray[np.float64]
    radius: float

    def __post_init__(self) -> None:
        if self.position.shape != (3,) or not _usable(self.position):
            expected = f"three finite numbers, none beyond {_MOST:g}"
            raise _unusable("position", "position", expected, self.position)
        if not 0 < self.radius <= _MOST:  # NaN fails too
            expected = f"a positive number, at most {_MOST:g}"
            raise _unusable("position", "radius", expected, self.radius)


@dataclass(frozen=True, slots=True)
class HeightBand:
    """The device is between two heights, such as those of a floor and its ceiling.

    Heights are measured along the world's up, from the world's (0, 0, 0).

    Attributes:
        min: in units of the world.
        max: greater than ``min``.
        down: unit vector along which they are measured; None for what the map knows of down, or
            the gravity prior. In a tile it is that of the set.
    """

    min: float
    max: float
    down: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.min) and math.isfinite(self.max) and self.min < self.max):
            got = f"{self.min} to {self.max}"
            raise _unusable("height", None, "two finite numbers, min < max", got)


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """The device is where it was, give or take.

    Attributes:
        device_from_world: of the camera, or of the rig when a rig is localized.
        covariance: (6, 6) of rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt;
            symmetric and positive definite.
    """

    device_from_world: Pose
    covariance: NDArray[np.float64]

    def __post_init__(self) -> None:
        if not (
            _usable(self.device_from_world.rotation) and _usable(self.device_from_world.translation)
        ):
            expected = f"a rotation and a translation, no number beyond {_MOST:g}"
            raise _unusable("pose", "device_from_world", expected, self.device_from_world)
        check_covariance(self.covariance, "priors.pose.covariance")


@dataclass(frozen=True, slots=True, eq=False)
class GravityPrior:
    """Which way is down, as an accelerometer or a tracker tells it.

    Attributes:
        direction: (3,) unit vector that points down, in the frame of the camera, or of the rig
            when a rig is localized.
        std: standard deviation of its angle, rad.
        world: (3,) unit vector that points down in the world, for maps that do not know it.
    """

    direction: NDArray[np.float64]
    std: float
    world: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", _unit_vector("direction", self.direction))
        if self.world is not None:
            object.__setattr__(self, "world", _unit_vector("world", self.world))
        if not 0 < self.std <= MAX_GRAVITY_STD:  # NaN fails too
            most = f"more than 0 and at most {math.degrees(MAX_GRAVITY_STD):g} degrees"
            raise _unusable("gravity", "std_deg", most, math.degrees(self.std))


@dataclass(frozen=True, slots=True, eq=False)
class GnssPrior:
    """The device is where a satellite receiver has it, give or take.

    Needs a map that knows where it lies on Earth.

    Attributes:
        latitude: degrees, WGS84.
        longitude: degrees.
        accuracy: horizontal radius that holds 68 % of fixes, as phones state it; metres, positive.
        altitude: metres above the ellipsoid; None when unknown.
        vertical_accuracy: of the altitude, metres, positive; None without an altitude.
        fix_from_world: from the world to metres east, north and up of the fix; None for what the
            map knows of its place on Earth. In a tile it is what the set knows
            (``visloc.archive.places.located``). Altitude 0 stands for one that is unknown.
    """

    latitude: float
    longitude: float
    accuracy: float
    altitude: float | None = None
    vertical_accuracy: float | None = None
    fix_from_world: Similarity | None = None

    def __post_init__(self) -> None:
        for part, most in (("latitude", 90.0), ("longitude", 180.0), ("altitude", _MOST)):
            value = getattr(self, part)
            if value is not None and not abs(value) <= most:  # NaN fails too
                raise _unusable("gnss", part, f"a number from {-most:g} to {most:g}", value)
        if (self.altitude is None) != (self.vertical_accuracy is None):
            expected = "an altitude and its accuracy, or neither"
            raise _unusable("gnss", "vertical_accuracy", expected, self.vertical_accuracy)
        for part in ("accuracy", "vertical_accuracy"):
            value = getattr(self, part)
            if value is not None and not 0 < value <= _MOST:
                expected = f"a positive number of metres, at most {_MOST:g}"
                raise _unusable("gnss", part, expected, value)

    def beyond(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far points (n, 3) of the world lie outside what the fix allows, metres (n,).

        It allows a cylinder about the fix; one without ends when the altitude is unknown.
        """
        if self.fix_from_world is None:
            raise AssertionError("nobody said where the world lies on Earth")
        enu = self.fix_from_world.apply(points)
        outside = np.hypot(enu[:, 0], enu[:, 1]) - GNSS_ACCURACIES * self.accuracy
        if self.vertical_accuracy is None:
            return np.asarray(np.maximum(outside, 0.0))
        above = np.abs(enu[:, 2]) - GNSS_ACCURACIES * self.vertical_accuracy
        return np.hypot(np.maximum(outside, 0.0), np.maximum(above, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Priors:
    """What is known; None where nothing is.

    Attributes:
        maps: of a set of maps, the tiles that the device may be in: each ``id`` or ``id@version``.
    """

    position: PositionPrior | None = None
    height: HeightBand | None = None
    pose: PosePrior | None = None
    gravity: GravityPrior | None = None
    gnss: GnssPrior | None = None
    maps: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.maps is not None and not self.maps:
            raise refuse(
                "priors.maps",
                "no tile is named",
                field="priors.maps",
                expected="tiles of the set that is searched",
                got="none",
            )


NO_PRIORS = Priors()


def check_covariance(covariance: NDArray[np.float64], field: str) -> None:
    """Refuse what is not the covariance (6, 6) of a pose."""
    fine = covariance.shape == (6, 6) and _usable(covariance)
    if fine:
        scale = np.sqrt(np.abs(np.diag(covariance)))
        fine = bool((scale > 0).all())
    if fine:
        # Judged without units: variances of angles are small numbers.
        with np.errstate(over="ignore", invalid="ignore"):
            unitless = covariance / np.outer(scale, scale)
        fine = (
            _usable(unitless)
            and np.allclose(unitless, unitless.T, rtol=0, atol=1e-6)
            and bool(np.linalg.eigvalsh(unitless)[0] > _LEAST_EIGENVALUE)
        )
    if not fine:
        raise refuse(
            "pose.covariance",
            field=field,
            expected="6 x 6 finite numbers, symmetric and positive definite: rotation (rad), then "
            f"translation; none beyond {_MOST:g}",
        )


def _usable(numbers: NDArray[np.float64]) -> bool:
    return bool((np.abs(numbers) <= _MOST).all())  # False for NaN


def _unit_vector(part: str, vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """A direction (3,) of gravity at length 1."""
    norm = math.hypot(*vector) if vector.shape == (3,) else math.nan
    if not (math.isfinite(norm) and norm > 1e-6):
        raise _unusable("gravity", part, "three finite numbers, not all zero", vector)
    return np.asarray(vector / norm)


def _unusable(prior: str, part: str | None, expected: str, got: object) -> VislocError:
    return refuse(
        f"priors.{prior}",
        "the prior is not valid",  # by itself; the codes' own sentences are about a prior and a map
        field=f"priors.{prior}" if part is None else f"priors.{prior}.{part}",
        expected=expected,
        got=str(got)[:100],
    )
