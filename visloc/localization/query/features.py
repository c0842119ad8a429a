"""Features that were sent instead of a photo: checked against the map and the camera."""

from __future__ import annotations

from collections.abc import Set

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Manifest
from visloc.errors import VislocError, refuse
from visloc.features.local.readymade import (
    MAX_READY_MADE_KEYPOINTS,
    is_ready_made,
    to_global_descriptor,
    to_local_features,
)
from visloc.geometry import Camera
from visloc.types import LocalFeatures, QueryFeatures

# Extractors that work on a shrunk or padded photo may place a keypoint a little beyond its edge.
EDGE_TOLERANCE_PX = 1.0


def max_sent_keypoints(manifest: Manifest) -> int:
    """Return how many keypoints may be sent: as many as a photo of the map may have."""
    local = manifest.local_features
    # A map of ready-made features keeps all keypoints; its max_keypoints is no limit.
    return (
        MAX_READY_MADE_KEYPOINTS if is_ready_made(local.fingerprint.name) else local.max_keypoints
    )


def checked_local_features(
    features: QueryFeatures, camera: Camera, manifest: Manifest
) -> LocalFeatures:
    """Return sent keypoints and descriptors as local features, with rows of unit length."""
    _check_kind(features.kind, manifest)
    keypoints, descriptors = features.keypoints, features.descriptors
    if keypoints.ndim != 2 or keypoints.shape[1] != 2:
        raise _unusable("keypoints", "the keypoints are not valid", "(N, 2): x, y", keypoints.shape)
    most = max_sent_keypoints(manifest)
    if len(keypoints) > most:
        raise refuse(
            "features.too_many",
            field="features.keypoints",
            expected=f"at most {most}",
            got=len(keypoints),
        )
    dim = manifest.local_features.descriptor_dim
    if descriptors.shape != (len(keypoints), dim):
        raise _unusable(
            "descriptors",
            "the descriptors do not fit the keypoints or the map",
            f"a row of {dim} for each of the {len(keypoints)} keypoints",
            descriptors.shape,
        )
    _check_inside(keypoints, camera)
    _check_finite("descriptors", "features.descriptors", descriptors)
    empty = np.flatnonzero(~descriptors.any(axis=1))
    if len(empty):
        raise _unusable("descriptors", f"row {empty[0]} is all zeros", "not all zero", "zeros")
    return to_local_features(keypoints.astype(np.float32, copy=False), descriptors)


def checked_global_descriptors(
    features: QueryFeatures, manifest: Manifest, optional: Set[str]
) -> dict[str, NDArray[np.float32]]:
    """Return the sent global descriptors by name, of unit length.

    Args:
        optional: names of those that need not be sent, because they can be computed.
    """
    sent = features.global_descriptors
    dims = {record.fingerprint.name: record.dim for record in manifest.global_features}
    unknown = sorted(set(sent) - set(dims))
    missing = sorted(set(dims) - set(sent) - optional)
    if unknown or missing:
        raise _unusable(
            "global_descriptors",
            "the map does not have this global descriptor"
            if unknown
            else "a global descriptor of the map is missing and cannot be computed from the "
            "other features",
            ", ".join(f"{name} ({'may' if name in optional else 'must'} be sent)" for name in dims),
            ", ".join(map(repr, sorted(sent))) or "none",
        )
    for name, row in sent.items():
        field = f"features.global_descriptors.{name}"
        if row.shape != (dims[name],):
            raise _unusable(
                "global_descriptors",
                "the global descriptor does not have the size of the map's",
                f"shape ({dims[name]},)",
                row.shape,
                field,
            )
        _check_finite("global_descriptors", field, row)
    return {
        # A zero vector, of a blank photo, is similar to nothing.
        name: to_global_descriptor(row) if row.any() else np.zeros(row.shape, np.float32)
        for name, row in sent.items()
    }


def _check_kind(kind: str, manifest: Manifest) -> None:
    name = manifest.local_features.fingerprint.name
    if kind != name:
        raise refuse("features.kind", field="features.kind", expected=name, got=kind)


def _check_inside(keypoints: NDArray[np.generic], camera: Camera) -> None:
    with np.errstate(invalid="ignore"):  # signalling NaN; all NaN count as outside
        xy = keypoints.astype(np.float64)
    low, high = -EDGE_TOLERANCE_PX, np.array([camera.width, camera.height]) + EDGE_TOLERANCE_PX
    outside = np.flatnonzero(~((xy >= low) & (xy <= high)).all(axis=1))  # NaN is outside too
    if len(outside):
        row = int(outside[0])
        raise _unusable(
            "keypoints",
            f"keypoint {row} lies outside the camera's image",
            f"0 to {camera.width}, 0 to {camera.height}",
            f"{xy[row, 0]:g}, {xy[row, 1]:g}",
        )


def _check_finite(part: str, field: str, values: NDArray[np.generic]) -> None:
    # Also refuse values beyond float32, and NaN of any kind.
    with np.errstate(over="ignore", invalid="ignore"):
        finite = np.isfinite(values.astype(np.float32, copy=False))
    if not finite.all():
        where = ", ".join(str(int(i)) for i in np.argwhere(~finite)[0])
        raise _unusable(
            part, f"[{where}] is not a finite number", "finite numbers", "NaN or inf", field
        )


def _unusable(
    part: str, message: str, expected: str, got: object, field: str | None = None
) -> VislocError:
    return refuse(
        f"features.{part}",
        message,
        field=field or f"features.{part}",
        expected=expected,
        got=got if isinstance(got, str) else str(got),
    )
