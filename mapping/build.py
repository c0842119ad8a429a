"""``mapping build``: from a kapture dataset to a published map, stage by stage."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.features import LocalFeaturesStage, Progress, describe_photos
from mapping.photos import MappingPhoto, collect_photos
from mapping.rgbd import LiftedKeypoints, lift_keypoints, merge_landmarks
from mapping.stages import Item, WorkFolder, exclusive, key_of
from visloc.archive import (
    FingerprintRecord,
    ImageRecord,
    Landmarks,
    MapContent,
    MapStore,
    write_map,
)
from visloc.errors import Conflict, DatasetError, InvalidInput, Unavailable
from visloc.features import (
    DEFAULT_GLOBAL_FEATURES,
    DEFAULT_LOCAL_FEATURES,
    GlobalDescriptor,
    LocalFeatureExtractor,
    make_global_descriptor,
    make_local_features,
)
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, read_dataset

METHODS = ("rgbd",)
# Raised when the code of the stage changes what comes out.
_LIFTED_REVISION = 2


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """What a build is made of.

    Attributes:
        dataset: kapture folder.
        map_id: id of the map.
        maps_dir: folder of maps.
        method: a name of ``METHODS``.
        local_features: a name of ``visloc.features.LOCAL_FEATURES``.
        global_features: names of ``visloc.features.GLOBAL_FEATURES``.
        weights_dir: folder with network weights.
        max_keypoints: strongest keypoints kept per photo, in the map and in queries.
        voxel_size: edge in which lifted keypoints become one landmark, in metres.
        depth_sensor: the depth sensor to use, when several go with a photo.
        depth_scale: metres per unit of 16-bit PNG depth.
        force: publish a new version of a map that exists.
    """

    dataset: Path
    map_id: str
    maps_dir: Path
    method: str = "rgbd"
    local_features: str = DEFAULT_LOCAL_FEATURES
    global_features: tuple[str, ...] = DEFAULT_GLOBAL_FEATURES
    weights_dir: Path | None = None
    max_keypoints: int = 5000
    voxel_size: float = 0.01
    depth_sensor: str | None = None
    depth_scale: float = 0.001
    force: bool = False


def build_map(settings: BuildSettings, progress: Progress) -> Path:
    """Build a map and publish it as the current version.

    Killed at any moment, the same call finds its finished work again; the map that was current
    before stays so until the new one is complete and verified.

    Returns:
        The folder of the new version.

    Raises:
        Conflict: ``map.exists`` without ``force``; ``build.running``.
        DatasetError, WeightsError, InvalidInput: with the file or the setting that is wrong.
        Unavailable: ``storage.failed`` when the disk is full or broken.
    """
    _check(settings)
    store = MapStore(settings.maps_dir)
    versions = store.versions(settings.map_id)
    # Versions of which none is current are what a build left that was killed while it published.
    if versions and settings.map_id in store.ids() and not settings.force:
        raise Conflict(
            "map.exists",
            f"map {settings.map_id!r} exists (version {versions[-1]}); "
            "--force publishes a new version and keeps the old one",
            field="--map",
        )
    extractor = make_local_features(settings.local_features, settings.weights_dir)
    descriptors = [make_global_descriptor(name) for name in settings.global_features]
    dataset = read_dataset(settings.dataset)
    work_root = settings.maps_dir / ".work" / settings.map_id
    try:
        with exclusive(work_root.with_name(f"{work_root.name}.lock")):
            folder = _build(settings, dataset, extractor, descriptors, store, work_root, progress)
            shutil.rmtree(work_root, ignore_errors=True)
    except OSError as error:
        raise Unavailable(
            "storage.failed",
            f"reading or writing failed: {error.strerror or error}; "
            "finished work is kept, the same command resumes",
            field=str(error.filename or work_root),
        ) from error
    return folder


def _check(settings: BuildSettings) -> None:
    """Refuse what would otherwise fail after hours, or give a useless map."""
    if settings.method not in METHODS:
        raise InvalidInput(
            "build.method",
            "unknown method",
            field="--method",
            expected=f"one of {', '.join(METHODS)}",
            got=settings.method,
        )
    names = settings.global_features
    if not names or len(set(names)) < len(names):
        raise InvalidInput(
            "build.global_features",
            "not a set of global features",
            field="--global-features",
            expected="one or more names, each once",
            got=",".join(names),
        )
    for name in ("voxel_size", "depth_scale"):
        value = getattr(settings, name)
        if not (math.isfinite(value) and value > 0):
            raise InvalidInput(
                f"build.{name}",
                "not usable",
                field=f"--{name.replace('_', '-')}",
                expected="metres, more than 0",
                got=value,
            )


def _build(
    settings: BuildSettings,
    dataset: Dataset,
    extractor: LocalFeatureExtractor,
    descriptors: Sequence[GlobalDescriptor],
    store: MapStore,
    work_root: Path,
    progress: Progress,
) -> Path:
    work = WorkFolder(work_root)
    photos, notes = collect_photos(
        dataset,
        with_depth=True,
        depth_sensor=settings.depth_sensor,
        progress=lambda done, total: progress("photos", done, total),
    )
    if all(photo.depth is None for photo in photos):
        raise DatasetError(
            "dataset.no_depth",
            "no photo has a depth map",
            field=str(dataset.root / "sensors" / "records_depth.txt"),
            expected="depth maps with the timestamps of the photos, of a sensor in their rig or "
            "with poses of its own; see --depth-sensor",
        )
    features = LocalFeaturesStage(work, extractor, settings.max_keypoints)
    for done, photo in enumerate(photos, 1):
        features.compute(photo)
        progress("local features", done, len(photos))
    global_features = tuple(
        describe_photos(work, photos, features, descriptor, progress) for descriptor in descriptors
    )
    landmarks, rows = _landmarks_from_depth(work, dataset, photos, features, settings, progress)

    def observed_descriptors() -> Iterator[NDArray[np.float32]]:
        for photo, kept in zip(photos, rows, strict=True):
            yield features.read(photo).descriptors[kept]

    progress("archive", 0, 1)
    now = datetime.now(UTC)
    content = MapContent(
        metric=True,
        method=settings.method,
        settings={"voxel_size": settings.voxel_size, "depth_scale": settings.depth_scale},
        notes=(*dataset.notes, *notes),
        cameras={photo.record.sensor_id: photo.camera for photo in photos},
        rigs=_known_rigs(dataset, {photo.record.sensor_id for photo in photos}),
        images=tuple(
            ImageRecord(
                name=photo.name, camera=photo.record.sensor_id, timestamp=photo.record.timestamp
            )
            for photo in photos
        ),
        image_poses=tuple(photo.cam_from_world for photo in photos),
        landmarks=landmarks,
        local_fingerprint=FingerprintRecord.of(extractor.fingerprint),
        max_keypoints=settings.max_keypoints,
        descriptor_dim=extractor.descriptor_dim,
        descriptors=observed_descriptors,
        global_features=global_features,
    )
    incoming = work_root / "incoming"
    shutil.rmtree(incoming, ignore_errors=True)  # of a build that was killed here
    incoming.mkdir()
    try:
        version = write_map(
            incoming,
            content,
            map_id=settings.map_id,
            version=now.strftime("%Y%m%dT%H%M%S.%f")[:-3] + "Z-",
            created=now.isoformat(timespec="seconds"),
        )
        folder = store.publish(incoming, settings.map_id, version)
    finally:
        shutil.rmtree(incoming, ignore_errors=True)
    progress("archive", 1, 1)
    return folder


def _landmarks_from_depth(
    work: WorkFolder,
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    features: LocalFeaturesStage,
    settings: BuildSettings,
    progress: Progress,
) -> tuple[Landmarks, list[NDArray[np.int64]]]:
    """Landmarks, and of each photo the rows of its features that became observations."""

    def lift(photo: MappingPhoto) -> Item:
        keypoints = features.read(photo).keypoints
        return asdict(lift_keypoints(dataset, photo, keypoints, settings.depth_scale))

    lifted = []
    for done, photo in enumerate(photos, 1):
        item = work.get(
            key_of(
                "lifted",
                _LIFTED_REVISION,
                local=features.key(photo),
                camera=_camera(photo.camera),
                pose=_numbers(photo.cam_from_world),
                depth=photo.depth
                and [
                    photo.depth_sha256,
                    *_camera(photo.depth.camera),
                    *_numbers(photo.depth.cam_from_depth),
                ],
                depth_scale=settings.depth_scale,
            ),
            partial(lift, photo),
        )
        lifted.append(LiftedKeypoints(**item))
        progress("depth", done, len(photos))
    progress("landmarks", 0, 1)
    merged = merge_landmarks(photos, lifted, settings.voxel_size)
    progress("landmarks", 1, 1)
    return merged


def _known_rigs(dataset: Dataset, cameras: set[str]) -> dict[str, dict[str, Pose]]:
    """cam_from_rig of the map's cameras, where the dataset knows it."""
    rigs = {
        rig: {sensor: pose for sensor, pose in members.items() if sensor in cameras and pose}
        for rig, members in dataset.rigs.items()
    }
    return {rig: members for rig, members in rigs.items() if members}


def _camera(camera: Camera) -> list[str | float]:
    return [camera.model, camera.width, camera.height, *camera.params]


def _numbers(pose: Pose) -> list[float]:
    return [*pose.rotation.ravel().tolist(), *pose.translation.tolist()]
