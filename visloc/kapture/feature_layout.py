"""What reading and writing features share: kinds of files, their names, types of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

FeatureKind = Literal["keypoints", "descriptors", "global_features"]

# What maps put before TYPE to name the features that a dataset brought along.
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


def parse_dtype(text: str) -> np.dtype[Any] | None:
    """Look up the type that a config file names; None if it is none that kapture has.

    Files of kapture 1.0 hold Python's spellings too, such as ``np.float32`` and ``float``.
    """
    name = text.removeprefix("numpy.").removeprefix("np.")
    return DTYPES.get("float64" if name == "float" else name)
