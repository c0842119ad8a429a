"""Features that come with a dataset or a query: ``kapture:TYPE``.

Rows are compared by their dot product after scaling to unit length, which ranks as the cosine
does, and as the L2 distance of rows that had unit length before (R2D2, D2-Net, AP-GeM).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.kapture import READY_MADE_PREFIX, FeatureSet
from visloc.types import Fingerprint, LocalFeatures

# Most keypoints of a photo, in the dataset and in queries. The time that a query takes grows with
# them, and nobody chose a number when the map was built.
MAX_READY_MADE_KEYPOINTS = 20_000
_METRICS = ("l2", "cosine", "dot")


def is_ready_made(name: str) -> bool:
    """Tell whether a name of features, ``kapture:TYPE``, means ready-made ones."""
    return name.startswith(READY_MADE_PREFIX)


def ready_made_type(name: str) -> str:
    """Return TYPE of ``kapture:TYPE``."""
    if not is_ready_made(name):
        raise refuse(
            "features.unknown",
            "this is not the name of ready-made features",
            field="features",
            expected="kapture:TYPE",
            got=name,
        )
    return name.removeprefix(READY_MADE_PREFIX)


def ready_made_fingerprint(features: FeatureSet) -> Fingerprint:
    """Identify ready-made descriptors, local or global.

    The files do not say with which weights or settings they were made. Two extractions of one type
    are taken to be comparable.
    """
    metric = (features.metric_type or "").lower()
    if metric not in _METRICS:
        raise refuse(
            "features.metric",
            field=str(features.folder / f"{features.kind}.txt"),
            expected=f"metric_type L2, cosine or dot for {features.kind} {features.type_name}",
            got=features.metric_type,
        )
    return Fingerprint(
        name=READY_MADE_PREFIX + features.type_name,
        revision=1,
        parameters={
            "dtype": features.dtype.name,
            "dsize": features.dsize,
            "metric_type": metric,
            "method": features.name,
        },
    )


def to_local_features(keypoints: NDArray[np.float32], descriptors: NDArray[Any]) -> LocalFeatures:
    """Make local features of what was brought along.

    Args:
        keypoints: (N, 2) pixels, top-left centre at (0.5, 0.5).
        descriptors: (N, D) of any real type.

    Returns:
        The same rows in the same order, descriptors scaled to unit length. Scores and scales,
        which nobody told, are 1.
    """
    if descriptors.ndim != 2 or keypoints.shape != (len(descriptors), 2):
        raise refuse(
            "features.shape",
            "these are not the features of one photo",
            field="descriptors",
            expected="(N, 2) keypoints and (N, D) descriptors",
            got=f"{keypoints.shape} and {descriptors.shape}",
        )
    ones = np.ones(len(keypoints), dtype=np.float32)
    return LocalFeatures(
        keypoints=keypoints.astype(np.float32, copy=False),
        descriptors=_unit_rows(descriptors, "descriptors"),
        scores=ones,
        scales=ones.copy(),
    )


def to_global_descriptor(row: NDArray[Any]) -> NDArray[np.float32]:
    """Scale one global descriptor (D,) of any real type to unit length."""
    if row.ndim != 1:
        raise refuse(
            "features.shape",
            "this is not a global descriptor",
            field="global_descriptor",
            expected="one row (D,)",
            got=str(row.shape),
        )
    unit: NDArray[np.float32] = _unit_rows(row[np.newaxis], "global_descriptor")[0]
    return unit


def _unit_rows(rows: NDArray[Any], field: str) -> NDArray[np.float32]:
    # The largest number first: squares of large float64 overflow, those of small ones vanish.
    wide = rows.astype(np.float64)
    largest = np.abs(wide).max(axis=1, initial=0.0, keepdims=True)
    usable = (np.isfinite(largest) & (largest > 0)).ravel()
    if not usable.all():
        row = int(np.argmin(usable))
        raise refuse("features.descriptor", field=field, got=rows[row, :4].tolist(), row=row)
    wide /= largest
    wide /= np.linalg.norm(wide, axis=1, keepdims=True)
    return wide.astype(np.float32)
