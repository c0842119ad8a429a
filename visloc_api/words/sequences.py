"""The request for the instants of a sequence."""

from __future__ import annotations

from typing import Annotated

from pydantic import FailFast, Field

import visloc.sequences.filling
from visloc.errors import refuse
from visloc_api.words.message import IncomingMessage, converted
from visloc_api.words.near import GivenNear
from visloc_api.words.options import GivenOptions, LocalizeOptions
from visloc_api.words.photo import GivenMaps, GivenYpr
from visloc_api.words.poses import Numbers, Transform, covariance_from_core, covariance_to_core
from visloc_api.words.priors import GivenPriors
from visloc_api.words.rigs import GivenRig, Images, Timestamp, at_most


class Odometry(IncomingMessage):
    """The rig's pose from a tracker, in the tracker's own world, in metres."""

    rig_from_odometry: Annotated[
        Transform, Field(description="only the motion between instants is used")
    ]
    covariance: Annotated[
        Numbers | None,
        Field(
            description="6 x 6, row by row, of the motion since the previous instant, "
            "rig_from_previous_rig: rotation (rad), then translation; if left out, a "
            "default drift is assumed"
        ),
    ] = None

    @staticmethod
    def from_core(odometry: visloc.sequences.filling.Odometry) -> Odometry:
        """Say the pose of a tracker that nobody has checked yet.

        Raises:
            InvalidInput: ``pose.rotation``, ``pose.translation`` or ``pose.covariance``.
        """
        pose, covariance = odometry.rig_from_odometry, odometry.covariance
        return Odometry(
            rig_from_odometry=Transform.checked(pose, "odometry.rig_from_odometry"),
            covariance=None
            if covariance is None
            else covariance_from_core(covariance, "odometry.covariance"),
        )

    def to_core(self) -> visloc.sequences.filling.Odometry:
        """Return the odometry, checked."""
        return visloc.sequences.filling.Odometry(
            self.rig_from_odometry.to_core("odometry.rig_from_odometry"),
            None
            if self.covariance is None
            else covariance_to_core(self.covariance, "odometry.covariance"),
        )


class Instant(IncomingMessage):
    """One instant of a sequence."""

    timestamp: Annotated[Timestamp, Field(description="greater than that of the instant before")]
    images: Images
    odometry: Annotated[
        Odometry | None,
        Field(description="the tracker's pose, which gives the motion since the previous instant"),
    ] = None
    priors: Annotated[
        GivenPriors, Field(description="priors of this instant; they replace those of the sequence")
    ] = None


def _check_unit(unit: object) -> object:
    units = [str(each) for each in visloc.sequences.filling.TimeUnit]
    if isinstance(unit, str) and unit and unit not in units:
        raise refuse("sequence.time_unit", field="time_unit", expected=units, got=unit)
    return unit


class SequenceStart(IncomingMessage):
    """What all instants of a sequence share."""

    map: Annotated[str | None, Field(description="id, or id@version")] = None
    maps: GivenMaps = None
    rig: GivenRig = None
    time_unit: Annotated[
        str | None,
        converted(_check_unit),
        Field(
            description="unit of timestamps: s, ms, us or ns; if left out, inferred from their size"
        ),
    ] = None
    max_gap_s: Annotated[
        float | None,
        Field(
            description="longest gap between two measured instants that is filled, seconds: 0 "
            f"(none) to {visloc.sequences.filling.MAX_GAP_S:g}, by default "
            f"{visloc.sequences.filling.DEFAULT_MAX_GAP_S:g}"
        ),
    ] = None
    options: GivenOptions = Field(default_factory=LocalizeOptions)
    priors: GivenPriors = None
    near: GivenNear = None
    ypr: GivenYpr = None


class LocalizeSequenceRequest(SequenceStart):
    """A whole sequence, as HTTP takes it; gRPC takes the same as a stream."""

    instants: Annotated[
        list[Instant],
        FailFast(),
        at_most("max_instants", "sequence.too_many_instants", "instants"),
        Field(description="in the order of time"),
    ]
