"""A map in memory: small files are read, large arrays are mapped from disk."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from visloc.archive import models
from visloc.archive.checks import (
    check_checksums,
    check_files,
    is_finite,
    map_array,
    read_manifest,
    read_model,
    read_record,
)
from visloc.archive.gnss import read_fixes
from visloc.archive.index_files import IndexFiles, check_lists, index_files, open_index
from visloc.archive.places import GeoCircle, circle_of, down_of
from visloc.archive.schema import (
    INDEX_FOLDER,
    MAX_PHOTO_BYTES,
    CamerasFile,
    Geodetic,
    GlobalFeaturesRecord,
    ImageRecord,
    ImagesFile,
    Manifest,
    photo_file,
)
from visloc.archive.set_schema import SetManifest
from visloc.errors import InvalidInput, refuse
from visloc.geometry import Camera, Pose
from visloc.retrieval.fusion import LateFusion
from visloc.retrieval.index import GlobalRows

Model = Mapping[str, NDArray[np.float32]]
logger = logging.getLogger(__name__)
ManifestType = TypeVar("ManifestType", Manifest, SetManifest)


class Outline(Generic[ManifestType]):
    """What the manifest of a map or a set says."""

    __slots__ = ()
    manifest: ManifestType

    @property
    def ref(self) -> str:
        """``id@version``."""
        return f"{self.manifest.id}@{self.manifest.version}"

    @property
    def geodetic(self) -> Geodetic | None:
        """Where the frame lies on Earth; None when unknown."""
        anchor = self.manifest.world.anchor
        return None if anchor is None else anchor.geodetic

    @property
    def place(self) -> GeoCircle | None:
        """A circle on Earth that holds the map or all tiles; None when unknown."""
        return circle_of(self.manifest.world)

    @property
    def size_bytes(self) -> int:
        """Size of the version's own files except the manifest."""
        return sum(entry.size for entry in self.manifest.files.values())


@dataclass(frozen=True, slots=True, eq=False)
class MapOutline(Outline[Manifest]):
    """The small files of a map's version.

    Attributes:
        manifest: ``manifest.json``.
        cameras: intrinsics by camera id.
        rigs: cam_from_rig by rig id and camera id.
    """

    manifest: Manifest
    cameras: Mapping[str, Camera]
    rigs: Mapping[str, Mapping[str, Pose]]

    @property
    def gravity(self) -> NDArray[np.float64] | None:
        """(3,) unit vector that points down in the world; None when unknown."""
        world = self.manifest.world
        if world.gravity is not None:
            return np.array(world.gravity)
        return None if self.geodetic is None else down_of(self.geodetic)

    @property
    def fusion(self) -> LateFusion:
        """How queries rank its photos by default."""
        return self.manifest.retrieval.late_fusion


@dataclass(frozen=True, slots=True, eq=False)
class Map(MapOutline):
    """One version of a map, open for reading. Files stay mapped while it lives.

    Attributes:
        image_poses: (n, 7) float64, cam_from_world as qw qx qy qz tx ty tz.
        landmarks: (P, 3) float32, relative to the manifest's origin.
        track_lengths: (P,) uint16, mapping photos that see each landmark.
        errors_px: (P,) float16 (float32 before format 2.0), mean reprojection error; NaN where it
            does not apply.
        angles_deg: (P,) of the same type, largest angle between viewing rays; NaN where it was not
            computed.
        colors: (P, 3) uint8 RGB; None when the map has none.
        observation_offsets: (n + 1,) int64; rows offsets[i]:offsets[i + 1] belong to photo i.
        observation_landmarks: (M,) uint32 rows of ``landmarks``; its own row in a map that has no
            landmarks.
        observation_descriptors: (M, D) int8, in steps of the manifest's ``descriptor_scale``.
        observation_keypoints: (M, 2) int16 or float32; ``keypoints`` reads them as pixels.
        global_descriptors: unit rows (n, D) by name.
        global_models: arrays of the models by descriptor.
    """

    path: Path
    images: tuple[ImageRecord, ...]
    image_poses: NDArray[np.float64]
    landmarks: NDArray[np.float32]
    track_lengths: NDArray[np.uint16]
    errors_px: NDArray[np.float32]
    angles_deg: NDArray[np.float32]
    colors: NDArray[np.uint8] | None
    observation_offsets: NDArray[np.int64]
    observation_landmarks: NDArray[np.uint32]
    observation_descriptors: NDArray[np.int8]
    observation_keypoints: NDArray[np.int16] | NDArray[np.float32]
    global_descriptors: Mapping[str, GlobalRows]
    global_models: Mapping[str, Model]

    def observations(self, image: int) -> tuple[NDArray[np.uint32], NDArray[np.int8]]:
        """Landmarks (m,) that one photo observes and their descriptors (m, D), not copied.

        Descriptors times the manifest's ``descriptor_scale`` are unit rows, except for rounding.
        """
        start, stop = self.observation_offsets[image], self.observation_offsets[image + 1]
        return self.observation_landmarks[start:stop], self.observation_descriptors[start:stop]

    @property
    def has_landmarks(self) -> bool:
        """Whether it stores landmarks; queries triangulate those of another one."""
        return self.manifest.counts.landmarks > 0

    @property
    def has_index(self) -> bool:
        """Whether all global descriptors have an inverted file."""
        return all(rows.inverted is not None for rows in self.global_descriptors.values())

    def keypoints(self, image: int) -> NDArray[np.float32]:
        """Keypoints (m, 2) of one photo in pixels, in the order of ``observations``."""
        start, stop = self.observation_offsets[image], self.observation_offsets[image + 1]
        keypoints = self.observation_keypoints[start:stop].astype(np.float32)
        step = self.manifest.local_features.keypoint_step_px
        return keypoints if step is None else keypoints * np.float32(step)

    def photo(self, image: int) -> bytes | None:
        """A small JPEG of one photo; None when the map keeps no photos."""
        name = photo_file(image)
        return (self.path / name).read_bytes() if name in self.manifest.files else None


