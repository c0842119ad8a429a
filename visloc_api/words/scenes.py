"""The parts of a map that viewers draw."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from visloc.geometry import Camera
from visloc_api.words.answers import MapRef
from visloc_api.words.base import Answer


class MapCamera(Answer):
    """Intrinsics of mapping photos."""

    model: Annotated[str, Field(description="COLMAP's name, such as PINHOLE")]
    width: Annotated[int, Field(description="pixels")]
    height: Annotated[int, Field(description="pixels")]
    params: Annotated[list[float], Field(description="in COLMAP's order")]

    @property
    def camera(self) -> Camera:
        """To send with a photo that this camera took; raises InvalidInput if it is none."""
        return Camera(self.model, self.width, self.height, tuple(self.params))


class MapImage(Answer):
    """A mapping photo: its position and orientation."""

    name: str
    camera: Annotated[str, Field(description="one of `cameras`")]
    position: Annotated[list[float], Field(description="the camera centre in the world")]
    orientation: Annotated[
        list[float], Field(description="the rotation of world_from_cam: w, x, y, z with w >= 0")
    ]


class MapImages(Answer):
    """Mapping photos of one version of a map, in the map's order."""

    map: MapRef
    total: Annotated[int, Field(description="photos that the map has")]
    first: Annotated[int, Field(description="as asked for; 0 is the first")]
    cameras: Annotated[dict[str, MapCamera], Field(description="cameras of these photos, by id")]
    images: list[MapImage]
