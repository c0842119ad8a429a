"""Landmarks from matches: pairs, matches, verification, triangulation.

The mapping strategy for posed photos without depth of Humenberger et al. 2020; with
estimated poses also for photos without poses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from mapping.build.features import LocalFeaturesSource, Progress
from mapping.build.landmarks import MadeLandmarks, Observations, View, assemble_landmarks
from mapping.build.photos import MappingPhoto
from mapping.build.stages import Item, WorkFolder, key_of
from mapping.cli.progress import one_step
from mapping.cluster.executors import Executor
from mapping.frames.anchor import align_positions, known_positions
from mapping.methods.intrinsics import CAMERAS, CameraOrigin, Doubt, notes_on, origin_of
from mapping.methods.matching import Matches, Verification, camera_values, match_pairs, pose_values
from mapping.methods.pairing import Pairs, PairSettings, Scene, pair_photos, read_pairs
from mapping.methods.triangulation import (
    MAPPER_CONFIGS,
    MapperConfig,
    SfmPhoto,
    SparseModel,
    reconstruct,
    triangulate,
)
from visloc.archive import Anchor, GlobalFeatures, Map, sha256_of
from visloc.errors import DatasetError, refuse
from visloc.geometry import Camera, Pose, Similarity
from visloc.kapture import Dataset, read_reconstruction

# Raised when the code of the stage changes what comes out.
_MODEL_REVISION = 3


@dataclass(frozen=True, slots=True)
class SfmSettings:
    """How landmarks are made from matches.

    Attributes:
        pairs: names of ``mapping.methods.pairing.PAIRINGS``; not used with ``pairs_file``.
        pairing: their settings.
        pairs_file: pairs to read instead.
        covisible_in: a map whose observations tell which photos see the same, for
            ``covisibility``; without it, the dataset's own reconstruction.
        mapper: a name of ``MAPPER_CONFIGS``.
        refine: names of ``REFINABLE``; of them only ``intrinsics`` with ``estimate_poses``.
        estimate_poses: find poses too; known ones only anchor the result.
    """

    pairs: tuple[str, ...] = ("retrieval",)
    pairing: PairSettings = field(default_factory=PairSettings)
    pairs_file: Path | None = None
    covisible_in: Map | None = None
    mapper: str = "config1"
    refine: tuple[str, ...] = ()
    estimate_poses: bool = False


def landmarks_from_matches(
    work: WorkFolder,
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    features: LocalFeaturesSource,
    global_features: Sequence[GlobalFeatures],
    settings: SfmSettings,
    metric: bool,
    workers: Executor,
    progress: Progress,
) -> MadeLandmarks:
    """Pair, match and verify the photos, and make landmarks of what was matched.

    Raises:
        InvalidInput: ``pairs.*``, ``sfm.*``.
        DatasetError: with the file that is wrong.
    """
    config = MAPPER_CONFIGS[settings.mapper]
    scene = make_scene(dataset, photos, global_features, settings)
    with one_step(progress, "pairs"):
        pairs = find_pairs(scene, settings)
    verification = Verification(
        max_error_px=config.filter_max_reproj_error,
        min_matches=config.min_num_matches,
        poses_known=not settings.estimate_poses,
    )
    matches, matches_key = match_pairs(
        work, photos, features, pairs.rows, verification, workers, progress
    )

    rigs = known_rigs(dataset, {photo.record.sensor_id for photo in photos})
    task = _ModelTask(
        work,
        tuple(photos),
        features,
        rigs,
        matches,
        config,
        settings.refine,
        settings.estimate_poses,
    )
    key = _model_key(matches_key, photos, dataset, config, settings)
    stage = "incremental mapping" if settings.estimate_poses else "triangulation"
    workers.run_one(task.make, key, partial(progress, stage))
    model = _from_item(work.read(key), photos)
    placed = np.array([row for row, view in enumerate(model.views) if view is not None])
    views = [view for view in model.views if view is not None]
    points, notes = model.points, []
    absent = [photo.name for photo, v in zip(photos, model.views, strict=True) if v is None]
    if absent:
        notes.append(f"{len(absent)} of {len(photos)} photos found no place: {_some(absent)}")
    origins = _origins(dataset, photos, model)
    notes += notes_on(origins, _names_by_sensor(photos))
    rig_scale: float | None = 1.0
    anchor = Anchor(kind="dataset", images=len(photos))
    if settings.estimate_poses:
        similarity, anchor, note = _anchored(dataset, photos, model)
        views = [View(v.camera, similarity.move(v.cam_from_world)) for v in views]
        points = similarity.apply(points)
        # Without rigs in it, the reconstruction had a unit of its own.
        rig_scale = similarity.scale if model.on_rigs else None
        metric = anchor.kind == "gnss" or (anchor.kind == "positions" and metric)
        notes += [note] if note else []
    number = np.full(len(photos), -1)
    number[placed] = np.arange(len(placed))
    observations = replace(model.observations, views=number[model.observations.views])
    landmarks, rows = assemble_landmarks(views, points, observations, angles_deg=model.angles_deg)
    return MadeLandmarks(
        photos=placed,
        views=tuple(views),
        landmarks=landmarks,
        rows=tuple(rows),
        settings=_settings_record(settings) | _origins_record(origins, settings),
        metric=metric,
        anchor=anchor,
        rig_scale=rig_scale,
        notes=tuple(notes),
        pairs=(scene, pairs),
    )


def _origins(
    dataset: Dataset, photos: Sequence[MappingPhoto], model: SparseModel
) -> dict[str, CameraOrigin]:
    """Return the source of each camera's focal length, by sensor."""
    return {
        sensor: origin_of(dataset.sensors[sensor], model.doubts.get(sensor))
        for sensor in _names_by_sensor(photos)
    }


