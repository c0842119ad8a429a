"""The words of the API: what requests and answers look like in JSON.

The messages of ``proto/visloc_api/v1/localization.proto`` have the same fields, and gRPC answers
are made from these models, so that both doors give the same numbers.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic.json_schema import WithJsonSchema

import visloc.geometry
import visloc.types
from service.engine import Localization, LocalizeJob
from visloc.archive import Map
from visloc.errors import InvalidInput

_CAMERA_TEXT = "PINHOLE,640,480,525,525,320,240"


class _Request(BaseModel):
    """A message from outside: unknown fields are refused by name."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
    # Where this message sits in the request, for error messages.
    path: ClassVar[str] = ""

    @model_validator(mode="before")
    @classmethod
    def _check_names(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            raise InvalidInput(
                "request.invalid",
                "not an object",
                field=cls.path.rstrip(".") or None,
                expected=f"an object with {', '.join(cls.model_fields)}",
                got=type(value).__name__,
            )
        for name in value:
            if name not in cls.model_fields:
                raise InvalidInput(
                    "request.unknown_field",
                    "unknown field",
                    field=f"{cls.path}{str(name)[:100]}",
                    expected=f"one of {', '.join(cls.model_fields)}",
                    got=name,
                )
        return value

    @classmethod
    def read(cls, value: object) -> Self:
        """Check a message made of Python values.

        Raises:
            InvalidInput: ``request.missing_field``, ``request.unknown_field``,
                ``request.invalid``, or a code of the field.
        """
        try:
            return cls.model_validate(value)
        except ValidationError as refused:
            raise invalid_input(refused.errors(include_url=False)[0], cls.path) from None

    @classmethod
    def read_json(cls, text: str | bytes) -> Self:
        """Check a message written as JSON.

        Raises:
            InvalidInput: as ``read``, and ``request.malformed``.
        """
        try:
            return cls.model_validate_json(text)
        except ValidationError as refused:
            raise invalid_input(refused.errors(include_url=False)[0], cls.path) from None


class Camera(_Request):
    """Intrinsics for the pixels as stored."""

    path: ClassVar[str] = "camera."

    model: Annotated[str, Field(description="COLMAP's name, such as PINHOLE")]
    width: Annotated[int, Field(description="pixels")]
    height: int
    params: Annotated[list[float], Field(description="in COLMAP's order")]

    def to_core(self) -> visloc.geometry.Camera:
        """Return the camera, checked."""
        return visloc.geometry.Camera(self.model, self.width, self.height, tuple(self.params))


def _camera_from_text(value: object) -> object:
    if not isinstance(value, str):
        return value
    if value.lstrip().startswith("{"):
        return Camera.read_json(value)
    camera = visloc.geometry.Camera.from_text(value)
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }


class LocalizeOptions(_Request):
    """What may be chosen per query; what is left out takes the preset's value."""

    path: ClassVar[str] = "options."

    preset: Annotated[str | None, Field(description="default, config1 or config2")] = None
    top_k: Annotated[int | None, Field(description="mapping photos to match against")] = None
    max_error_px: Annotated[
        float | None, Field(description="largest reprojection error of an inlier")
    ] = None
    min_inliers: Annotated[int | None, Field(description="fewest inliers of a pose")] = None
    min_inlier_ratio: Annotated[float | None, Field(description="0 to 1")] = None
    read_as: Annotated[
        str | None, Field(description="stored (default) or upright (by EXIF orientation)")
    ] = None
    seed: Annotated[int | None, Field(description="of RANSAC")] = None

    def to_core(self) -> visloc.types.LocalizeOptions:
        """Return the options, checked."""
        given = self.model_dump(exclude_none=True)
        if self.read_as is not None:
            known = [str(value) for value in visloc.types.ReadAs]
            if self.read_as not in known:
                raise InvalidInput(
                    "options.read_as",
                    "unknown orientation to read in",
                    field="options.read_as",
                    expected=f"one of {', '.join(known)}",
                    got=self.read_as,
                )
            given["read_as"] = visloc.types.ReadAs(self.read_as)
        return visloc.types.LocalizeOptions(**given)


def _options_from_text(value: object) -> object:
    return LocalizeOptions.read_json(value) if isinstance(value, str) else value


