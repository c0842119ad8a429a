"""The words of the API: what requests and answers look like in JSON.

The messages of ``proto/visloc_api/v1/localization.proto`` have the same fields, and gRPC answers
are made from these models, so that both doors give the same numbers.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, Field
from pydantic.json_schema import WithJsonSchema
from pydantic_core import PydanticCustomError

import visloc.geometry
import visloc.types
from service.engine import Localization, LocalizeJob
from service.incoming import IncomingMessage
from visloc.archive import Map
from visloc.errors import InvalidInput

_CAMERA_TEXT = "PINHOLE,640,480,525,525,320,240"

# What an array may be made of, little-endian where it has more than one byte.
ARRAY_DTYPES: Mapping[str, np.dtype[Any]] = {
    "float32": np.dtype("<f4"),
    "float16": np.dtype("<f2"),
    "uint8": np.dtype("u1"),
    "int8": np.dtype("i1"),
}
MAX_GLOBAL_DESCRIPTORS = 32
# Two such sides stay within what NumPy can count.
_MAX_ARRAY_SIDE = 2**31 - 1


class Camera(IncomingMessage):
    """Intrinsics for the pixels as stored."""

    path: ClassVar[str] = "camera."

    model: Annotated[str, Field(description="COLMAP's name, such as PINHOLE")]
    width: Annotated[int, Field(description="pixels")]
    height: Annotated[int, Field(description="pixels")]
    params: Annotated[
        list[float], Field(description="in COLMAP's order, pixels where they are lengths")
    ]

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


class LocalizeOptions(IncomingMessage):
    """What may be chosen per query. null is the same as left out."""

    path: ClassVar[str] = "options."

    preset: Annotated[
        str | None,
        Field(description="the thresholds to start from: default, config1 or config2"),
    ] = None
    top_k: Annotated[
        int | None, Field(description="mapping photos to match against: 1 to 1000, by default 20")
    ] = None
    max_error_px: Annotated[
        float | None,
        Field(
            description="largest reprojection error of an inlier: 0.1 to 1000 pixels, by default "
            "the preset's"
        ),
    ] = None
    min_inliers: Annotated[
        int | None,
        Field(
            description="fewest inliers of an accepted pose: 4 to 1000000, by default the preset's"
        ),
    ] = None
    min_inlier_ratio: Annotated[
        float | None,
        Field(
            description="smallest share of inliers among the correspondences: 0 to 1, by default "
            "the preset's"
        ),
    ] = None
    read_as: Annotated[
        str | None,
        Field(
            description="stored (default), or upright: turn the photo by its EXIF orientation "
            "before features are found"
        ),
    ] = None
    seed: Annotated[int | None, Field(description="of RANSAC: 0 to 2147483647, by default 0")] = (
        None
    )

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


def _array_bytes_from_base64(value: object) -> object:
    if not isinstance(value, str):
        return value
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError):
        raise PydanticCustomError("base64", "the array's bytes in standard base64") from None


class Array(IncomingMessage):
    """Numbers in little-endian order, the last index running fastest."""

    dtype: Annotated[str, Field(description=f"one of {', '.join(ARRAY_DTYPES)}")]
    shape: Annotated[list[int], Field(description="rows and columns; of a single row its length")]
    data: Annotated[
        bytes,
        BeforeValidator(_array_bytes_from_base64),
        WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
        Field(description="as many bytes as dtype and shape say"),
    ]

    def to_core(self, field: str, ndim: int) -> NDArray[np.generic]:
        """Return the array, without copying its bytes.

        Raises:
            InvalidInput: ``features.dtype``, ``features.shape`` or ``features.data``.
        """
        dtype = ARRAY_DTYPES.get(self.dtype)
        if dtype is None:
            raise InvalidInput(
                "features.dtype",
                "an array of these is not read here",
                field=f"{field}.dtype",
                expected=f"one of {', '.join(ARRAY_DTYPES)}",
                got=self.dtype,
            )
        if len(self.shape) != ndim or not all(0 <= n <= _MAX_ARRAY_SIDE for n in self.shape):
            raise InvalidInput(
                "features.shape",
                "not the shape of such an array",
                field=f"{field}.shape",
                expected="two numbers: rows, columns" if ndim == 2 else "one number: its length",
                got=str(self.shape[:8]),
            )
        num_bytes = math.prod(self.shape) * dtype.itemsize
        if len(self.data) != num_bytes:
            raise InvalidInput(
                "features.data",
                "the array does not have the bytes that its dtype and shape say",
                field=f"{field}.data",
                expected=f"{num_bytes} bytes",
                got=f"{len(self.data)} bytes",
            )
        return np.frombuffer(self.data, dtype).reshape(self.shape)


class Features(IncomingMessage):
    """What was found in one photo. Descriptors may have any length: the server normalizes them."""

    path: ClassVar[str] = "features."

    kind: Annotated[str, Field(description="the map's local_features")]
    keypoints: Annotated[
        Array,
        Field(
            description="N x 2: x, y in pixels; the centre of the top-left pixel is (0.5, 0.5)",
        ),
    ]
    descriptors: Annotated[Array, Field(description="N x D")]
    global_descriptors: Annotated[
        dict[str, Array],
        Field(
            default_factory=dict,
            description="by name in the map's global_features, one row each; one that is made of "
            "local features (localvlad) may be left out",
        ),
    ]

    def to_core(self) -> visloc.types.QueryFeatures:
        """Return the features, their arrays checked for what they say of themselves.

        Raises:
            InvalidInput: ``features.dtype``, ``features.shape``, ``features.data``, or
                ``features.global_descriptors`` when there are more than any map has.
        """
        if len(self.global_descriptors) > MAX_GLOBAL_DESCRIPTORS:
            raise InvalidInput(
                "features.global_descriptors",
                "too many global descriptors",
                field="features.global_descriptors",
                expected=f"at most {MAX_GLOBAL_DESCRIPTORS}, as the map has them",
                got=len(self.global_descriptors),
            )
        return visloc.types.QueryFeatures(
            self.kind,
            self.keypoints.to_core("features.keypoints", 2),
            self.descriptors.to_core("features.descriptors", 2),
            {
                name: row.to_core(f"features.global_descriptors.{name[:100]}", 1)
                for name, row in self.global_descriptors.items()
            },
        )


def _features_from_text(value: object) -> object:
    return Features.read_json(value) if isinstance(value, str | bytes) else value


class LocalizeRequest(IncomingMessage):
    """A photo, or what was found in it, and the map to find it in."""

    map: Annotated[str, Field(description="id, or id@version")]
    image: Annotated[
        bytes | None,
        BeforeValidator(_bytes_from_base64),
        WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
        Field(description="the encoded photo: JPEG, PNG, WebP, TIFF or BMP"),
    ] = None
    features: Annotated[
        Features | None,
        BeforeValidator(_features_from_text),
        Field(description="what was found in the photo, instead of it; needs a camera"),
    ] = None
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
            InvalidInput: ``request.query``, ``features...``, ``camera...`` or ``options...``.
        """
        if self.image is not None and self.features is None:
            query: bytes | visloc.types.QueryFeatures = self.image
        elif self.features is not None and self.image is None:
            query = self.features.to_core()
        else:
            raise InvalidInput(
                "request.query",
                "a request has a photo, or the features of one",
                field="image",
                expected="one of image, features",
                got="neither" if self.image is None else "both",
            )
        camera = None if self.camera is None else self.camera.to_core()
        return LocalizeJob(self.map, query, camera, self.options.to_core())


