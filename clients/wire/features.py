"""Features of a photo, to be sent instead of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import visloc_api.words.features
from visloc.errors import VislocError, refuse
from visloc.types import MaskedImage, QueryFeatures
from visloc_api.words.wire import ARRAY_DTYPES


@dataclass(frozen=True, slots=True, eq=False)
class Features(QueryFeatures):
    """The features of one photo, for a map with the same kind of features.

    Arrays of float32, float16, uint8 and int8 are sent as they are, float64 as float32. Rows may
    have any length: the server normalizes descriptors. A global descriptor that is made of local
    features, ``localvlad``, may be left out.

    Raises:
        InvalidInput: ``features.keypoints``, ``features.descriptors``,
            ``features.global_descriptors`` or ``features.matches`` for a wrong shape,
            ``features.dtype``.
    """

    def __post_init__(self) -> None:
        keypoints = _array("keypoints", self.keypoints)
        descriptors = _array("descriptors", self.descriptors)
        rows = {
            name: _array("global_descriptors", row, name)
            for name, row in self.global_descriptors.items()
        }
        if keypoints.ndim != 2 or keypoints.shape[1] != 2:
            raise _wrong_shape("keypoints", "(N, 2): x, y", keypoints)
        if descriptors.ndim != 2 or len(descriptors) != len(keypoints):
            raise _wrong_shape("descriptors", f"({len(keypoints)}, D), as keypoints", descriptors)
        for name, row in rows.items():
            if row.ndim != 1:
                raise _wrong_shape("global_descriptors", "(D,)", row, name)
        object.__setattr__(self, "keypoints", keypoints)
        object.__setattr__(self, "descriptors", descriptors)
        object.__setattr__(self, "global_descriptors", rows)
        matches = {name: _array("matches", each, name) for name, each in self.matches.items()}
        for name, each in matches.items():
            if each.ndim != 2 or each.shape[1] != 3:
                raise _wrong_shape("matches", "(k, 3): row, x, y", each, name)
        object.__setattr__(self, "matches", matches)

    def as_json(self) -> dict[str, Any]:
        """Return the features as the API has them in JSON, with arrays in base64."""
        return visloc_api.words.features.Features.from_core(self).as_json()


# The encoded photo, also with a mask, the path of the file that holds it, or what was found in it.
PhotoOrFeatures = bytes | str | Path | MaskedImage | Features


def _array(part: str, values: ArrayLike, name: str | None = None) -> NDArray[Any]:
    """Return an array that can be sent as it lies in memory."""
    array = np.asarray(values)
    dtype = "float32" if array.dtype == np.float64 else array.dtype.name
    if dtype not in ARRAY_DTYPES:
        raise refuse(
            "features.dtype",
            field=_field(part, name),
            expected=f"one of {', '.join(ARRAY_DTYPES)}, float64",
            got=array.dtype.name,
        )
    return np.ascontiguousarray(array, dtype=ARRAY_DTYPES[dtype])


def _wrong_shape(
    part: str, expected: str, array: NDArray[Any], name: str | None = None
) -> VislocError:
    return refuse(
        f"features.{part}",
        "the array does not have the right shape",
        field=_field(part, name),
        expected=expected,
        got=str(array.shape),
    )


def _field(part: str, name: str | None) -> str:
    return f"features.{part}" if name is None else f"features.{part}.{name}"
