"""Layout of feature files: kinds, names, and types of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from visloc.errors import refuse
from visloc.kapture.text import relative_path

FeatureKind = Literal["keypoints", "descriptors", "global_features"]

# Maps name the features of a dataset by this prefix and TYPE.
READY_MADE_PREFIX = "kapture:"

DTYPES: Mapping[str, np.dtype[Any]] = {
    "float32": np.dtype("<f4"),
    "float64": np.dtype("<f8"),
    "uint8": np.dtype("u1"),
    "int32": np.dtype("<i4"),
}
COLUMNS: Mapping[FeatureKind, tuple[str, ...]] = {
    "keypoints": ("name", "dtype", "dsize"),
    "descriptors": ("name", "dtype", "dsize", "keypoints_type", "metric_type"),
    "global_features": ("name", "dtype", "dsize", "metric_type"),
}
SUFFIXES: Mapping[FeatureKind, str] = {
    "keypoints": ".kpt",
    "descriptors": ".desc",
    "global_features": ".gfeat",
}


def feature_file(kind: FeatureKind, image_path: str) -> str:
    """Return the path of an image's features in their folder."""
    try:
        return relative_path(image_path) + SUFFIXES[kind]
    except ValueError:
        raise refuse(
            "kapture.path",
            f"an image of this path cannot have {kind.replace('_', ' ')}",
            field="image_path",
            expected="a relative path that stays inside the dataset",
            got=image_path,
        ) from None


def parse_dtype(text: str) -> np.dtype[Any] | None:
    """Look up the type that a config file names; None if kapture has no such type.

    Files of kapture 1.0 also hold Python's spellings, such as ``np.float32`` and ``float``.
    """
    name = text.removeprefix("numpy.").removeprefix("np.")
    return DTYPES.get("float64" if name == "float" else name)
