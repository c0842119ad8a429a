"""The stage of a build that makes a sparse model of matches; a worker does it as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapping.methods.colmap_scene import Rigs
from mapping.methods.extending import with_late_photos
from mapping.methods.intrinsics import Doubt
from mapping.methods.matching import Matches, camera_values, pose_values
from mapping.methods.sfm_settings import SfmSettings
from mapping.methods.sparse_model import MAPPER_CONFIGS, SfmPhoto, SparseModel
from mapping.methods.triangulation import MAPPING, TRIANGULATION, triangulate
from mapping.methods.undoing import reconstruct_places
from mapping.progress import Progress
from mapping.stages.context import BuildContext
from mapping.stages.landmarks import Observations, View
from mapping.stages.local_features import LocalFeaturesSource
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc.geometry import Camera, Pose

# Raised when the code of the stage changes what comes out.
_REVISION = 13
_LATE_REVISION = 2
_LATE = "late photos"
_LARGEST = 127  # of descriptors in 8 bits


def make_model(
    context: BuildContext,
    photos: Sequence[MappingPhoto],
    rigs: Rigs,
    matches: Sequence[Matches],
    matches_key: str,
    settings: SfmSettings,
) -> SparseModel:
    """Triangulate the matches, or find poses with them, as the settings say.

    ``matches_key`` stands for the matches in the key of the model.

    Raises:
        InvalidInput: ``sfm.*``.
    """
    # A map to pair by is not needed any more, and is not sent to a worker.
    sent = replace(settings, covisible_in=None)
    task = _ModelTask(context.work, tuple(photos), context.features, rigs, matches, sent)
    key = _model_key(matches_key, photos, rigs, settings)
    stage = MAPPING if settings.estimate_poses else TRIANGULATION
    context.workers.run_one(task.make, key, stage, context.progress)
    return _from_item(context.work.read(key), photos)


def with_latecomers(
    context: BuildContext,
    photos: Sequence[MappingPhoto],
    model: SparseModel,
    matches: Sequence[Matches],
    matches_key: str,
    settings: SfmSettings,
) -> SparseModel:
    """Place photos that a model without rigs left out, where they show what it has there.

    Args:
        matches: verified, of pairs with at least these photos.
        matches_key: stands for them in the key of the result.
    """
    task = _LateTask(context.work, tuple(photos), context.features, model, matches, settings)
    poses = [None if view is None else pose_values(view.cam_from_world) for view in model.views]
    key = key_of(
        "late_photos",
        _LATE_REVISION,
        matches=matches_key,
        poses=poses,
        model=_model_key("", photos, {}, settings),
    )
    context.workers.run_one(task.make, key, _LATE, context.progress)
    return _from_item(context.work.read(key), photos)


def without_poses(context: BuildContext, photos: Sequence[MappingPhoto]) -> list[SfmPhoto]:
    """Return the mapper's view of photos whose poses are estimated."""
    return [_given(context.features, photo, posed=False) for photo in photos]


@dataclass(frozen=True, slots=True, eq=False)
class _ModelTask:
    """A worker's part, for the whole map."""

    work: WorkFolder
    photos: tuple[MappingPhoto, ...]
    features: LocalFeaturesSource
    rigs: Rigs
    matches: Sequence[Matches]
    settings: SfmSettings

    def make(self, key: str, progress: Progress) -> None:
        def compute() -> Item:
            posed = not self.settings.estimate_poses
            given = [_given(self.features, photo, posed=posed) for photo in self.photos]
            config, refine = MAPPER_CONFIGS[self.settings.mapper], self.settings.refine
            inputs = self.rigs, self.matches, config, refine, self.work.scratch
            if self.settings.estimate_poses:
                return _to_item(reconstruct_places(given, self._describe, *inputs, progress))
            return _to_item(triangulate(given, *inputs, partial(progress, TRIANGULATION)))

        stages = (MAPPING, TRIANGULATION) if self.settings.estimate_poses else (TRIANGULATION,)
        if self.work.has(key):
            for stage in stages:
                progress(stage, len(self.photos), len(self.photos))
            return
        progress(stages[0], 0, len(self.photos))
        self.work.get(key, compute)

    def _describe(self, row: int) -> NDArray[np.int8]:
        return _described(self.features, self.photos[row])


