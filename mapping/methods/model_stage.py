"""The stages of a build that make sparse models of matches; a worker does each as a whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapping.methods.matching.stages import Matches, camera_values, pose_values
from mapping.methods.sfm_settings import SfmSettings
from mapping.methods.sparse.colmap_scene import Rigs
from mapping.methods.sparse.extending import with_late_photos
from mapping.methods.sparse.intrinsics import Doubt
from mapping.methods.sparse.look_alikes import without_look_alikes
from mapping.methods.sparse.model import MAPPER_CONFIGS, SfmPhoto, SparseModel
from mapping.methods.sparse.triangulation import (
    ADJUSTMENT,
    LOOK_ALIKES,
    MAPPING,
    READING,
    TRIANGULATION,
    triangulate,
)
from mapping.methods.undoing import PLACES, reconstruct_places
from mapping.progress import Progress
from mapping.stages.context import BuildContext
from mapping.stages.landmarks import Observations, View
from mapping.stages.local_features import LocalFeaturesSource
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc.geometry import Camera, Pose

# Raised when the code of the stage changes what comes out.
_REVISION = 20
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
    """
    inputs = _Inputs.of(context, photos, matches, settings)
    key = _model_key(matches_key, photos, rigs, settings)
    stage = MAPPING if settings.estimate_poses else TRIANGULATION
    context.workers.run_one(partial(_make, inputs, rigs), key, stage, context.progress)
    return _from_item(context.work.read(key), photos)


def with_latecomers(
    context: BuildContext,
    photos: Sequence[MappingPhoto],
    model: SparseModel,
    matches: Sequence[Matches],
    matches_key: str,
    settings: SfmSettings,
) -> SparseModel:
    """Place photos that a model left out, where they show what it has there.

    A model on rigs, or one whose pairs were undone because they joined two places, stays as it is.

    Args:
        matches: verified, of pairs with at least these photos.
        matches_key: stands for them in the key of the result.
    """
    if None not in model.views or model.undone or model.on_rigs:
        return model
    inputs = _Inputs.of(context, photos, matches, settings)
    poses = [None if view is None else pose_values(view.cam_from_world) for view in model.views]
    key = key_of(
        "late_photos",
        _LATE_REVISION,
        matches=matches_key,
        poses=poses,
        model=_model_key("", photos, {}, settings),
    )
    context.workers.run_one(partial(_place, inputs, model), key, _LATE, context.progress)
    return _from_item(context.work.read(key), photos)


def without_poses(context: BuildContext, photos: Sequence[MappingPhoto]) -> list[SfmPhoto]:
    """Return the mapper's view of photos whose poses are estimated."""
    return _given(context.features, photos, posed=False)


def believed_pairs(
    context: BuildContext,
    photos: Sequence[MappingPhoto],
    matches: Sequence[Matches],
    matches_key: str,
    settings: SfmSettings,
) -> list[Matches]:
    """Return the pairs of photos without poses that seem to show one place.

    Among some of the photos, fewer matches would be missed: all photos tell more.
    """
    inputs = _Inputs.of(context, photos, matches, settings)
    model = _model_key(matches_key, photos, {}, settings)
    key = key_of("believed_pairs", 1, model=model)
    context.workers.run_one(partial(_believe, inputs), key, LOOK_ALIKES, context.progress)
    return [matches[row] for row in context.work.read(key)["pairs"].tolist()]


@dataclass(frozen=True, slots=True, eq=False)
class _Inputs:
    """The input of a worker for a stage of the whole map."""

    work: WorkFolder
    photos: tuple[MappingPhoto, ...]
    features: LocalFeaturesSource
    matches: Sequence[Matches]
    settings: SfmSettings

    @staticmethod
    def of(
        context: BuildContext,
        photos: Sequence[MappingPhoto],
        matches: Sequence[Matches],
        settings: SfmSettings,
    ) -> _Inputs:
        # A map to pair by is not needed any more, and is not sent to a worker.
        sent = replace(settings, covisible_in=None)
        return _Inputs(context.work, tuple(photos), context.features, matches, sent)

    def given(self, *, posed: bool) -> list[SfmPhoto]:
        return _given(self.features, self.photos, posed=posed)

    def describe(self, row: int) -> NDArray[np.int8]:
        # One scale for all: they are unit rows.
        return np.rint(_LARGEST * self.features.read(self.photos[row]).descriptors).astype(np.int8)

    def keep(
        self, key: str, stages: Sequence[str], progress: Progress, compute: Callable[[], Item]
    ) -> None:
        """Compute a result, or tell that the stages of one that is there are done."""
        count = len(self.photos)
        if self.work.has(key):
            for stage in stages:
                progress(stage, count, count)
            return
        progress(stages[0], 0, count)
        self.work.get(key, compute)


def _given(
    features: LocalFeaturesSource, photos: Sequence[MappingPhoto], *, posed: bool
) -> list[SfmPhoto]:
    return [
        SfmPhoto(
            name=photo.name,
            sensor=photo.record.sensor_id,
            timestamp=photo.record.timestamp,
            camera=photo.camera,
            camera_known=photo.camera_known,
            cam_from_world=photo.pose if posed else None,
            keypoints=features.read(photo).keypoints,
        )
        for photo in photos
    ]


def _make(inputs: _Inputs, rigs: Rigs, key: str, progress: Progress) -> None:
    """Make a sparse model in a worker."""
    settings, posed = inputs.settings, not inputs.settings.estimate_poses
    adjusted = (ADJUSTMENT,) if settings.refine else ()
    stages = (
        (TRIANGULATION, *adjusted, READING)
        if posed
        else (LOOK_ALIKES, MAPPING, ADJUSTMENT, TRIANGULATION, READING, PLACES)
    )

    def compute() -> Item:
        given, config = inputs.given(posed=posed), MAPPER_CONFIGS[settings.mapper]
        how = rigs, inputs.matches, config, settings.refine, inputs.work.scratch, progress
        if posed:
            return _to_item(triangulate(given, *how))
        return _to_item(reconstruct_places(given, inputs.describe, *how))

    inputs.keep(key, stages, progress, compute)


def _place(inputs: _Inputs, model: SparseModel, key: str, progress: Progress) -> None:
    """Place photos that a model left out, in a worker."""

    def compute() -> Item:
        return _to_item(
            with_late_photos(
                inputs.given(posed=False),
                inputs.describe,
                inputs.matches,
                model,
                MAPPER_CONFIGS[inputs.settings.mapper],
                inputs.work.scratch,
                partial(progress, _LATE),
            )
        )

    inputs.keep(key, (_LATE,), progress, compute)


def _believe(inputs: _Inputs, key: str, progress: Progress) -> None:
    """Find pairs of one place, in a worker."""

    def compute() -> Item:
        told = partial(progress, LOOK_ALIKES)
        kept = without_look_alikes(inputs.given(posed=False), inputs.matches, told)
        pairs = {(pair.first, pair.second) for pair in kept}
        rows = [row for row, p in enumerate(inputs.matches) if (p.first, p.second) in pairs]
        return {"pairs": np.array(rows, dtype=np.int64)}

    inputs.keep(key, (LOOK_ALIKES,), progress, compute)


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
