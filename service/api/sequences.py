"""The request for the instants of a sequence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import FailFast, Field

import service.values
import visloc.sequences.filling
from service.api.geopose import GivenNear, GivenYpr
from service.api.localize import GivenMaps, where_to_core
from service.api.rigs import (
    NO_PARTS,
    BatchLimits,
    GivenRig,
    Images,
    Parts,
    Timestamp,
    images_to_core,
    rig_to_core,
)
from service.values import DEFAULT_MAX_GAP_S
from visloc.errors import inside, refuse
from visloc.sequences.filling import TimeUnit
from visloc_api.words.geometry import Numbers, Transform, covariance_to_core
from visloc_api.words.message import IncomingMessage, counted
from visloc_api.words.options import GivenOptions, LocalizeOptions
from visloc_api.words.priors import GivenPriors, priors_to_core


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

    def to_core(self, parts: Parts, *, has_rig: bool) -> service.values.Instant:
        """Return the instant, its images not decoded.

        Raises:
            InvalidInput: ``request...``, ``rig.timestamps``, ``features...``, ``camera...``,
                ``priors...`` or ``pose...``.
        """
        images, _ = images_to_core(self.images, self.timestamp, parts, has_rig=has_rig)
        return service.values.Instant(
            self.timestamp,
            images,
            None if self.odometry is None else self.odometry.to_core(),
            None if self.priors is None else self.priors.to_core(),
        )


class SequenceStart(IncomingMessage):
    """What all instants of a sequence share."""

    map: Annotated[str | None, Field(description="id, or id@version")] = None
    maps: GivenMaps = None
    rig: GivenRig = None
    time_unit: Annotated[
        str | None,
        Field(
            description="unit of timestamps: s, ms, us or ns; if left out, inferred from their size"
        ),
    ] = None
    max_gap_s: Annotated[
        float | None,
        Field(
            description="longest gap between two measured instants that is filled, seconds: 0 "
            f"(none) to {visloc.sequences.filling.MAX_GAP_S:g}, by default "
            f"{DEFAULT_MAX_GAP_S:g}"
        ),
    ] = None
    options: GivenOptions = Field(default_factory=LocalizeOptions)
    priors: GivenPriors = None
    near: GivenNear = None
    ypr: GivenYpr = None

    def to_core(self) -> service.values.SequenceStart:
        """Return what they share, checked.

        Raises:
            InvalidInput: ``request.map``, ``near...``, ``sequence.time_unit``, ``rig...``,
                ``camera...``, ``options...``, ``priors...`` or ``pose...``.
        """
        units = [str(unit) for unit in TimeUnit]
        if self.time_unit and self.time_unit not in units:
            raise refuse(
                "sequence.time_unit", field="time_unit", expected=units, got=self.time_unit
            )
        return service.values.SequenceStart(
            maps=where_to_core(self.map, self.maps, self.near),
            rig=None if self.rig is None else rig_to_core(self.rig),
            time_unit=TimeUnit(self.time_unit) if self.time_unit else None,
            max_gap_s=DEFAULT_MAX_GAP_S if self.max_gap_s is None else self.max_gap_s,
            options=self.options.to_core(),
            priors=priors_to_core(self.priors),
            ypr=bool(self.ypr),
        )


def _few_instants(instants: object, limits: object) -> None:
    if (
        isinstance(limits, BatchLimits)
        and isinstance(instants, list)
        and len(instants) > limits.max_instants
    ):
        raise refuse(
            "sequence.too_many_instants",
            field="instants",
            expected=f"at most {limits.max_instants}",
            got=len(instants),
        )


class LocalizeSequenceRequest(SequenceStart):
    """A whole sequence, as HTTP takes it; gRPC takes the same as a stream."""

    instants: Annotated[
        list[Instant],
        FailFast(),
        counted(_few_instants),
        Field(description="in the order of time"),
    ]

    def to_jobs(
        self, files: Mapping[str, bytes] = NO_PARTS
    ) -> tuple[service.values.SequenceStart, list[service.values.Instant]]:
        """Return the work to do.

        Args:
            files: the files of a form by the names of their parts.

        Raises:
            InvalidInput: what ``to_core`` of its parts raises, and ``request.part``.
        """
        start, parts, jobs = self.to_core(), Parts(files), []
        for number, instant in enumerate(self.instants):
            with inside(f"instants[{number}]"):
                jobs.append(instant.to_core(parts, has_rig=start.rig is not None))
        parts.check_all_taken()
        return start, jobs