@dataclass(frozen=True, slots=True, eq=False)
class _LateTask:
    """A worker's part, for the photos that a model left out."""

    work: WorkFolder
    photos: tuple[MappingPhoto, ...]
    features: LocalFeaturesSource
    model: SparseModel
    matches: Sequence[Matches]
    settings: SfmSettings

    def make(self, key: str, progress: Progress) -> None:
        def compute() -> Item:
            given = [_given(self.features, photo, posed=False) for photo in self.photos]
            config, told = MAPPER_CONFIGS[self.settings.mapper], partial(progress, _LATE)
            inputs = given, self._describe, self.matches, self.model, config
            return _to_item(with_late_photos(*inputs, self.work.scratch, told))

        if not self.work.has(key):
            self.work.get(key, compute)
        absent = self.model.views.count(None)
        progress(_LATE, absent, absent)

    def _describe(self, row: int) -> NDArray[np.int8]:
        return _described(self.features, self.photos[row])


def _described(features: LocalFeaturesSource, photo: MappingPhoto) -> NDArray[np.int8]:
    # One scale for all: they are unit rows.
    return np.rint(_LARGEST * features.read(photo).descriptors).astype(np.int8)


def _given(features: LocalFeaturesSource, photo: MappingPhoto, *, posed: bool) -> SfmPhoto:
    return SfmPhoto(
        name=photo.name,
        sensor=photo.record.sensor_id,
        timestamp=photo.record.timestamp,
        camera=photo.camera,
        camera_known=photo.camera_known,
        cam_from_world=photo.pose if posed else None,
        keypoints=features.read(photo).keypoints,
    )


def _model_key(
    matches_key: str,
    photos: Sequence[MappingPhoto],
    rigs: Rigs,
    settings: SfmSettings,
) -> str:
    return key_of(
        "sparse_model",
        _REVISION,
        matches=matches_key,
        config=asdict(MAPPER_CONFIGS[settings.mapper]),
        refine=sorted(settings.refine),
        estimate_poses=settings.estimate_poses,
        photos=[
            [
                photo.record.sensor_id,
                photo.record.timestamp,
                *camera_values(photo.camera),
                photo.camera_known,
                *(() if settings.estimate_poses else pose_values(photo.pose)),
            ]
            for photo in photos
        ],
        rigs={
            rig: {sensor: pose_values(pose) for sensor, pose in members.items()}
            for rig, members in rigs.items()
        },
    )


def _to_item(model: SparseModel) -> Item:
    placed = [row for row, view in enumerate(model.views) if view is not None]
    views = [view for view in model.views if view is not None]
    poses = [[*v.cam_from_world.rotation.ravel(), *v.cam_from_world.translation] for v in views]
    counts = [len(view.camera.params) for view in views]
    return {
        "placed": np.array(placed, dtype=np.int64),
        "poses": np.array(poses).reshape(-1, 12),
        "models": np.array([view.camera.model for view in views], dtype=np.str_),
        "param_offsets": np.cumsum([0, *counts]),
        "params": np.array([value for view in views for value in view.camera.params]),
        "points": model.points,
        "angles_deg": model.angles_deg,
        "on_rigs": np.array(model.on_rigs),
        "doubt_sensors": np.array(list(model.doubts), dtype=np.str_),
        "doubt_reasons": np.array([doubt.reason for doubt in model.doubts.values()], dtype=np.str_),
        "doubt_px": np.array([doubt.focal_length_px for doubt in model.doubts.values()]),
        "undone": np.array(model.undone),
        **{f"observed_{name}": array for name, array in asdict(model.observations).items()},
    }


def _from_item(item: Item, photos: Sequence[MappingPhoto]) -> SparseModel:
    views: list[View | None] = [None] * len(photos)
    offsets = item["param_offsets"]
    for order, row in enumerate(item["placed"].tolist()):
        known = photos[row].camera
        params = tuple(item["params"][offsets[order] : offsets[order + 1]].tolist())
        camera = Camera(str(item["models"][order]), known.width, known.height, params)
        numbers = item["poses"][order]
        views[row] = View(camera, Pose(numbers[:9].reshape(3, 3), numbers[9:]))
    observations = Observations(
        *(item[f"observed_{name}"] for name in ("points", "views", "rows", "pixels"))
    )
    doubts = zip(
        *(item[f"doubt_{name}"].tolist() for name in ("sensors", "reasons", "px")), strict=True
    )
    return SparseModel(
        tuple(views),
        item["points"],
        observations,
        item["angles_deg"],
        bool(item["on_rigs"]),
        {sensor: Doubt(reason, focal) for sensor, reason, focal in doubts},
        int(item["undone"]),
    )
