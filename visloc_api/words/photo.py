"""The request for one photo, and what all requests that localize share."""

from __future__ import annotations

import json
from typing import Annotated

from pydantic import FailFast, Field

from visloc.errors import refuse
from visloc.options import MAX_MAPS
from visloc_api.words.features import GivenFeatures, GivenImage, GivenMask
from visloc_api.words.message import IncomingMessage, converted
from visloc_api.words.near import GivenNear
from visloc_api.words.options import GivenOptions, LocalizeOptions
from visloc_api.words.poses import GivenCamera
from visloc_api.words.priors import GivenPriors

PhotoField = Annotated[
    GivenImage, Field(description="the encoded photo: JPEG, HEIC, PNG, WebP, AVIF, TIFF or BMP")
]
MaskField = Annotated[
    GivenMask,
    Field(
        description="a picture of the photo's size or aspect, black where the photo does not "
        "count: people, screens, mirrors"
    ),
]
FeaturesField = Annotated[
    GivenFeatures, Field(description="the photo's features, instead of the photo; need a camera")
]


def _maps_from_text(value: object) -> object:
    """Read ids separated by commas, or a list in JSON, as forms have them."""
    if not isinstance(value, str):
        return value
    if not value.lstrip().startswith("["):
        return [name.strip() for name in value.split(",")]
    try:
        return json.loads(value)
    except (ValueError, RecursionError):
        raise refuse(
            "request.malformed", field="maps", expected="id,id,... or a list in JSON"
        ) from None


# Maps as a list, or as text in a field of a form.
GivenMaps = Annotated[
    list[str] | None,
    FailFast(),
    converted(_maps_from_text),
    Field(
        description=f"instead of map: at most {MAX_MAPS} maps to search; a photo that two of them "
        "explain is refused as ambiguous"
    ),
]


def flag_from_text(value: object) -> object:
    """Read true or false, as forms have them."""
    return {"true": True, "false": False}.get(value, value) if isinstance(value, str) else value


GivenYpr = Annotated[
    bool | None,
    converted(flag_from_text),
    Field(description="also say the GeoPose in yaw, pitch and roll"),
]
GivenDebug = Annotated[
    bool | None,
    converted(flag_from_text),
    Field(description="also return the matches and a picture of them; needs a photo"),
]


class LocalizeRequest(IncomingMessage):
    """A photo or its features, and the map to search."""

    map: Annotated[str | None, Field(description="id, or id@version")] = None
    image: PhotoField = None
    features: FeaturesField = None
    camera: Annotated[
        GivenCamera,
        Field(
            description="an object, or MODEL,width,height,params...; if left out, the server takes "
            "the focal length from EXIF, else estimates or guesses it; the answer says "
            "which"
        ),
    ] = None
    options: GivenOptions = Field(default_factory=LocalizeOptions)
    maps: GivenMaps = None
    priors: GivenPriors = None
    near: GivenNear = None
    ypr: GivenYpr = None
    debug: GivenDebug = None
    mask: MaskField = None
