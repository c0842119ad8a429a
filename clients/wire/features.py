"""Features of a photo, to be sent instead of it."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visloc.errors import VislocError, refuse
from visloc_api.words.wire import ARRAY_DTYPES


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """What was found in one photo, for a map of the same kind of features.

    Arrays of float32, float16, uint8 and int8 are sent as they are, float64 as float32. Rows may
    have any length: the server normalizes descriptors.

    Attributes:
        kind: the map's ``local_features``.
        keypoints: (N, 2), (x, y) in pixels; the centre of the top-left pixel is (0.5, 0.5).
        descriptors: (N, D).
        global_descriptors: (D,) by name in the map's ``global_features``. One that is made of
            local features, ``localvlad``, may be left out.

    Raises:
        InvalidInput: ``features.keypoints``, ``features.descriptors`` or
            ``features.global_descriptors`` for a wrong shape, ``features.dtype``.
    """

    kind: str
    keypoints: NDArray[Any]
    descriptors: NDArray[Any]
    global_descriptors: Mapping[str, NDArray[Any]] = field(default_factory=dict)

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

    def as_json(self) -> dict[str, Any]:
        """Return the features as the API has them in JSON, with arrays in base64."""
        return {
            "kind": self.kind,
            "keypoints": _array_as_json(self.keypoints),
            "descriptors": _array_as_json(self.descriptors),
            "global_descriptors": {
                name: _array_as_json(row) for name, row in self.global_descriptors.items()
            },
        }


# The encoded photo, the path of the file that holds it, or what was found in it.
PhotoOrFeatures = bytes | str | Path | Features


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


def _array_as_json(array: NDArray[Any]) -> dict[str, Any]:
    data = base64.b64encode(array.tobytes()).decode("ascii")
    return {"dtype": array.dtype.name, "shape": list(array.shape), "data": data}


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