def outline_of(folder: Path, manifest: Manifest) -> MapOutline:
    """Read the cameras of a map whose manifest was read; raises ``map.cameras``."""
    cameras = read_record(folder, "cameras.json", CamerasFile)
    try:
        return MapOutline(
            manifest,
            {
                key: Camera(c.model, c.width, c.height, c.params)
                for key, c in cameras.cameras.items()
            },
            {
                rig: {key: Pose.from_quaternion(p[:4], p[4:]) for key, p in members.items()}
                for rig, members in cameras.rigs.items()
            },
        )
    except InvalidInput as error:
        raise refuse("map.cameras", str(error), field=str(folder / "cameras.json")) from error


def open_map(folder: Path) -> Map:
    """Open a map after checking its manifest and the presence and size of its files.

    Contents are not checked, so that a map of many gigabytes opens in milliseconds: they are
    checked when a map is published and by ``verify_map``.

    Raises:
        MapCorrupt: with the file that is wrong.
    """
    manifest = read_manifest(folder)
    check_files(folder, manifest)
    _check_listed(folder, manifest)
    _check_photos(folder, manifest)
    _warn_of_old_index(manifest)
    outline = outline_of(folder, manifest)
    images = read_images(folder, outline)
    counts, local = manifest.counts, manifest.local_features
    n, num_landmarks, m = counts.images, counts.landmarks, counts.observations

    def array(stem: str, dtype: str, *shape: int, before: str | None = None) -> NDArray[Any]:
        return map_array(folder, f"{stem}.npy", dtype, shape, before=before)

    return Map(
        path=folder,
        manifest=manifest,
        cameras=outline.cameras,
        rigs=outline.rigs,
        images=images,
        image_poses=map_array(folder, "image_poses.npy", "<f8", (n, 7), load=True),
        landmarks=array("landmarks", "<f4", num_landmarks, 3),
        track_lengths=array("landmark_track_length", "<u2", num_landmarks),
        errors_px=array("landmark_error_px", "<f2", num_landmarks, before="<f4"),
        angles_deg=array("landmark_angle_deg", "<f2", num_landmarks, before="<f4")
        if "landmark_angle_deg.npy" in manifest.files
        else np.broadcast_to(np.float16(np.nan), num_landmarks),
        colors=array("landmark_rgb", "|u1", num_landmarks, 3)
        if "landmark_rgb.npy" in manifest.files
        else None,
        observation_offsets=map_array(
            folder, "observation_offsets.npy", "<i8", (n + 1,), load=True
        ),
        observation_landmarks=array("observation_landmarks", "<u4", m),
        observation_descriptors=array("observation_descriptors", "|i1", m, local.descriptor_dim),
        observation_keypoints=array(
            "observation_keypoints", "<f4" if local.keypoint_step_px is None else "<i2", m, 2
        ),
        global_descriptors={
            record.fingerprint.name: _map_rows(folder, record, n)
            for record in manifest.global_features
        },
        global_models={
            record.fingerprint.name: read_model(folder, _model_file(record))
            for record in manifest.global_features
        },
    )


def read_images(folder: Path, outline: MapOutline) -> tuple[ImageRecord, ...]:
    """Read names and cameras of the mapping photos of a map."""
    images = read_record(folder, "images.json", ImagesFile).images
    num = outline.manifest.counts.images
    if len(images) != num or any(image.camera not in outline.cameras for image in images):
        raise refuse("map.images", field=str(folder / "images.json"))
    return images