def _origins_record(
    origins: Mapping[str, CameraOrigin], settings: SfmSettings
) -> dict[str, JsonValue]:
    """Return what the manifest stores of them; nothing when no camera was refined or estimated."""
    if not (settings.estimate_poses or "intrinsics" in settings.refine):
        return {}
    return {CAMERAS: {sensor: one.model_dump() for sensor, one in origins.items()}}


def _names_by_sensor(photos: Sequence[MappingPhoto]) -> dict[str, list[str]]:
    names: dict[str, list[str]] = {}
    for photo in photos:
        names.setdefault(photo.record.sensor_id, []).append(photo.name)
    return names


def find_pairs(scene: Scene, settings: SfmSettings) -> Pairs:
    """Return the pairs of the settings' file, or of their pairings.

    Raises:
        InvalidInput: ``pairs.none``, and what the pairings raise.
        DatasetError: what ``read_pairs`` raises.
    """
    if settings.pairs_file is not None:
        pairs = read_pairs(settings.pairs_file, scene)
    else:
        pairs = pair_photos(scene, settings.pairs, settings.pairing)
    if len(pairs) == 0:
        raise refuse(
            "pairs.none",
            field="--pairs" if settings.pairs_file is None else str(settings.pairs_file),
            got=f"{len(scene.names)} photos, no pair",
        )
    return pairs


def known_rigs(dataset: Dataset, cameras: set[str]) -> dict[str, dict[str, Pose]]:
    """cam_from_rig of the map's cameras, where the dataset knows it."""
    rigs = {
        rig: {sensor: pose for sensor, pose in members.items() if sensor in cameras and pose}
        for rig, members in dataset.rigs.items()
    }
    return {rig: members for rig, members in rigs.items() if members}


def make_scene(
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    global_features: Sequence[GlobalFeatures],
    settings: SfmSettings,
) -> Scene:
    """Gather what pairings may look at."""
    names = tuple(photo.name for photo in photos)
    wanted = "covisibility" in settings.pairs and settings.pairs_file is None
    return Scene(
        names=names,
        sensors=tuple(photo.record.sensor_id for photo in photos),
        timestamps=np.array([photo.record.timestamp for photo in photos], dtype=np.int64),
        cameras=tuple(photo.camera for photo in photos),
        cam_from_world=tuple(photo.cam_from_world for photo in photos),
        global_descriptors={f.fingerprint.name: f.descriptors for f in global_features},
        tracks=_tracks(dataset, names, settings.covisible_in)
        if wanted
        else np.empty((0, 2), dtype=np.int64),
    )


def _tracks(dataset: Dataset, names: Sequence[str], covisible_in: Map | None) -> NDArray[np.int64]:
    """(M, 2) rows: point, photo."""
    row_of_name = {name: row for row, name in enumerate(names)}
    if covisible_in is not None:
        counts = np.diff(covisible_in.observation_offsets)
        seen_in = [row_of_name.get(image.name, -1) for image in covisible_in.images]
        images = np.repeat(np.array(seen_in, dtype=np.int64), counts)
        points = np.asarray(covisible_in.observation_landmarks, dtype=np.int64)
    else:
        known = read_reconstruction(dataset.root)
        if known is None:
            raise refuse(
                "pairs.no_tracks",
                field=str(dataset.root / "reconstruction" / "observations.txt"),
                expected="points3d.txt and observations.txt there, or a map: --covisible-in MAP",
                kind=DatasetError,
            )
        seen_in = [row_of_name.get(name, -1) for name in known.images]
        images = np.array(seen_in, dtype=np.int64)[known.observations[:, 1]]
        points = known.observations[:, 0]
    return np.column_stack([points, images])[images >= 0]


