"""Priors: what is known of the device before any photo is looked at."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np
from pydantic import FailFast, Field

import visloc.priors
from visloc.errors import refuse
from visloc.priors import MAX_TILES
from visloc_api.words.message import IncomingMessage, converted
from visloc_api.words.poses import Numbers, Transform, covariance_to_core

_GRAVITY_STD_DEG = 1.0


class PositionPrior(IncomingMessage):
    """The device is within a sphere."""

    position: Annotated[Numbers, Field(description="x, y, z in the world")]
    radius: Annotated[float, Field(description="in units of the world, positive")]

    def to_core(self) -> visloc.priors.PositionPrior:
        """Return the prior, checked."""
        return visloc.priors.PositionPrior(np.array(self.position), self.radius)

    @staticmethod
    def from_core(prior: visloc.priors.PositionPrior) -> PositionPrior:
        return PositionPrior(position=prior.position.tolist(), radius=prior.radius)


class HeightBand(IncomingMessage):
    """The device is between two heights, measured upwards from (0, 0, 0) of the world."""

    min: Annotated[float, Field(description="in units of the world")]
    max: Annotated[float, Field(description="greater than min")]

    def to_core(self) -> visloc.priors.HeightBand:
        """Return the prior, checked."""
        return visloc.priors.HeightBand(self.min, self.max)

    @staticmethod
    def from_core(prior: visloc.priors.HeightBand) -> HeightBand:
        return HeightBand(min=prior.min, max=prior.max)


class PosePrior(IncomingMessage):
    """The device is near a known pose, within its covariance."""

    device_from_world: Annotated[
        Transform, Field(description="of the camera, or of the rig when a rig is localized")
    ]
    covariance: Annotated[
        Numbers,
        Field(
            description="6 x 6, row by row: rotation (rad), then translation, for "
            "R <- Exp(w) R and t <- t + dt of device_from_world"
        ),
    ]

    def to_core(self) -> visloc.priors.PosePrior:
        """Return the prior, checked."""
        return visloc.priors.PosePrior(
            self.device_from_world.to_core("priors.pose.device_from_world"),
            covariance_to_core(self.covariance, "priors.pose.covariance"),
        )

    @staticmethod
    def from_core(prior: visloc.priors.PosePrior) -> PosePrior:
        return PosePrior(
            device_from_world=Transform.from_core(prior.device_from_world),
            covariance=prior.covariance.ravel().tolist(),
        )


class GravityPrior(IncomingMessage):
    """Which way is down."""

    direction: Annotated[
        Numbers,
        Field(
            description="x, y, z of a vector of any length that points down, in the frame of the "
            "camera (of the rig, when a rig is localized)"
        ),
    ]
    std_deg: Annotated[
        float | None,
        Field(
            description="standard deviation of its angle, degrees: more than 0, at most 15; by "
            f"default {_GRAVITY_STD_DEG:g}"
        ),
    ] = None
    world: Annotated[
        Numbers | None,
        Field(
            description="x, y, z of down in the world; required for maps that do not know it, "
            "within 5 degrees of the map's own for others"
        ),
    ] = None

    def to_core(self) -> visloc.priors.GravityPrior:
        """Return the prior, checked."""
        std_deg = _GRAVITY_STD_DEG if self.std_deg is None else self.std_deg
        return visloc.priors.GravityPrior(
            np.array(self.direction),
            math.radians(std_deg),
            None if self.world is None else np.array(self.world),
        )

    @staticmethod
    def from_core(prior: visloc.priors.GravityPrior) -> GravityPrior:
        return GravityPrior(
            direction=prior.direction.tolist(),
            std_deg=math.degrees(prior.std),
            world=None if prior.world is None else prior.world.tolist(),
        )


class GnssPrior(IncomingMessage):
    """The device is where a satellite receiver has it, give or take."""

    latitude: Annotated[float, Field(description="degrees, WGS84")]
    longitude: Annotated[float, Field(description="degrees")]
    accuracy: Annotated[
        float,
        Field(
            description="horizontal radius that holds 68 % of fixes, as phones state it: metres, "
            "positive"
        ),
    ]
    altitude: Annotated[
        float | None, Field(description="metres above the ellipsoid; with vertical_accuracy")
    ] = None
    vertical_accuracy: Annotated[
        float | None, Field(description="of the altitude, metres, positive")
    ] = None

    def to_core(self) -> visloc.priors.GnssPrior:
        """Return the prior, checked."""
        return visloc.priors.GnssPrior(
            self.latitude, self.longitude, self.accuracy, self.altitude, self.vertical_accuracy
        )

    @staticmethod
    def from_core(prior: visloc.priors.GnssPrior) -> GnssPrior:
        return GnssPrior(
            latitude=prior.latitude,
            longitude=prior.longitude,
            accuracy=prior.accuracy,
            altitude=prior.altitude,
            vertical_accuracy=prior.vertical_accuracy,
        )


class Priors(IncomingMessage):
    """What is known of the device. It adjusts no pose; a pose that contradicts it is refused."""

    path: ClassVar[str] = "priors."

    position: PositionPrior | None = None
    height: HeightBand | None = None
    pose: PosePrior | None = None
    gravity: GravityPrior | None = None
    gnss: GnssPrior | None = None
    maps: Annotated[
        list[str] | None,
        FailFast(),
        Field(
            max_length=MAX_TILES,
            description="for a set: the tiles that the device may be in, each id or id@version",
        ),
    ] = None

    def to_core(self) -> visloc.priors.Priors:
        """Return the priors, checked.

        Raises:
            InvalidInput: ``priors...``, ``pose.rotation``, ``pose.translation`` or
                ``pose.covariance``.
        """
        return visloc.priors.Priors(
            position=None if self.position is None else self.position.to_core(),
            height=None if self.height is None else self.height.to_core(),
            pose=None if self.pose is None else self.pose.to_core(),
            gravity=None if self.gravity is None else self.gravity.to_core(),
            gnss=None if self.gnss is None else self.gnss.to_core(),
            maps=None if self.maps is None else tuple(self.maps),
        )

    @staticmethod
    def from_core(priors: visloc.priors.Priors) -> Priors:
        """Say it in the API's words.

        Raises:
            InvalidInput: ``priors.height`` for heights along another direction than the map's.
        """
        position, height, pose = priors.position, priors.height, priors.pose
        if height is not None and height.down is not None:
            raise refuse("priors.height", field="priors.height")
        return Priors(
            position=None if position is None else PositionPrior.from_core(position),
            height=None if height is None else HeightBand.from_core(height),
            pose=None if pose is None else PosePrior.from_core(pose),
            gravity=None if priors.gravity is None else GravityPrior.from_core(priors.gravity),
            gnss=None if priors.gnss is None else GnssPrior.from_core(priors.gnss),
            maps=None if priors.maps is None else list(priors.maps),
        )


def _priors_from_text(value: object) -> object:
    return Priors.read_json(value) if isinstance(value, str) else value


# Priors as an object, or as JSON in a field of a form.
GivenPriors = Annotated[Priors | None, converted(_priors_from_text)]


def priors_to_core(priors: Priors | None) -> visloc.priors.Priors:
    """Return what is known, which may be nothing."""
    return visloc.priors.NO_PRIORS if priors is None else priors.to_core()
