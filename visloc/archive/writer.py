"""Writing a map folder: arrays first, the manifest last."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from visloc.archive.checks import content_hash, json_text, manifest_hash, sha256_of
from visloc.archive.schema import (
    FORMAT,
    FORMAT_MAJOR,
    FORMAT_MINOR,
    Anchor,
    FingerprintRecord,
    ImageRecord,
    Vector,
)
from visloc.geometry import Camera, Pose


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Landmarks and who observes them, as one of the mapping methods made them.

    Attributes:
        origin: (3,) float64, the point of the world that ``points`` are relative to.
        points: (P, 3) float32.
        track_lengths: (P,) uint16.
        errors_px: (P,) float32, NaN where it does not apply.
        angles_deg: (P,) float32, NaN where it does not apply.
        offsets: (n + 1,) int64, rows of the next two by photo.
        observed: (M,) uint32 rows of ``points``.
        keypoints: (M, 2) float32 pixels.
        colors: (P, 3) uint8 RGB; None if they are not known.
    """

    origin: NDArray[np.float64]
    points: NDArray[np.float32]
    track_lengths: NDArray[np.uint16]
    errors_px: NDArray[np.float32]
    angles_deg: NDArray[np.float32]
    offsets: NDArray[np.int64]
    observed: NDArray[np.uint32]
    keypoints: NDArray[np.float32]
    colors: NDArray[np.uint8] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class GlobalFeatures:
    """One global descriptor of all mapping photos, with its model: empty if it is ready-made."""

    fingerprint: FingerprintRecord
    descriptors: NDArray[np.float32]
    model: Mapping[str, NDArray[np.float32]]


@dataclass(frozen=True, slots=True, eq=False)
class MapContent:
    """Everything a map holds, but its id, version and creation time.

    ``descriptors()`` yields, photo by photo, the unit descriptors (m_i, D) float32 of that photo's
    observations in the order of ``landmarks``; it is read twice. ``gravity`` is the unit vector
    that points down in the world, None where that is not known.
    """

    metric: bool
    method: str
    settings: Mapping[str, JsonValue]
    notes: tuple[str, ...]
    cameras: Mapping[str, Camera]
    rigs: Mapping[str, Mapping[str, Pose]]
    images: tuple[ImageRecord, ...]
    image_poses: tuple[Pose, ...]
    landmarks: Landmarks
    local_fingerprint: FingerprintRecord
    max_keypoints: int
    descriptor_dim: int
    descriptors: Callable[[], Iterator[NDArray[np.float32]]]
    global_features: tuple[GlobalFeatures, ...]
    anchor: Anchor | None = None
    gravity: Vector | None = None


