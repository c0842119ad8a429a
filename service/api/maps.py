"""What maps are."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Literal

from pydantic import BaseModel, Field

import visloc.archive
from service.api.message import IncomingMessage
from service.values import ServedMap
from visloc.types import Fusion


class Extent(BaseModel):
    """Smallest box along the world's axes that holds all landmarks."""

    min: list[float]
    max: list[float]


class RigInfo(BaseModel):
    """A rig that the map knows."""

    id: str
    sensors: Annotated[list[str], Field(description="ids of its cameras")]


class Geodetic(BaseModel):
    """Where the world lies on Earth.

    enu = scale R x + translation gives metres east, north and up of the position.
    """

    latitude_deg: Annotated[float, Field(description="WGS84")]
    longitude_deg: float
    altitude_m: Annotated[float, Field(description="above the ellipsoid")]
    scale: Annotated[float, Field(description="metres per unit of the world")]
    rotation_wxyz: Annotated[list[float], Field(description="R as a unit quaternion")]
    translation: Annotated[list[float], Field(description="metres")]


class Anchor(BaseModel):
    """What the world's position, orientation and scale rest on."""

    kind: Annotated[
        str,
        Field(description="dataset, model, gnss, positions, correspondences or none"),
    ]
    images: Annotated[int, Field(description="photos, or given points, that it rests on")]
    rms: Annotated[
        float | None,
        Field(description="how far they are from where they were said to be, units of the world"),
    ]
    geodetic: Annotated[Geodetic | None, Field(description="null when not anchored to the Earth")]

    @staticmethod
    def of(anchor: visloc.archive.Anchor) -> Anchor:
        """Say it in the API's words."""
        return Anchor.model_validate(anchor.model_dump())


class GeoCircle(BaseModel):
    """A circle on Earth about the middle of a map, which holds the map."""

    latitude: Annotated[float, Field(description="degrees, WGS84")]
    longitude: Annotated[float, Field(description="degrees")]
    radius: Annotated[float, Field(description="metres")]

    @staticmethod
    def of(world: visloc.archive.World | visloc.archive.SetWorld) -> GeoCircle | None:
        """Say it in the API's words."""
        place = visloc.archive.circle_of(world)
        return None if place is None else GeoCircle(**asdict(place))


class Similarity(BaseModel):
    """A change of frame and unit: x_a = scale R x_b + translation for one called a_from_b."""

    rotation_wxyz: Annotated[list[float], Field(description="R as a unit quaternion")]
    translation: Annotated[list[float], Field(description="in the unit of a")]
    scale: Annotated[float, Field(description="units of a in one unit of b")]


class Tile(BaseModel):
    """One map of a set."""

    map: str
    version: str
    set_from_tile: Annotated[
        Similarity, Field(description="from the map's world to that of the set")
    ]
    extent: Annotated[
        Extent, Field(description="of its landmarks and photos, in the world of the set")
    ]
    images: Annotated[int, Field(description="mapping photos")]

    @staticmethod
    def of(tile: visloc.archive.TileRecord) -> Tile:
        """Say it in the API's words."""
        moved = tile.set_from_tile
        return Tile(
            map=tile.map,
            version=tile.version,
            set_from_tile=Similarity(
                rotation_wxyz=list(moved.rotation_wxyz),
                translation=list(moved.translation),
                scale=moved.scale,
            ),
            extent=Extent(min=list(tile.extent.min), max=list(tile.extent.max)),
            images=tile.images,
        )


class VersionInfo(BaseModel):
    """A published version of a map."""

    version: str
    current: Annotated[bool, Field(description="whether it is in use")]


class UseVersionRequest(IncomingMessage):
    """Which version of a map to put into use."""

    version: Annotated[str, Field(description="of those that are published")]


