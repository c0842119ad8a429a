"""Writing a map folder: arrays first, the manifest last."""

from __future__ import annotations

import hashlib
import io
import itertools
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from visloc.archive.checks import SCALES, content_hash, json_text, manifest_hash, sha256_of
from visloc.archive.gnss import GNSS_FILE, Fixes
from visloc.archive.index_files import index_files
from visloc.archive.schema import (
    FORMAT,
    FORMAT_MAJOR,
    FORMAT_MINOR,
    INDEX_FOLDER,
    Anchor,
    FingerprintRecord,
    ImageRecord,
    OwnTest,
    Parts,
    RetrievalRecord,
    Vector,
)
from visloc.geometry import Camera, Pose
from visloc.retrieval.fusion import EQUAL_GHARM, LateFusion
from visloc.retrieval.index import MAX_EXACT, IndexKind
from visloc.retrieval.inverted import Rows, bytes_of, make_centers, make_lists, num_lists
from visloc.retrieval.rows import in_8_bits

# Rows of an array that are converted and written at once.
_BLOCK_ROWS = 8192
# Keypoints are stored as 16-bit multiples of a power of two, with an image at most so many steps
# wide, which leaves room beyond its edges. Where that is too coarse or too narrow: as float32.
_MAX_STEPS = 30_000
_MAX_KEYPOINT_STEP_PX = 0.25
# Larger matrices of a model are stored in 8 bits.
_MAX_FLOAT_MODEL = 2**16

# qw qx qy qz tx ty tz
PoseRow = tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Landmarks and their observations.

    Attributes:
        origin: (3,) float64, origin of ``points`` in the world.
        points: (P, 3) float32.
        track_lengths: (P,) uint16.
        errors_px: (P,) float32, NaN where it does not apply.
        angles_deg: (P,) float32, NaN where it does not apply.
        offsets: (n + 1,) int64, rows of ``observed`` and ``keypoints`` by photo.
        observed: (M,) uint32 rows of ``points``.
        keypoints: (M, 2) float32 pixels.
        colors: (P, 3) uint8 RGB; None when unknown.
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
    """One global descriptor of all mapping photos.

    Attributes:
        descriptors: (n, D) unit rows; zero rows for blank photos.
        model: its float32 arrays, or as a map stores them, with large ones in int8 and their
            scales. Empty if the descriptor is ready-made.
    """

    fingerprint: FingerprintRecord
    descriptors: NDArray[np.float32]
    model: Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class MapContent:
    """Everything in a map except its id, version and creation time.

    Arrays may be mapped from files: none is copied whole.

    Attributes:
        rigs: cam_from_rig (7,) by rig and camera.
        image_poses: cam_from_world (n, 7).
        descriptors: yields the unit descriptors (m_i, D) float32 of each photo's observations, in
            the order of ``landmarks``. It is called twice.
        gravity: unit vector that points down in the world; None when unknown.
        computed_with: what computed the local features, for people.
        fusion: how queries rank the photos by default.
        descriptor_scale: the step in which descriptors are stored. The step of the map that they
            were read from stores them unchanged; None chooses one that fits the largest value.
        own_test: of a map that this is or is a part of; None when it took none.
        index: whether an inverted file of the global descriptors is written.
        fixes: of GNSS receivers during the captures.
    """

    metric: bool
    method: str
    settings: Mapping[str, JsonValue]
    notes: tuple[str, ...]
    cameras: Mapping[str, Camera]
    rigs: Mapping[str, Mapping[str, PoseRow]]
    images: tuple[ImageRecord, ...]
    image_poses: NDArray[np.float64]
    landmarks: Landmarks
    local_fingerprint: FingerprintRecord
    max_keypoints: int
    descriptor_dim: int
    descriptors: Callable[[], Iterator[NDArray[np.float32]]]
    global_features: tuple[GlobalFeatures, ...]
    anchor: Anchor | None = None
    gravity: Vector | None = None
    computed_with: str | None = None
    fusion: LateFusion = EQUAL_GHARM
    descriptor_scale: float | None = None
    own_test: OwnTest | None = None
    index: IndexKind = IndexKind.AUTO
    fixes: Fixes | None = None


def pose_row(pose: Pose) -> PoseRow:
    """Return a pose as it is stored: qw qx qy qz tx ty tz.

    A row that was read as a pose can come back with another last digit: pass on rows that stay.
    """
    return (*pose.rotation_wxyz.tolist(), *pose.translation.tolist())


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
        files.write_json(GNSS_FILE, content.fixes.model_dump())
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