class Transform(BaseModel):
    """x_a = R x_b + t for a transform called a_from_b."""

    rotation_wxyz: Annotated[list[float], Field(description="unit quaternion, w >= 0")]
    translation: Annotated[list[float], Field(description="metres when the map is metric")]


class PoseEstimate(BaseModel):
    """Where the photo was taken, and how sure that is."""

    cam_from_world: Transform
    position: Annotated[
        list[float],
        Field(description="camera centre in the world, metres when the map is metric"),
    ]
    orientation: Annotated[
        list[float], Field(description="rotation of world_from_cam as w, x, y, z")
    ]
    covariance: Annotated[
        list[float],
        Field(
            description="6 x 6, row by row: rotation (rad), then translation, for "
            "R <- Exp(w) R and t <- t + dt of cam_from_world"
        ),
    ]
    position_std: Annotated[
        list[float],
        Field(description="standard deviations of the position along the world's axes"),
    ]
    orientation_std_deg: Annotated[
        list[float],
        Field(description="standard deviations about the camera's x, y and z axes, degrees"),
    ]


class Refusal(BaseModel):
    """Why there is no pose."""

    stage: Annotated[
        Literal["features", "retrieval", "matching", "pose", "gate"],
        Field(description="the stage that gave up"),
    ]
    reason: Annotated[visloc.types.Reason, Field(description="a stable word")]
    message: Annotated[str, Field(description="for a person")]


class RetrievedImage(BaseModel):
    """A mapping photo that was matched against."""

    image: Annotated[str, Field(description="its name in the map")]
    score: Annotated[float, Field(description="fused, comparable within one answer only")]
    similarities: Annotated[dict[str, float], Field(description="cosine by global descriptor")]


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
            "focal length; or guess, 1.2 times the longer side"
        ),
    ]


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

    request_id: Annotated[str, Field(description="the caller's, or made by the server")]
    status: Literal["localized", "not_localized"]
    pose: Annotated[PoseEstimate | None, Field(description="null when not localized")]
    refusal: Annotated[Refusal | None, Field(description="null when localized")]
    keypoints: Annotated[int, Field(description="found in the photo")]
    correspondences: Annotated[int, Field(description="2D-3D matches given to the solver")]
    inliers: Annotated[
        int, Field(description="of them, those that agree with the best pose, refused or not")
    ]
    inlier_ratio: Annotated[float, Field(description="inliers / correspondences; 0 without any")]
    retrieved: Annotated[
        list[RetrievedImage], Field(description="mapping photos matched against, best first")
    ]
    camera: CameraUsed
    orientation: Orientation
    map: MapRef
    seconds: Annotated[dict[str, float], Field(description="wall time by stage that was reached")]

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
    method: Annotated[str, Field(description="how the landmarks were made, such as rgbd")]
    local_features: Annotated[str, Field(description="such as xfeat")]
    global_features: list[str]
    images: Annotated[int, Field(description="mapping photos")]
    landmarks: Annotated[int, Field(description="3D points")]
    observations: Annotated[int, Field(description="sightings of landmarks in mapping photos")]
    extent: Extent
    size_bytes: Annotated[int, Field(description="on the server's disk")]

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

    ready: Annotated[bool, Field(description="whether the maps of the start are open and warm")]
    maps: Annotated[list[str], Field(description="id@version of what is loaded")]
    not_loaded: Annotated[list[MapNotLoaded], Field(description="they do not prevent readiness")]


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
