"""Photos in requests, and features that are sent instead of them."""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, FailFast, Field
from pydantic.json_schema import WithJsonSchema
from pydantic_core import PydanticCustomError

import visloc.types
from visloc.errors import refuse
from visloc.options import MAX_PHOTOS
from visloc_api.words.base import AS_BASE64
from visloc_api.words.json_text import bytes_of_base64
from visloc_api.words.message import IncomingMessage, converted
from visloc_api.words.wire import ARRAY_DTYPES

MAX_GLOBAL_DESCRIPTORS = 32
# Two such sides stay within what NumPy can count.
_MAX_ARRAY_SIDE = 2**31 - 1


def _bytes_from_base64(value: object, field: str) -> object:
    if not isinstance(value, str):
        return value
    try:
        return bytes_of_base64(value)
    except ValueError as error:
        raise refuse(
            "image.base64",
            field=field,
            expected="the encoded photo in base64",
            got=str(error),
        ) from None


_AS_TEXT = WithJsonSchema({"type": "string", "contentEncoding": "base64"})
# An encoded photo, or its mask, in JSON as base64.
GivenImage = Annotated[
    bytes | None, converted(partial(_bytes_from_base64, field="image")), AS_BASE64, _AS_TEXT
]
GivenMask = Annotated[
    bytes | None, converted(partial(_bytes_from_base64, field="mask")), AS_BASE64, _AS_TEXT
]


def _array_bytes_from_base64(value: object) -> object:
    if not isinstance(value, str):
        return value
    try:
        return bytes_of_base64(value)
    except ValueError:
        raise PydanticCustomError("base64", "the array's bytes in base64") from None


class Array(IncomingMessage):
    """An array in little-endian, row-major order."""

    dtype: Annotated[str, Field(description=f"one of {', '.join(ARRAY_DTYPES)}")]
    shape: Annotated[
        list[int], FailFast(), Field(description="[rows, columns], or [length] for a single row")
    ]
    data: Annotated[
        bytes,
        BeforeValidator(_array_bytes_from_base64),
        AS_BASE64,
        WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
        Field(description="base64 of as many bytes as dtype and shape say"),
    ]

    @staticmethod
    def from_core(array: NDArray[np.generic]) -> Array:
        return Array(dtype=array.dtype.name, shape=list(array.shape), data=array.tobytes())

    def to_core(self, field: str, ndim: int) -> NDArray[np.generic]:
        """Return the array, without copying its bytes."""
        dtype = ARRAY_DTYPES.get(self.dtype)
        if dtype is None:
            raise refuse(
                "features.dtype", field=f"{field}.dtype", expected=ARRAY_DTYPES, got=self.dtype
            )
        if len(self.shape) != ndim or not all(0 <= n <= _MAX_ARRAY_SIDE for n in self.shape):
            raise refuse(
                "features.shape",
                field=f"{field}.shape",
                expected="two numbers: rows, columns" if ndim == 2 else "one number: its length",
                got=str(self.shape[:8]),
            )
        num_bytes = math.prod(self.shape) * dtype.itemsize
        if len(self.data) != num_bytes:
            raise refuse(
                "features.data",
                field=f"{field}.data",
                expected=f"{num_bytes} bytes",
                got=f"{len(self.data)} bytes",
            )
        return np.frombuffer(self.data, dtype).reshape(self.shape)


def _few(value: object) -> object:
    if isinstance(value, dict) and len(value) > MAX_GLOBAL_DESCRIPTORS:
        raise refuse(
            "features.global_descriptors",
            field="global_descriptors",
            expected=f"at most {MAX_GLOBAL_DESCRIPTORS}, as the map has them",
            got=len(value),
        )
    return value


def _not_too_many(value: object) -> object:
    if isinstance(value, dict) and len(value) > MAX_PHOTOS:
        raise refuse(
            "features.matches",
            field="matches",
            expected=f"matches with at most {MAX_PHOTOS} mapping photos",
            got=len(value),
        )
    return value


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
        converted(_few),
        Field(
            default_factory=dict,
            description="one row for each name in the map's global_features; those made of local "
            "features (localvlad) may be left out",
        ),
    ]

    matches: Annotated[
        dict[str, Array] | None,
        converted(_not_too_many),
        Field(
            description="by the name of a mapping photo, k x 3: the row of a keypoint, and x, y of "
            "the photo's keypoint that it is matched with; they replace the service's own matching",
        ),
    ] = None

    def to_core(self) -> visloc.types.QueryFeatures:
        """Return the features, their arrays checked for what they say of themselves.

        Raises:
            InvalidInput: ``features.dtype``, ``features.shape`` or ``features.data``.
        """
        return visloc.types.QueryFeatures(
            self.kind,
            self.keypoints.to_core("features.keypoints", 2),
            self.descriptors.to_core("features.descriptors", 2),
            {
                name: row.to_core(f"features.global_descriptors.{name[:100]}", 1)
                for name, row in self.global_descriptors.items()
            },
            {
                name: rows.to_core(f"features.matches.{name[:100]}", 2)
                for name, rows in (self.matches or {}).items()
            },
        )

    @staticmethod
    def from_core(features: visloc.types.QueryFeatures) -> Features:
        rows = features.global_descriptors
        sent = {name: Array.from_core(each) for name, each in features.matches.items()}
        return Features(
            kind=features.kind,
            keypoints=Array.from_core(features.keypoints),
            descriptors=Array.from_core(features.descriptors),
            global_descriptors={name: Array.from_core(row) for name, row in rows.items()},
            matches=sent or None,
        )


def _features_from_text(value: object) -> object:
    return Features.read_json(value) if isinstance(value, str | bytes) else value


# Features as an object, or as a file of a form.
GivenFeatures = Annotated[Features | None, converted(_features_from_text)]


def query_to_core(
    image: bytes | None, features: Features | None, mask: bytes | None = None
) -> bytes | visloc.types.MaskedImage | visloc.types.QueryFeatures:
    """Return the photo, with its mask if it has one, or the features, whichever was sent."""
    if mask is not None and image is None:
        raise refuse("mask.needs_photo", field="mask")
    if image is not None and features is None:
        return image if mask is None else visloc.types.MaskedImage(image, mask)
    if features is not None and image is None:
        return features.to_core()
    raise refuse("request.query", field="image", got="neither" if image is None else "both")
