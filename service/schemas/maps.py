"""What maps are."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, Field

from visloc.archive import Map


class Extent(BaseModel):
    """Smallest box along the world's axes that holds all landmarks."""

    min: list[float]
    max: list[float]


class RigInfo(BaseModel):
    """A rig that the map knows."""

    id: str
    sensors: Annotated[list[str], Field(description="ids of its cameras")]


class MapInfo(BaseModel):
    """What a map is."""

    id: str
    version: str
    created: Annotated[str, Field(description="ISO 8601, UTC")]
    metric: Annotated[bool, Field(description="whether one unit of the world is a metre")]
    method: Annotated[str, Field(description="how the landmarks were made, such as rgbd")]
    local_features: Annotated[str, Field(description="such as xfeat")]
    global_features: list[str]
    images: Annotated[int, Field(description="mapping photos")]
    landmarks: Annotated[int, Field(description="3D points")]
    observations: Annotated[int, Field(description="sightings of landmarks in mapping photos")]
    extent: Extent
    size_bytes: Annotated[int, Field(description="on the server's disk")]
    down: Annotated[
        list[float],
        Field(description="unit vector that points down in the world; empty when not known"),
    ]
    rigs: Annotated[list[RigInfo], Field(description="that requests may name by their ids")]

    @staticmethod
    def from_map(opened: Map) -> MapInfo:
        """Say it in the API's words."""
        manifest = opened.manifest
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
            down=[] if manifest.world.gravity is None else list(manifest.world.gravity),
            rigs=[RigInfo(id=id_, sensors=list(sensors)) for id_, sensors in opened.rigs.items()],
        )


class ListMapsResponse(BaseModel):
    """The maps that are served."""

    maps: list[MapInfo]
