"""Descriptions of maps and sets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PlainSerializer, model_validator

import visloc.geometry
from visloc_api.words.base import Answer, OneOf, SentAs
from visloc_api.words.message import IncomingMessage
from visloc_api.words.scenes import MapCamera

Numbers = tuple[float, ...]
# Of each list that a listing of thousands of maps repeats.
MAX_LISTED = 16
# Least and greatest x, y, z.
Box = tuple[Numbers, Numbers]


class Extent(Answer):
    """Smallest box along the world's axes that holds all landmarks."""

    min: Numbers
    max: Numbers


def _box(raw: Any) -> Box:
    return tuple(map(float, raw["min"])), tuple(map(float, raw["max"]))


SentBox = Annotated[Box, SentAs(Extent, tuple, _box, lambda box: Extent(min=box[0], max=box[1]))]


class RigInfo(Answer):
    """A rig that the map knows."""

    id: str
    sensors: Annotated[tuple[str, ...], Field(description="ids of its cameras")]


class Geodetic(Answer):
    """Where the world lies on Earth.

    enu = scale R x + translation gives metres east, north and up of the position.
    """

    latitude_deg: Annotated[float, Field(description="WGS84")]
    longitude_deg: float
    altitude_m: Annotated[float, Field(description="above the ellipsoid")]
    scale: Annotated[float, Field(description="metres per unit of the world")]
    rotation_wxyz: Annotated[Numbers, Field(description="R as a unit quaternion")]
    translation: Annotated[Numbers, Field(description="metres")]


class Anchor(Answer):
    """Where the world's position, orientation and scale come from."""

    kind: Annotated[
        str,
        Field(description="dataset, model, gnss, positions, correspondences or none"),
    ]
    images: Annotated[
        int, Field(description="how many photos or given points it was computed from")
    ]
    rms: Annotated[
        float | None,
        Field(description="RMS distance of these from their given positions, units of the world"),
    ]
    geodetic: Annotated[Geodetic | None, Field(description="null when not anchored to the Earth")]


class GeoCircle(Answer):
    """A circle on Earth that contains a map, centred on its middle."""

    latitude: Annotated[float, Field(description="degrees, WGS84")]
    longitude: Annotated[float, Field(description="degrees")]
    radius: Annotated[float, Field(description="metres")]


class Similarity(Answer):
    """A change of frame and unit: x_a = scale R x_b + translation for one called a_from_b."""

    rotation_wxyz: Annotated[Numbers, Field(description="R as a unit quaternion")]
    translation: Annotated[Numbers, Field(description="in the unit of a")]
    scale: Annotated[float, Field(description="units of a in one unit of b")]


class SentSimilarity(visloc.geometry.Similarity):
    """A similarity of the core over the numbers that are sent: a set may have 10 000 of them."""

    __slots__ = ("sent",)
    sent: Similarity

    def __init__(self, sent: Similarity) -> None:
        object.__setattr__(self, "sent", sent)

    @property
    def scale(self) -> float:
        return self.sent.scale

    @property
    def rotation(self) -> NDArray[np.float64]:
        sent = self.sent
        return visloc.geometry.Pose.from_quaternion(sent.rotation_wxyz, sent.translation).rotation

    @property
    def translation(self) -> NDArray[np.float64]:
        return np.array(self.sent.translation)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SentSimilarity) and self.sent == other.sent

    def __hash__(self) -> int:
        return hash(self.sent)


class Tile(Answer):
    """One map of a set."""

    map: str
    version: str
    set_from_tile: Annotated[
        SentSimilarity,
        SentAs(
            Similarity,
            SentSimilarity,
            lambda raw: SentSimilarity(Similarity.model_validate(raw)),
            lambda similarity: similarity.sent,
        ),
        Field(description="from the map's world to that of the set"),
    ]
    extent: Annotated[SentBox, Field(description="of its landmarks and photos, in the set's world")]
    images: Annotated[int, Field(description="mapping photos")]

    @model_validator(mode="before")
    @classmethod
    def _from_parts(cls, values: Any) -> Any:
        if isinstance(values, Mapping) and "scale" in values:
            parts = {name: values[name] for name in Similarity.model_fields}
            values = {"set_from_tile": parts, **values}
        return values

    @property
    def scale(self) -> float:
        """Units of the set's world in one of its own."""
        return self.set_from_tile.sent.scale

    @property
    def rotation_wxyz(self) -> Numbers:
        """R of ``x_set = scale R x + translation`` as a unit quaternion (w, x, y, z)."""
        return self.set_from_tile.sent.rotation_wxyz

    @property
    def translation(self) -> Numbers:
        """Translation of ``x_set = scale R x + translation``, in the unit of the set's world."""
        return self.set_from_tile.sent.translation

    @property
    def ref(self) -> str:
        """``id@version``."""
        return f"{self.map}@{self.version}"


