"""What was seen on the way to an answer."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, Field

import visloc.types

# Of every stated uncertainty.
NOT_COVERED = (
    "; from the scatter of the matches alone, without errors that landmarks share (depth, "
    "calibration, poses of mapping photos): on one map from depth the error was 13 times as large"
)


class Refusal(BaseModel):
    """Why there is no pose."""

    stage: Annotated[visloc.types.Stage, Field(description="the stage that gave up")]
    reason: Annotated[visloc.types.Reason, Field(description="a stable word")]
    message: Annotated[str, Field(description="for a person")]


class RetrievedImage(BaseModel):
    """A mapping photo that was matched against."""

    image: Annotated[str, Field(description="its name in the map")]
    score: Annotated[float, Field(description="fused, comparable within one answer only")]
    similarities: Annotated[dict[str, float], Field(description="cosine by global descriptor")]

    @staticmethod
    def best_of(evidence: visloc.types.Evidence, num: int | None = None) -> list[RetrievedImage]:
        """Say the best so many, or all, in the API's words."""
        return [
            RetrievedImage(image=r.name, score=r.score, similarities=dict(r.similarities))
            for r in evidence.retrieved[:num]
        ]


class CameraUsed(BaseModel):
    """The intrinsics used, for the pixels as stored."""

    model: str
    width: int
    height: int
    params: list[float]
    source: Annotated[
        visloc.types.CameraSource,
        Field(
            description="given; given_scaled, for another size of the same aspect; exif, its "
            "focal length; estimated, found together with the pose; or guess, 1.2 times the longer "
            "side"
        ),
    ]

    @staticmethod
    def of(evidence: visloc.types.Evidence) -> CameraUsed:
        """Say it in the API's words."""
        camera = evidence.camera
        return CameraUsed(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            params=list(camera.params),
            source=evidence.camera_source,
        )


class Orientation(BaseModel):
    """How the photo was turned to find features.

    Camera, keypoints and pose are those of the stored pixels, whatever this says.
    """

    exif: Annotated[int, Field(description="1 to 8 as stored in the photo, 1 when absent")]
    read_as: Annotated[
        visloc.types.ReadAs,
        Field(
            description="upright: features were found in the photo turned by its EXIF orientation; "
            "stored: in the pixels as stored, or the features were sent"
        ),
    ]

    @staticmethod
    def of(evidence: visloc.types.Evidence) -> Orientation:
        """Say it in the API's words."""
        return Orientation(exif=evidence.exif_orientation, read_as=evidence.read_as)


class MapRef(BaseModel):
    """The map that answered, or the set of maps."""

    id: str
    version: str


# Of a set, the map in it that answered.
TileRef = Annotated[
    str | None,
    Field(
        description="of a set of maps: id@version of the map in it that the answer rests on, or "
        "that came closest; null for a map on its own"
    ),
]
