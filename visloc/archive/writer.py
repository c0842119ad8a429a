"""Writing a map folder: arrays first, the manifest last."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.archive.content import GlobalFeatures, Landmarks, MapContent
from visloc.archive.files import BLOCK_ROWS, Files, blocks_of
from visloc.archive.gnss import GNSS_FILE
from visloc.archive.index_files import index_files
from visloc.archive.schema import (
    FORMAT,
    FORMAT_MAJOR,
    FORMAT_MINOR,
    INDEX_FOLDER,
    Parts,
    RetrievalRecord,
)
from visloc.geometry import Camera, Pose
from visloc.retrieval.index import MAX_EXACT, IndexKind, in_8_bits
from visloc.retrieval.inverted import Rows, bytes_of, make_centers, make_lists, num_lists

# Keypoints are stored as 16-bit multiples of a power of two, with an image at most so many steps
# wide, which leaves room beyond its edges. Where that is too coarse or too narrow: as float32.
_MAX_STEPS = 30_000
_MAX_KEYPOINT_STEP_PX = 0.25


def write_map(folder: Path, content: MapContent, *, map_id: str, version: str, created: str) -> str:
    """Write a map into an empty folder. All files are on disk when this returns.

    Args:
        folder: exists and is empty.
        content: the map.
        map_id: the map's id.
        version: its version, or a prefix ending in ``-``, to which a part of the content hash
            is appended.
        created: ISO 8601 in UTC; a parameter because nothing below ``mapping`` reads a clock.

    Returns:
        The version.
    """
    files, landmarks = Files(folder), content.landmarks
    _write_images(files, content)
    if content.fixes is not None:
        files.write_json(GNSS_FILE, content.fixes.thinned().model_dump())
    _write_landmarks(files, landmarks)
    keypoint_step = _write_keypoints(files, landmarks.keypoints, content.cameras)
    scale = _write_descriptors(
        files,
        content.descriptors,
        (len(landmarks.observed), content.descriptor_dim),
        content.descriptor_scale,
    )
    for features in content.global_features:
        _write_global(files, features)
    indexed = {
        features.fingerprint.file_stem: write_index(
            files, features.fingerprint.file_stem, features.descriptors
        )
        for features in content.global_features
        if content.index is IndexKind.IVF
        or (content.index is IndexKind.AUTO and len(content.images) > MAX_EXACT)
    }
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "format_version": f"{FORMAT_MAJOR}.{FORMAT_MINOR}",
        "id": map_id,
        "created": created,
        "world": _world(content),
        "method": {"name": content.method, "settings": dict(content.settings)},
        "local_features": {
            "fingerprint": content.local_fingerprint.model_dump(),
            "max_keypoints": content.max_keypoints,
            "descriptor_dim": content.descriptor_dim,
            "descriptor_scale": scale,
            "keypoint_step_px": keypoint_step,
            "computed_with": content.computed_with,
        },
        "global_features": [
            {
                "fingerprint": features.fingerprint.model_dump(),
                "dim": features.descriptors.shape[1],
                "bits": 8,
                "lists": indexed.get(features.fingerprint.file_stem),
            }
            for features in content.global_features
        ],
        "retrieval": RetrievalRecord.of(content.fusion).model_dump(mode="json"),
        "counts": {
            "images": len(content.images),
            "landmarks": len(landmarks.points),
            "observations": len(landmarks.observed),
        },
        "parts": Parts(own_test=content.own_test).model_dump(mode="json", exclude_none=True),
        "notes": list(content.notes),
        "files": files.entries(),
    }
    return files.finish(manifest, version)


def _within_float16(values: NDArray[Any]) -> NDArray[Any]:
    """Clip to the range of float16; NaN stays."""
    limit = float(np.finfo(np.float16).max)
    return np.asarray(np.clip(values, -limit, limit))


def _world(content: MapContent) -> dict[str, Any]:
    landmarks = content.landmarks
    points = landmarks.points if len(landmarks.points) else _centers(content)
    low, high = points.min(axis=0), points.max(axis=0)
    world: dict[str, Any] = {
        "metric": content.metric,
        "origin": landmarks.origin.tolist(),
        "extent": {
            "min": (landmarks.origin + low).tolist(),
            "max": (landmarks.origin + high).tolist(),
        },
    }
    if content.anchor is not None:
        world["anchor"] = content.anchor.model_dump()
    if content.gravity is not None:
        world["gravity"] = list(content.gravity)
    return world


def _centers(content: MapContent) -> NDArray[np.float64]:
    """Return the camera centres (n, 3) of the photos, relative to the origin."""
    rows = content.image_poses
    centers = [Pose.from_quaternion(row[:4], row[4:]).center for row in rows]
    return np.asarray(centers - content.landmarks.origin)


def _write_images(files: Files, content: MapContent) -> None:
    cameras = {
        key: {"model": c.model, "width": c.width, "height": c.height, "params": c.params}
        for key, c in content.cameras.items()
    }
    rigs = {
        rig: {key: list(row) for key, row in members.items()}
        for rig, members in content.rigs.items()
    }
    files.write_json("cameras.json", {"cameras": cameras, "rigs": rigs})
    files.write_json("images.json", {"images": [asdict(image) for image in content.images]})
    files.write_array("image_poses.npy", "<f8", content.image_poses)


def _write_landmarks(files: Files, landmarks: Landmarks) -> None:
    files.write_array("landmarks.npy", "<f4", landmarks.points)
    files.write_array("landmark_track_length.npy", "<u2", landmarks.track_lengths)
    files.write_array("landmark_error_px.npy", "<f2", landmarks.errors_px, _within_float16)
    if any(not np.isnan(block).all() for block in blocks_of(landmarks.angles_deg)):
        files.write_array("landmark_angle_deg.npy", "<f2", landmarks.angles_deg, _within_float16)
    if landmarks.colors is not None:
        files.write_array("landmark_rgb.npy", "|u1", landmarks.colors)
    files.write_array("observation_offsets.npy", "<i8", landmarks.offsets)
    files.write_array("observation_landmarks.npy", "<u4", landmarks.observed)


def _write_keypoints(
    files: Files, keypoints: NDArray[np.float32], cameras: Mapping[str, Camera]
) -> float | None:
    """Store keypoints in 16 bits if they fit and return the step; None for float32."""
    name = "observation_keypoints.npy"
    side = max(max(camera.width, camera.height) for camera in cameras.values())
    step = 2.0 ** math.ceil(math.log2(side / _MAX_STEPS))
    most = step * np.iinfo(np.int16).max
    # NaN fails every comparison.
    fits = all(bool((np.abs(block) <= most).all()) for block in blocks_of(keypoints))
    if step > _MAX_KEYPOINT_STEP_PX or not fits:
        files.write_array(name, "<f4", keypoints)
        return None
    files.write_array(name, "<i2", keypoints, lambda block: np.rint(block / np.float32(step)))
    return step


def _write_descriptors(
    files: Files,
    descriptors: Callable[[], Iterator[NDArray[np.float32]]],
    shape: tuple[int, int],
    scale: float | None,
) -> float:
    """Store unit descriptors in 8 bits and return the step.

    The step is one for the whole map, so that products of stored integers are comparable. Values
    out of range are clipped.
    """
    if scale is None:
        blocks = descriptors()
        largest = max((float(np.abs(block).max(initial=0.0)) for block in blocks), default=0.0)
        scale = (largest or 1.0) / 127.0
    step = np.float32(scale)
    num_rows = 0

    def stored() -> Iterator[NDArray[np.int8]]:
        nonlocal num_rows
        for block in descriptors():
            num_rows += len(block)
            yield np.clip(np.rint(block / step), -127, 127).astype(np.int8)

    files.write_blocks("observation_descriptors.npy", "|i1", shape, stored())
    if num_rows != shape[0]:
        raise AssertionError(f"{num_rows} descriptors for {shape[0]} observations")
    return scale


def write_index(files: Files, stem: str, rows: Rows) -> int:
    """Write an inverted file of a global descriptor; return its number of lists."""
    centers = make_centers(rows, num_lists(len(rows)))
    lists = make_lists(rows, centers)
    names = index_files(INDEX_FOLDER + stem)
    files.write_array(names.centers, "<f4", centers)
    files.write_array(names.sizes, "<i8", lists.sizes)
    files.write_bytes(names.lists, bytes_of([lists]))
    return len(centers)


def _write_global(files: Files, features: GlobalFeatures) -> None:
    """Store a global descriptor's rows and model in 8 bits."""
    stem, rows = features.fingerprint.file_stem, features.descriptors
    scales = np.empty(len(rows), np.float32)

    def stored() -> Iterator[NDArray[np.int8]]:
        for number, block in enumerate(blocks_of(rows)):
            values, some = in_8_bits(np.asarray(block))
            scales[number * BLOCK_ROWS :][: len(block)] = some
            yield values

    files.write_blocks(f"global/{stem}.npy", "|i1", rows.shape, stored())
    files.write_array(f"global/{stem}.scales.npy", "<f4", scales)
    files.write_model(f"global/{stem}.model.npz", features.model)