class OwnTest(Answer):
    """The test that a map took when it was made: own photos, each in the map without itself."""

    tested: Annotated[int, Field(description="photos that were tried")]
    localized: Annotated[int, Field(description="of these, those that got a pose")]
    wrong: Annotated[int, Field(description="of these, those at another place than the photo")]


class Doubt(Answer):
    """What speaks against a map."""

    kind: Annotated[str, Field(description="a word, such as own_test, left_out or scale")]
    message: Annotated[str, Field(description="for a person")]


class VersionInfo(Answer):
    """A published version of a map."""

    version: str
    current: Annotated[bool, Field(description="whether this version is the current one")]


class UseVersionRequest(IncomingMessage):
    """Which version of a map to make current."""

    version: Annotated[str, Field(description="one of the published versions")]


class MapInfo(Answer):
    """A map or a set of maps."""

    id: str
    version: str
    created: Annotated[str, Field(description="ISO 8601, UTC")]
    metric: Annotated[bool, Field(description="whether one unit of the world is a metre")]
    method: Annotated[
        str | None,
        BeforeValidator(lambda value: value or None),
        Field(description="how the landmarks were made, such as rgbd; null for a set"),
    ]
    local_features: Annotated[str, Field(description="such as xfeat")]
    global_features: tuple[str, ...]
    images: Annotated[int, Field(description="mapping photos")]
    landmarks: Annotated[int, Field(description="3D points")]
    observations: Annotated[
        int | None,
        Field(description="observations of landmarks in mapping photos; null for a set"),
    ]
    extent: SentBox
    size_bytes: Annotated[
        int, Field(description="on the server's disk; for a set, without its maps")
    ]
    down: Annotated[
        Numbers | None,
        BeforeValidator(lambda value: value or None),
        PlainSerializer(lambda down: list(down or ()), return_type=list[float]),
        Field(description="unit vector that points down in the world; empty when not known"),
    ]
    rigs: Annotated[tuple[RigInfo, ...], Field(description="rigs that requests may name by id")]
    anchor: Annotated[
        Anchor | None, Field(description="null for maps of format 1.0, which do not record it")
    ] = None
    place: Annotated[GeoCircle | None, Field(description="null when not anchored to the Earth")] = (
        None
    )
    current: Annotated[bool, Field(description="whether this version is the current one")]
    versions: Annotated[
        tuple[VersionInfo, ...],
        Field(description="all published versions of the map, oldest first"),
    ]
    content_hash: Annotated[
        str,
        Field(description="sha256 of all content that affects localization; equal for equal maps"),
    ]
    fusion: Annotated[
        str | None,
        BeforeValidator(lambda value: value or None),
        Field(description="default for the global features; null for a set"),
    ] = None
    fusion_weights: Annotated[
        dict[str, float],
        BeforeValidator(lambda value: value or {}),
        Field(description="by global feature; empty when all weigh the same"),
    ] = {}  # noqa: RUF012  pydantic copies it
    kind: Annotated[
        str, OneOf(Literal["map", "set"]), Field(description="set: of several maps")
    ] = "map"
    num_tiles: Annotated[int | None, Field(description="maps of a set; null for a map")] = None
    tiles: Annotated[
        tuple[Tile, ...], Field(description="the maps of a set; left empty in lists of maps")
    ] = ()
    own_test: Annotated[
        OwnTest | None, Field(description="null for a set, and for a map that took none")
    ] = None
    doubts: Annotated[
        tuple[Doubt, ...],
        Field(description=f"why somebody should look at the map first; at most {MAX_LISTED}"),
    ] = ()
    pieces: Annotated[
        tuple[str, ...],
        Field(
            description="id@version of the other maps that the same build made of photos which "
            f"nothing links to these, largest first; at most {MAX_LISTED}"
        ),
    ] = ()
    cameras: Annotated[
        dict[str, MapCamera],
        Field(
            description="by id; for a photo that one of them took, send it as the camera. At most "
            f"{MAX_LISTED}: GET /maps/{{ref}}/images has all"
        ),
    ] = {}  # noqa: RUF012  pydantic copies it
    num_cameras: Annotated[int, Field(description="how many there are; 0 for a set")] = 0

    @property
    def ref(self) -> str:
        """``id@version``: this version, even after the server has switched to a newer one."""
        return f"{self.id}@{self.version}"


class ListMapsResponse(Answer):
    """The maps that are served."""

    maps: tuple[MapInfo, ...]