def _bytes_from_base64(value: object) -> object:
    if not isinstance(value, str):
        return value
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError) as error:  # ValueError: letters outside ASCII
        raise InvalidInput(
            "image.base64",
            "not base64",
            field="image",
            expected="the encoded photo in standard base64",
            got=str(error),
        ) from None


class LocalizeRequest(_Request):
    """A photo and the map to find it in."""

    map: Annotated[str, Field(description="id, or id@version")]
    image: Annotated[
        bytes,
        BeforeValidator(_bytes_from_base64),
        WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
        Field(description="the encoded photo: JPEG, PNG, WebP, TIFF or BMP"),
    ]
    camera: Annotated[
        Camera | None,
        BeforeValidator(_camera_from_text),
        WithJsonSchema(
            {
                "anyOf": [
                    {"$ref": "#/components/schemas/Camera"},
                    {"type": "string", "examples": [_CAMERA_TEXT]},
                    {"type": "null"},
                ]
            }
        ),
        Field(
            description="an object, or MODEL,width,height,params...; left out: the focal length "
            "of the photo's EXIF, else a guess that the answer marks"
        ),
    ] = None
    options: Annotated[LocalizeOptions, BeforeValidator(_options_from_text)] = Field(
        default_factory=LocalizeOptions
    )

    def to_job(self) -> LocalizeJob:
        """Return the work to do.

        Raises:
            InvalidInput: ``camera...`` or ``options...``.
        """
        camera = None if self.camera is None else self.camera.to_core()
        return LocalizeJob(self.map, self.image, camera, self.options.to_core())


class Transform(BaseModel):
    """x_a = R x_b + t for a transform called a_from_b."""

    rotation_wxyz: Annotated[list[float], Field(description="unit quaternion, w >= 0")]
    translation: Annotated[list[float], Field(description="metres when the map is metric")]


class PoseEstimate(BaseModel):
    """Where the photo was taken, and how sure that is."""

    cam_from_world: Transform
    position: Annotated[list[float], Field(description="camera centre in the world")]
    orientation: Annotated[list[float], Field(description="world_from_cam as w, x, y, z")]
    covariance: Annotated[
        list[float],
        Field(
            description="6 x 6, row by row: rotation (rad), then translation, for "
            "R <- Exp(w) R and t <- t + dt of cam_from_world"
        ),
    ]
    position_std: Annotated[list[float], Field(description="along the world's axes")]
    orientation_std_deg: Annotated[list[float], Field(description="about the camera's x, y, z")]


class Refusal(BaseModel):
    """Why there is no pose."""

    stage: Literal["features", "retrieval", "matching", "pose", "gate"]
    reason: Annotated[visloc.types.Reason, Field(description="a stable word")]
    message: Annotated[str, Field(description="for a person")]


class RetrievedImage(BaseModel):
    """A mapping photo that was matched against."""

    image: str
    score: Annotated[float, Field(description="fused, comparable within one answer only")]
    similarities: Annotated[dict[str, float], Field(description="cosine by global descriptor")]


class CameraUsed(BaseModel):
    """The intrinsics used, and where they came from."""

    model: str
    width: int
    height: int
    params: list[float]
    source: visloc.types.CameraSource


class Orientation(BaseModel):
    """How the pixels were read."""

    exif: Annotated[int, Field(description="1 to 8 as stored in the photo, 1 when absent")]
    read_as: visloc.types.ReadAs


class MapRef(BaseModel):
    """The map that answered."""

    id: str
    version: str


