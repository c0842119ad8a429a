"""What of a map is drawn."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, Field

from service.api.evidence import MapRef
from visloc.archive import MapOutline
from visloc.archive.photos import MappingPhotos


class MapCamera(BaseModel):
    """Intrinsics of mapping photos."""

    model: Annotated[str, Field(description="COLMAP's name, such as PINHOLE")]
    width: Annotated[int, Field(description="pixels")]
    height: Annotated[int, Field(description="pixels")]
    params: Annotated[list[float], Field(description="in COLMAP's order")]


class MapImage(BaseModel):
    """A mapping photo: where it was taken, and looking which way."""

    name: str
    camera: Annotated[str, Field(description="one of `cameras`")]
    position: Annotated[list[float], Field(description="the camera centre in the world")]
    orientation: Annotated[
        list[float], Field(description="the rotation of world_from_cam: w, x, y, z with w >= 0")
    ]


class MapImages(BaseModel):
    """Mapping photos of one version of a map, in the map's order."""

    map: MapRef
    total: Annotated[int, Field(description="photos that the map has")]
    first: Annotated[int, Field(description="as asked for; 0 is the first")]
    cameras: Annotated[
        dict[str, MapCamera], Field(description="of these photos, by the ids that they name")
    ]
    images: list[MapImage]

    @staticmethod
    def of(outline: MapOutline, photos: MappingPhotos, first: int, count: int) -> MapImages:
        """Say it in the API's words."""
        shown = slice(first, first + count)
        images = [
            MapImage(
                name=image.name,
                camera=image.camera,
                position=position.tolist(),
                orientation=orientation.tolist(),
            )
            for image, position, orientation in zip(
                photos.images[shown],
                photos.positions[shown],
                photos.orientations[shown],
                strict=True,
            )
        ]
        cameras = {id_: outline.cameras[id_] for id_ in sorted({image.camera for image in images})}
        return MapImages(
            map=MapRef(id=outline.manifest.id, version=outline.manifest.version),
            total=len(photos.images),
            first=first,
            cameras={
                id_: MapCamera(
                    model=camera.model,
                    width=camera.width,
                    height=camera.height,
                    params=list(camera.params),
                )
                for id_, camera in cameras.items()
            },
            images=images,
        )