def verify_map(folder: Path) -> Map:
    """Open a map and read every byte of it: checksums, then ranges.

    Raises:
        MapCorrupt: with the file and what is wrong.
    """
    opened = open_map(folder)
    check_checksums(folder, opened.manifest)
    counts = opened.manifest.counts
    fine = {
        "image_poses.npy": is_finite(opened.image_poses) and _are_unit(opened.image_poses[:, :4]),
        "landmarks.npy": is_finite(opened.landmarks),
        "observation_offsets.npy": _lead_through(opened.observation_offsets, counts.observations),
        "observation_landmarks.npy": _name_landmarks(opened),
        "observation_keypoints.npy": is_finite(opened.observation_keypoints),
    }
    for record in opened.manifest.global_features:
        stem, rows = (
            record.fingerprint.file_stem,
            opened.global_descriptors[record.fingerprint.name],
        )
        fine[f"global/{stem}.npy"] = is_finite(rows.values)
        model = opened.global_models[record.fingerprint.name]
        fine[_model_file(record)] = models.fits(model, record.dim)
        if rows.scales is not None:
            fine[f"global/{stem}.scales.npy"] = is_finite(rows.scales) and rows.scales.min() >= 0
        if rows.inverted is not None:
            check_lists(rows.inverted)
    for name, good in fine.items():
        if not good:
            raise refuse("map.range", field=str(folder / name))
    read_fixes(folder, opened.manifest.files)  # nothing else reads them before they are needed
    return opened


def _name_landmarks(opened: Map) -> bool:
    """Whether each observation is of a landmark that is there, or of its own where none is."""
    named, num = opened.observation_landmarks, opened.manifest.counts.landmarks
    return int(named.max()) < num if num else bool((named == np.arange(len(named))).all())


def _map_rows(folder: Path, record: GlobalFeaturesRecord, num_images: int) -> GlobalRows:
    dtype = "|i1" if record.bits == 8 else "<f4"
    values = map_array(folder, _rows_file(record), dtype, (num_images, record.dim))
    scales = None
    if record.bits == 8:
        scales = map_array(folder, _scales_file(record), "<f4", (num_images,))
    inverted = None
    if record.lists is not None:
        inverted = open_index(
            folder,
            _index_files(record),
            dim=record.dim,
            num_lists=record.lists,
            num_rows=num_images,
        )
    return GlobalRows(values, scales, inverted)


def _index_files(record: GlobalFeaturesRecord) -> IndexFiles:
    return index_files(INDEX_FOLDER + record.fingerprint.file_stem)


def _scales_file(record: GlobalFeaturesRecord) -> str:
    return f"global/{record.fingerprint.file_stem}.scales.npy"


def _lead_through(offsets: NDArray[np.int64], num_rows: int) -> bool:
    """Whether offsets start at 0, never decrease, and end at the number of rows."""
    # Compared, not subtracted: differences of large numbers overflow.
    ascend = bool((offsets[1:] >= offsets[:-1]).all())
    return ascend and int(offsets[0]) == 0 and int(offsets[-1]) == num_rows


def _warn_of_old_index(manifest: Manifest) -> None:
    if any(record.clusters is not None for record in manifest.global_features):
        logger.warning(
            "%s@%s has an index of an older format, which is not used: every query is compared "
            "with all of its %d photos. `mapping upgrade %s` adds an index.",
            manifest.id,
            manifest.version,
            manifest.counts.images,
            manifest.id,
        )


def _check_listed(folder: Path, manifest: Manifest) -> None:
    """Refuse a manifest that does not list the files that every such map has."""
    records = manifest.global_features
    if len(set(map(_rows_file, records))) != len(records):
        raise refuse(
            "map.manifest",
            "two global descriptors have the same name",
            field=str(folder / "manifest.json"),
            got=", ".join(record.fingerprint.name for record in records),
        )
    files = [*_ARRAYS, *map(_rows_file, records), *map(_model_file, records)]
    files += [_scales_file(record) for record in records if record.bits == 8]
    files += [name for r in records if r.lists is not None for name in _index_files(r)]
    for name in files:
        if name not in manifest.files:
            raise refuse(
                "map.file_missing",
                "the manifest does not list a file that every such map has",
                field=name,
            )


def _rows_file(record: GlobalFeaturesRecord) -> str:
    return f"global/{record.fingerprint.file_stem}.npy"


def _model_file(record: GlobalFeaturesRecord) -> str:
    return f"global/{record.fingerprint.file_stem}.model.npz"


def _check_photos(folder: Path, manifest: Manifest) -> None:
    """Refuse a map that keeps only some of its photos, or large ones."""
    if not any(name.startswith("photos/") for name in manifest.files):
        return
    files = [manifest.files.get(photo_file(row)) for row in range(manifest.counts.images)]
    kept = [file for file in files if file is not None]
    if kept and (len(kept) < len(files) or max(file.size for file in kept) > MAX_PHOTO_BYTES):
        raise refuse(
            "map.photos",
            field=str(folder / "photos"),
            expected=f"{len(files)} files of at most {MAX_PHOTO_BYTES} bytes, or none",
            got=f"{len(kept)} files, the largest of {max(file.size for file in kept)} bytes",
        )


def _are_unit(rows: NDArray[np.float64]) -> bool:
    with np.errstate(over="ignore"):  # an infinite norm is not 1 either
        return bool((np.abs(np.linalg.norm(rows, axis=1) - 1) < 1e-6).all())


_ARRAYS = (
    "cameras.json",
    "images.json",
    "image_poses.npy",
    "landmarks.npy",
    "landmark_track_length.npy",
    "landmark_error_px.npy",
    "observation_offsets.npy",
    "observation_landmarks.npy",
    "observation_descriptors.npy",
    "observation_keypoints.npy",
)
