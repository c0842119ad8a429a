"""The request for one photo."""

from __future__ import annotations

import json
from typing import Annotated

from pydantic import FailFast, Field

from service.api.geopose import GivenNear, GivenYpr, Near, flag_from_text
from service.values import MAX_MAPS, RigJob, Where, photo_job
from visloc.errors import refuse
from visloc_api.words.features import GivenFeatures, GivenImage, query_to_core
from visloc_api.words.geometry import GivenCamera
from visloc_api.words.message import IncomingMessage, converted
from visloc_api.words.options import GivenOptions, LocalizeOptions
from visloc_api.words.priors import GivenPriors, priors_to_core

PhotoField = Annotated[
    GivenImage, Field(description="the encoded photo: JPEG, PNG, WebP, TIFF or BMP")
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


GivenDebug = Annotated[
    bool | None,
    converted(flag_from_text),
    Field(description="also return the matches and a picture of them; needs a photo"),
]


def where_to_core(map_ref: str | None, maps: list[str] | None, near: Near | None) -> Where:
    """Return where to search.

    Raises:
        InvalidInput: ``request.map`` for none or several of the three, for one map twice, and for
            too many; ``near...``.
    """
    given = [
        name
        for name, value in (("map", map_ref), ("maps", maps or None), ("near", near))
        if value is not None
    ]
    if len(given) != 1 or maps == []:
        raise refuse("request.map", field="map", got=" and ".join(given) or "none of them")
    if near is not None:
        return near.to_core()
    if maps is None:
        assert map_ref is not None
        return (map_ref,)
    if len(maps) > MAX_MAPS or len(set(maps)) != len(maps):
        raise refuse(
            "request.map",
            "there are too many maps" if len(maps) > MAX_MAPS else "a map is named twice",
            field="maps",
            expected=f"at most {MAX_MAPS} different ones",
            got=len(maps) if len(maps) > MAX_MAPS else ", ".join(maps),
        )
    return tuple(maps)


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

    def to_job(self) -> RigJob:
        """Return the work to do.

        Raises:
            InvalidInput: ``request.query``, ``request.map``, ``near...``, ``features...``,
                ``camera...``, ``options...``, ``priors...``, ``pose...`` or ``debug.needs_photo``.
        """
        if self.debug and self.features is not None:
            raise refuse("debug.needs_photo", field="debug", got="true")
        return photo_job(
            where_to_core(self.map, self.maps, self.near),
            query_to_core(self.image, self.features),
            None if self.camera is None else self.camera.to_core(),
            self.options.to_core(),
            priors_to_core(self.priors),
            ypr=bool(self.ypr),
            debug=bool(self.debug),
        )