@dataclass(frozen=True, slots=True, eq=False)
class _ModelTask:
    """What a worker does for the whole map, once all matches are there."""

    work: WorkFolder
    photos: tuple[MappingPhoto, ...]
    features: LocalFeaturesSource
    rigs: Mapping[str, Mapping[str, Pose]]
    matches: Sequence[Matches]
    config: MapperConfig
    refine: tuple[str, ...]
    estimate_poses: bool

    def make(self, key: str, progress: Callable[[int, int], None]) -> None:
        def compute() -> Item:
            given = [self._given(photo) for photo in self.photos]
            inputs = given, self.rigs, self.matches, self.config, self.refine, self.work.scratch
            if self.estimate_poses:
                return _to_item(reconstruct(*inputs, progress))
            return _to_item(triangulate(*inputs))

        total = len(self.photos) if self.estimate_poses else 1
        progress(0, total)
        self.work.get(key, compute)
        progress(total, total)

    def _given(self, photo: MappingPhoto) -> SfmPhoto:
        return SfmPhoto(
            name=photo.name,
            sensor=photo.record.sensor_id,
            timestamp=photo.record.timestamp,
            camera=photo.camera,
            camera_known=photo.camera_known,
            cam_from_world=None if self.estimate_poses else photo.pose,
            keypoints=self.features.read(photo).keypoints,
        )


def _anchored(
    dataset: Dataset, photos: Sequence[MappingPhoto], model: SparseModel
) -> tuple[Similarity, Anchor, str | None]:
    """Where an estimated model lies, as far as known positions tell."""
    free = Similarity(1.0, np.eye(3), np.zeros(3)), Anchor(kind="none", images=0)
    known = known_positions(dataset, photos)
    if known is None:
        return *free, "nothing says where the photos were taken: the frame and unit are arbitrary"
    placed = np.array([model.views[row] is not None for row in known.photos])
    views = [view for row in known.photos if (view := model.views[row]) is not None]
    centers = np.array([view.cam_from_world.center for view in views]).reshape(-1, 3)
    positions = known.positions[placed]
    found = align_positions(centers, positions, known.max_error)
    if isinstance(found, str):
        return *free, (
            f"{len(known.photos)} photos have a known position ({known.anchor.kind}), but {found}: "
            "the frame and unit are arbitrary"
        )
    similarity, agrees = found
    errors = np.linalg.norm(similarity.apply(centers) - positions, axis=1)[agrees]
    rms = float(np.sqrt(np.mean(errors**2)))
    anchor = known.anchor.model_copy(update={"images": int(agrees.sum()), "rms": rms})
    return similarity, anchor, None


def _model_key(
    matches_key: str,
    photos: Sequence[MappingPhoto],
    dataset: Dataset,
    config: MapperConfig,
    settings: SfmSettings,
) -> str:
    rigs = known_rigs(dataset, {photo.record.sensor_id for photo in photos})
    return key_of(
        "sparse_model",
        _MODEL_REVISION,
        matches=matches_key,
        config=asdict(config),
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
    )


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def _settings_record(settings: SfmSettings) -> dict[str, JsonValue]:
    """What the manifest says of the settings: those that were used."""
    pairing = settings.pairing
    used: dict[str, JsonValue] = {
        "mapper": {"name": settings.mapper, **asdict(MAPPER_CONFIGS[settings.mapper])},
        "refine": list(settings.refine),
        "poses": "estimate" if settings.estimate_poses else "given",
    }
    if settings.pairs_file is not None:
        return {"pairs_file_sha256": sha256_of(settings.pairs_file), **used}
    if "distance" in settings.pairs:
        used |= {"max_distance": pairing.max_distance, "max_angle_deg": pairing.max_angle_deg}
    if "frustum" in settings.pairs:
        used |= {"near": pairing.near, "far": pairing.far}
    if "covisibility" in settings.pairs and settings.covisible_in is not None:
        used |= {"covisible_in": settings.covisible_in.ref}
    return {"pairs": list(settings.pairs), "top_k": pairing.top_k, **used}