class Files:
    """Writes the files of a map and collects their checksums."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._written: dict[str, str] = {}

    def write_json(self, name: str, value: object) -> None:
        self.write_bytes(name, [json_text(value).encode()])

    def write_array(
        self,
        name: str,
        dtype: str,
        array: NDArray[Any],
        converted: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray,
    ) -> None:
        """Write an array converted to ``dtype``, block by block."""
        self.write_blocks(name, dtype, array.shape, map(converted, _blocks(array)))

    def write_blocks(
        self, name: str, dtype: str, shape: tuple[int, ...], blocks: Iterable[NDArray[Any]]
    ) -> None:
        """Write an ``.npy`` block by block.

        On a full disk ``np.save`` hides the reason, and a memory map ends the process.
        """
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header, {"descr": dtype, "fortran_order": False, "shape": shape}
        )
        rows = (np.ascontiguousarray(block, dtype).data for block in blocks if block.size)
        self.write_bytes(name, itertools.chain([header.getvalue()], rows))

    def write_model(self, name: str, model: Mapping[str, NDArray[Any]]) -> None:
        """Write the arrays of a model, with large matrices in 8 bits."""
        path = self._path(name)
        with path.open("xb") as file:
            # The savez stub takes no mapping of arrays as keywords beside allow_pickle.
            np.savez(file, **_stored_model(model))  # type: ignore[arg-type]
        self._written[name] = sha256_of(path)

    def entries(self) -> dict[str, dict[str, int | str]]:
        """Size and checksum of all files in the folder, also of those that others wrote."""
        entries: dict[str, dict[str, int | str]] = {}
        for path in sorted(self.folder.rglob("*")):
            if path.is_file():
                name = path.relative_to(self.folder).as_posix()
                sha256 = self._written.get(name) or sha256_of(path)
                entries[name] = {"size": path.stat().st_size, "sha256": sha256}
        return entries

    def written(self) -> dict[str, dict[str, int | str]]:
        """Size and checksum of the files that this wrote."""
        return {
            name: {"size": (self.folder / name).stat().st_size, "sha256": sha256}
            for name, sha256 in self._written.items()
        }

    def finish(self, manifest: dict[str, Any], version: str) -> str:
        """Add version and hashes to a manifest, write it, and sync all files to disk.

        Args:
            manifest: everything else; its ``files`` are ``entries()``.
            version: as for ``write_map``.

        Returns:
            The version.
        """
        digest = content_hash(manifest)
        manifest["content_hash"] = digest
        manifest["version"] = version + digest[:8] if version.endswith("-") else version
        manifest["manifest_hash"] = manifest_hash(manifest)
        self.write_json("manifest.json", manifest)
        for path in self.folder.rglob("*"):
            if path.is_file():
                with path.open("rb") as file:
                    os.fsync(file.fileno())
        return str(manifest["version"])

    def write_bytes(self, name: str, parts: Iterable[bytes | memoryview]) -> None:
        digest = hashlib.sha256()
        with self._path(name).open("wb") as file:
            for part in parts:
                file.write(part)
                digest.update(part)
        self._written[name] = digest.hexdigest()

    def _path(self, name: str) -> Path:
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        return path


def _blocks(array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    for start in range(0, len(array), _BLOCK_ROWS):
        yield array[start : start + _BLOCK_ROWS]


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
    if any(not np.isnan(block).all() for block in _blocks(landmarks.angles_deg)):
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
    fits = all(bool((np.abs(block) <= most).all()) for block in _blocks(keypoints))
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
        for number, block in enumerate(_blocks(rows)):
            values, some = in_8_bits(np.asarray(block))
            scales[number * _BLOCK_ROWS :][: len(block)] = some
            yield values

    files.write_blocks(f"global/{stem}.npy", "|i1", rows.shape, stored())
    files.write_array(f"global/{stem}.scales.npy", "<f4", scales)
    files.write_model(f"global/{stem}.model.npz", features.model)


def _stored_model(model: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """A model with its large matrices in 8 bits and a scale for each of their columns."""
    stored: dict[str, NDArray[Any]] = {}
    for name, array in model.items():
        if array.ndim != 2 or array.size <= _MAX_FLOAT_MODEL or array.dtype == np.int8:
            stored[name] = array
            continue
        largest = np.abs(array).max(axis=0)
        scales = np.where(largest > 0, largest, 1).astype(np.float32) / np.float32(127)
        stored[name] = np.rint(array / scales).astype(np.int8)
        stored[name + SCALES] = scales
    return stored