class LocalizeResponse(BaseModel):
    """The answer: a pose, or the reason why there is none."""

    request_id: str
    status: Literal["localized", "not_localized"]
    pose: PoseEstimate | None
    refusal: Refusal | None
    keypoints: int
    correspondences: int
    inliers: int
    inlier_ratio: float
    retrieved: list[RetrievedImage]
    camera: CameraUsed
    orientation: Orientation
    map: MapRef
    seconds: Annotated[dict[str, float], Field(description="by stage")]

    @staticmethod
    def from_localization(found: Localization, request_id: str) -> LocalizeResponse:
        """Say it in the API's words."""
        answer, evidence = found.answer, found.answer.evidence
        localized = isinstance(answer, visloc.types.Localized)
        camera = evidence.camera
        return LocalizeResponse(
            request_id=request_id,
            status="localized" if localized else "not_localized",
            pose=_pose_estimate(answer) if isinstance(answer, visloc.types.Localized) else None,
            refusal=None
            if isinstance(answer, visloc.types.Localized)
            else Refusal(stage=answer.stage, reason=answer.reason, message=answer.message),
            keypoints=evidence.num_keypoints,
            correspondences=evidence.num_correspondences,
            inliers=evidence.num_inliers,
            inlier_ratio=evidence.inlier_ratio,
            retrieved=[
                RetrievedImage(image=r.name, score=r.score, similarities=dict(r.similarities))
                for r in evidence.retrieved
            ],
            camera=CameraUsed(
                model=camera.model,
                width=camera.width,
                height=camera.height,
                params=list(camera.params),
                source=evidence.camera_source,
            ),
            orientation=Orientation(exif=evidence.exif_orientation, read_as=evidence.read_as),
            map=MapRef(id=found.map_id, version=found.map_version),
            seconds=dict(evidence.seconds),
        )


def _pose_estimate(answer: visloc.types.Localized) -> PoseEstimate:
    cam_from_world = answer.cam_from_world
    return PoseEstimate(
        cam_from_world=Transform(
            rotation_wxyz=cam_from_world.rotation_wxyz.tolist(),
            translation=cam_from_world.translation.tolist(),
        ),
        position=cam_from_world.center.tolist(),
        orientation=cam_from_world.inverse().rotation_wxyz.tolist(),
        covariance=answer.covariance.ravel().tolist(),
        position_std=answer.position_std.tolist(),
        orientation_std_deg=np.degrees(answer.orientation_std).tolist(),
    )


class Extent(BaseModel):
    """Smallest box along the world's axes that holds all landmarks."""

    min: list[float]
    max: list[float]


class MapInfo(BaseModel):
    """What a map is."""

    id: str
    version: str
    created: Annotated[str, Field(description="ISO 8601, UTC")]
    metric: Annotated[bool, Field(description="whether one unit of the world is a metre")]
    method: str
    local_features: str
    global_features: list[str]
    images: int
    landmarks: int
    observations: int
    extent: Extent
    size_bytes: int

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
        )


class ListMapsResponse(BaseModel):
    """The maps that are served."""

    maps: list[MapInfo]


class Health(BaseModel):
    """The process answers."""

    status: Literal["ok"] = "ok"
    version: str


class MapNotLoaded(BaseModel):
    """A map that is on disk and cannot be served."""

    id: str
    code: str
    message: str


class Readiness(BaseModel):
    """Whether photos are accepted."""

    ready: bool
    maps: Annotated[list[str], Field(description="id@version of what is loaded")]
    not_loaded: list[MapNotLoaded]


class Problem(BaseModel):
    """An error, as RFC 9457 problem details. ``code`` and ``kind`` are stable."""

    type: str = "about:blank"
    title: Annotated[str, Field(description="the HTTP status in words")]
    status: int
    detail: Annotated[str, Field(description="what is wrong, for a person")]
    code: Annotated[str, Field(description="a stable word such as camera.param_count")]
    field: Annotated[str | None, Field(description="the field that is wrong")] = None
    expected: Annotated[str | None, Field(description="what would have been right")] = None
    got: Annotated[str | None, Field(description="what came instead")] = None
    kind: Annotated[str, Field(description="the kind of error, such as InvalidInput")]
    request_id: str


def invalid_input(complaint: Mapping[str, Any], path: str = "") -> InvalidInput:
    """Say one of pydantic's complaints in our words. Never echoes a large value."""
    kind, message = complaint["type"], complaint["msg"]
    field = path + ".".join(str(part) for part in complaint["loc"])
    if kind == "json_invalid":
        return InvalidInput(
            "request.malformed", message, field=path.rstrip(".") or None, expected="JSON"
        )
    if kind == "missing":
        return InvalidInput("request.missing_field", "this field is needed", field=field)
    got = complaint["input"]
    got = got if isinstance(got, str | int | float | None) else type(got).__name__
    return InvalidInput("request.invalid", "cannot be used", field=field, expected=message, got=got)