class MapInfo(BaseModel):
    """What a map is, or a set of maps."""

    id: str
    version: str
    created: Annotated[str, Field(description="ISO 8601, UTC")]
    metric: Annotated[bool, Field(description="whether one unit of the world is a metre")]
    method: Annotated[
        str | None, Field(description="how the landmarks were made, such as rgbd; null for a set")
    ]
    local_features: Annotated[str, Field(description="such as xfeat")]
    global_features: list[str]
    images: Annotated[int, Field(description="mapping photos")]
    landmarks: Annotated[int, Field(description="3D points")]
    observations: Annotated[
        int | None,
        Field(description="sightings of landmarks in mapping photos; null for a set"),
    ]
    extent: Extent
    size_bytes: Annotated[int, Field(description="on the server's disk; of a set without its maps")]
    down: Annotated[
        list[float],
        Field(description="unit vector that points down in the world; empty when not known"),
    ]
    rigs: Annotated[list[RigInfo], Field(description="that requests may name by their ids")]
    anchor: Annotated[
        Anchor | None, Field(description="null for maps of format 1.0, which do not tell")
    ] = None
    place: Annotated[GeoCircle | None, Field(description="null when not anchored to the Earth")] = (
        None
    )
    current: Annotated[bool, Field(description="whether this version is in use")]
    versions: Annotated[
        list[VersionInfo], Field(description="all published ones of the map, oldest first")
    ]
    content_hash: Annotated[
        str,
        Field(description="sha256 over all that localizes: equal maps have equal ones"),
    ]
    fusion: Annotated[
        str | None,
        Field(description="of the global features, unless a query says otherwise; null for a set"),
    ] = Fusion.GHARM.value
    fusion_weights: Annotated[
        dict[str, float], Field(description="by global feature; empty when all count alike")
    ] = {}
    kind: Annotated[Literal["map", "set"], Field(description="set: of several maps")] = "map"
    num_tiles: Annotated[int | None, Field(description="maps of a set; null for a map")] = None
    tiles: Annotated[
        list[Tile], Field(description="the maps of a set; left empty in lists of maps")
    ] = []

    @staticmethod
    def from_served(served: ServedMap, *, in_list: bool = False) -> MapInfo:
        """Say it in the API's words."""
        outline = served.outline
        if isinstance(outline, visloc.archive.SetOutline):
            return MapInfo._of_set(outline, served, in_list=in_list)
        return MapInfo._of_map(outline, served)

    @staticmethod
    def _of_set(outline: visloc.archive.SetOutline, served: ServedMap, *, in_list: bool) -> MapInfo:
        manifest = outline.manifest
        world, anchor = manifest.world, manifest.world.anchor
        return MapInfo(
            id=manifest.id,
            version=manifest.version,
            created=manifest.created,
            metric=world.metric,
            method=None,
            local_features=manifest.local_features.name,
            global_features=[],
            images=manifest.counts.images,
            landmarks=manifest.counts.landmarks,
            observations=None,
            extent=Extent(min=list(world.extent.min), max=list(world.extent.max)),
            size_bytes=outline.size_bytes,
            down=[] if outline.gravity is None else outline.gravity.tolist(),
            rigs=[],
            anchor=None if anchor is None else Anchor.of(anchor),
            place=GeoCircle.of(world),
            current=served.current,
            versions=[VersionInfo(version=name, current=used) for name, used in served.versions],
            content_hash=manifest.content_hash,
            fusion=None,
            kind="set",
            num_tiles=len(manifest.tiles),
            tiles=[] if in_list else [Tile.of(tile) for tile in manifest.tiles],
        )

    @staticmethod
    def _of_map(opened: visloc.archive.MapOutline, served: ServedMap) -> MapInfo:
        manifest = opened.manifest
        anchor = manifest.world.anchor
        return MapInfo(
            id=manifest.id,
            version=manifest.version,
            created=manifest.created,
            metric=manifest.world.metric,
            method=manifest.method.name,
            local_features=manifest.local_features.fingerprint.name,
            global_features=[record.fingerprint.name for record in manifest.global_features],
            images=manifest.counts.images,
            landmarks=manifest.counts.landmarks,
            observations=manifest.counts.observations,
            extent=Extent(min=list(manifest.world.extent.min), max=list(manifest.world.extent.max)),
            size_bytes=opened.size_bytes,
            down=[] if opened.gravity is None else opened.gravity.tolist(),
            rigs=[RigInfo(id=id_, sensors=list(sensors)) for id_, sensors in opened.rigs.items()],
            anchor=None if anchor is None else Anchor.of(anchor),
            place=GeoCircle.of(manifest.world),
            current=served.current,
            versions=[VersionInfo(version=name, current=used) for name, used in served.versions],
            content_hash=manifest.content_hash,
            fusion=manifest.retrieval.fusion.value,
            fusion_weights=manifest.retrieval.weights or {},
        )


class ListMapsResponse(BaseModel):
    """The maps that are served."""

    maps: list[MapInfo]