def write_map(folder: Path, content: MapContent, *, map_id: str, version: str, created: str) -> str:
    """Write a map into an empty folder. All files are on disk when this returns.

    Args:
        folder: exists and is empty.
        content: the map.
        map_id: the map's id.
        version: its version, or a prefix ending in ``-``, to which a part of the content hash
            is appended.
        created: ISO 8601 in UTC; given, because nothing below ``mapping`` reads a clock.

    Returns:
        The version.
    """
    landmarks = content.landmarks
    (folder / "global").mkdir()
    _write_json(
        folder / "cameras.json",
        {
            "cameras": {
                key: {"model": c.model, "width": c.width, "height": c.height, "params": c.params}
                for key, c in content.cameras.items()
            },
            "rigs": {
                rig: {key: _row(pose) for key, pose in members.items()}
                for rig, members in content.rigs.items()
            },
        },
    )
    _write_json(
        folder / "images.json", {"images": [image.model_dump() for image in content.images]}
    )
    arrays: dict[str, NDArray[Any]] = {
        "image_poses.npy": np.array([_row(pose) for pose in content.image_poses], dtype="<f8"),
        "landmarks.npy": landmarks.points.astype("<f4", copy=False),
        "landmark_track_length.npy": landmarks.track_lengths.astype("<u2", copy=False),
        "landmark_error_px.npy": landmarks.errors_px.astype("<f4", copy=False),
        "landmark_angle_deg.npy": landmarks.angles_deg.astype("<f4", copy=False),
        "observation_offsets.npy": landmarks.offsets.astype("<i8", copy=False),
        "observation_landmarks.npy": landmarks.observed.astype("<u4", copy=False),
        "observation_keypoints.npy": landmarks.keypoints.astype("<f4", copy=False),
    }
    if landmarks.colors is not None:
        arrays["landmark_rgb.npy"] = landmarks.colors.astype("u1", copy=False)
    for features in content.global_features:
        stem = features.fingerprint.file_stem
        arrays[f"global/{stem}.npy"] = features.descriptors.astype("<f4", copy=False)
        with (folder / f"global/{stem}.model.npz").open("xb") as file:
            # The savez stub takes no mapping of arrays as keywords beside allow_pickle.
            np.savez(file, **features.model)  # type: ignore[arg-type]
    for name, array in arrays.items():
        _write_array(folder / name, array.dtype, array.shape, [array])
    scale = _write_descriptors(
        folder / "observation_descriptors.npy",
        content.descriptors,
        (len(landmarks.observed), content.descriptor_dim),
    )
    extent = landmarks.points.min(axis=0), landmarks.points.max(axis=0)
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "format_version": f"{FORMAT_MAJOR}.{FORMAT_MINOR}",
        "id": map_id,
        "created": created,
        "world": {
            "metric": content.metric,
            "origin": landmarks.origin.tolist(),
            "extent": {
                "min": (landmarks.origin + extent[0]).tolist(),
                "max": (landmarks.origin + extent[1]).tolist(),
            },
            **({} if content.anchor is None else {"anchor": content.anchor.model_dump()}),
            **({} if content.gravity is None else {"gravity": list(content.gravity)}),
        },
        "method": {"name": content.method, "settings": dict(content.settings)},
        "local_features": {
            "fingerprint": content.local_fingerprint.model_dump(),
            "max_keypoints": content.max_keypoints,
            "descriptor_dim": content.descriptor_dim,
            "descriptor_scale": scale,
        },
        "global_features": [
            {"fingerprint": f.fingerprint.model_dump(), "dim": f.descriptors.shape[1]}
            for f in content.global_features
        ],
        "counts": {
            "images": len(content.images),
            "landmarks": len(landmarks.points),
            "observations": len(landmarks.observed),
        },
        "notes": list(content.notes),
        "files": {
            path.relative_to(folder).as_posix(): {
                "size": path.stat().st_size,
                "sha256": sha256_of(path),
            }
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        },
    }
    digest = content_hash(manifest)
    manifest["content_hash"] = digest
    manifest["version"] = version + digest[:8] if version.endswith("-") else version
    manifest["manifest_hash"] = manifest_hash(manifest)
    _write_json(folder / "manifest.json", manifest)
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
    return str(manifest["version"])


def _row(pose: Pose) -> list[float]:
    return [*pose.rotation_wxyz.tolist(), *pose.translation.tolist()]


def _write_json(path: Path, value: object) -> None:
    path.write_text(json_text(value), encoding="utf-8")


def _write_descriptors(
    path: Path, descriptors: Callable[[], Iterator[NDArray[np.float32]]], shape: tuple[int, int]
) -> float:
    """Store unit descriptors in 8 bits and return the value of one step.

    One step for the whole map: it keeps products of stored integers comparable.
    """
    largest = max((float(np.abs(block).max(initial=0.0)) for block in descriptors()), default=0.0)
    scale = (largest or 1.0) / 127.0
    num_rows = 0

    def stored() -> Iterator[NDArray[np.int8]]:
        nonlocal num_rows
        for block in descriptors():
            num_rows += len(block)
            yield np.rint(block / np.float32(scale)).astype(np.int8)

    _write_array(path, np.dtype(np.int8), shape, stored())
    if num_rows != shape[0]:
        raise AssertionError(f"{num_rows} descriptors for {shape[0]} observations")
    return scale


def _write_array(
    path: Path, dtype: np.dtype[Any], shape: tuple[int, ...], blocks: Iterable[NDArray[Any]]
) -> None:
    """Write an ``.npy`` block by block.

    On a full disk ``np.save`` does not say what is wrong, and a memory map ends the process.
    """
    header = {"descr": dtype.str, "fortran_order": False, "shape": shape}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for block in blocks:
            file.write(np.ascontiguousarray(block).data)
