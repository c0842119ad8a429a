"""A place on Earth, which stands for the maps around it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

import visloc.types
from visloc.errors import refuse
from visloc_api.words.message import IncomingMessage, converted


class Near(IncomingMessage):
    """Where the device is on Earth, roughly."""

    latitude: Annotated[float, Field(description="degrees, WGS84")]
    longitude: Annotated[float, Field(description="degrees")]
    radius: Annotated[float, Field(description="metres, more than 0")]

    def to_core(self) -> visloc.types.Near:
        """Return the circle, checked.

        Raises:
            InvalidInput: ``near.latitude``, ``near.longitude`` or ``near.radius``.
        """
        return visloc.types.Near(self.latitude, self.longitude, self.radius)

    @staticmethod
    def from_core(near: visloc.types.Near) -> Near:
        return Near(latitude=near.latitude, longitude=near.longitude, radius=near.radius)


def _near_from_text(value: object) -> object:
    """Read latitude,longitude,radius, or an object in JSON, as forms have it."""
    if not isinstance(value, str):
        return value
    if value.lstrip().startswith("{"):
        return Near.read_json(value)
    return near_from_text(value)


def near_from_text(text: str) -> Near:
    """Parse ``latitude,longitude,radius``."""
    try:
        latitude, longitude, radius = (float(number) for number in text.split(","))
    except ValueError:
        raise refuse("near.syntax", field="near", got=text) from None
    return Near(latitude=latitude, longitude=longitude, radius=radius)


# A place as an object, or as text in a field of a form.
GivenNear = Annotated[
    Near | None,
    converted(_near_from_text),
    Field(description="instead of map: search the maps that are anchored there"),
]
