"""``mapping build``: from a kapture dataset to a published map, stage by stage."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.build.colours import landmark_colours
from mapping.build.features import (
    ExtractedFeatures,
    LocalFeaturesSource,
    Progress,
    ReadyMadeFeatures,
    describe_photos,
    find_local_features,
    local_features_source,
    open_descriptor,
    open_extractor,
    read_global_features,
)
from mapping.build.landmarks import MadeLandmarks
from mapping.build.outputs import refuse_existing
from mapping.build.photos import MappingPhoto, collect_photos
from mapping.build.previews import keep_photos
from mapping.build.publishing import PAIRS, publish_content
from mapping.build.stages import WorkFolder, exclusive
from mapping.cli.progress import one_step
from mapping.cluster.executors import EXECUTORS, Executor, open_executor
from mapping.cluster.stage_timings import Costs, wrote
from mapping.cluster.storage import (
    is_remote,
    lies_in,
    open_store,
    opened_dataset,
    scratch_folder,
    storage_errors,
    work_place,
)
from mapping.cluster.workers import one_thread_here
from mapping.frames.anchor import MAX_DIRECTION_ERROR_DEG, known_positions
from mapping.methods.known_model import landmarks_from_reconstruction, refuse_without_points
from mapping.methods.pairing import PAIRINGS, POSED_PAIRINGS, write_pairs
from mapping.methods.rgbd import DepthSettings, landmarks_from_depth, refuse_without_depth
from mapping.methods.sfm import (
    SfmSettings,
    find_pairs,
    known_rigs,
    landmarks_from_matches,
    make_scene,
)
from mapping.methods.triangulation import MAPPER_CONFIGS, REFINABLE
from visloc.archive import (
    Anchor,
    FingerprintRecord,
    GlobalFeatures,
    ImageRecord,
    MapContent,
    MapStore,
    pose_row,
)
from visloc.errors import refuse
from visloc.features import DEFAULT_GLOBAL_FEATURES, DEFAULT_LOCAL_FEATURES
from visloc.features.backends.choice import choose_inference
from visloc.features.local.readymade import is_ready_made, ready_made_type
from visloc.geometry import PixelOrigin, Pose
from visloc.kapture import Dataset, open_features, read_dataset
from visloc.retrieval.fusion import EQUAL_GHARM, LateFusion
from visloc.types import Inference, check_fusion_weights

# How landmarks are made: from depth, from matches, or from points that the dataset brings along.
METHODS = ("rgbd", "sfm", "model")
# Where the world's axes point east, north and up.
_GEODETIC_DOWN = (0.0, 0.0, -1.0)
# Shorter vectors are round-off, not a direction.
_MIN_LENGTH = 1e-6


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """What a build is made of.

    Attributes:
        dataset: kapture folder, or the URL of one (``mapping.cluster.storage``).
        map_id: id of the map.
        maps_dir: folder of maps, or the URL of one.
        cache_dir: for maps of a URL: folder of their copies here.
        work_dir: folder or URL in which finished work is kept, in a folder of its own; None:
            beside the maps.
        method: a name of ``METHODS``.
        local_features: a name of ``visloc.features.LOCAL_FEATURES``, or ``kapture:TYPE`` for
            features that the dataset brings along.
        global_features: names of ``visloc.features.GLOBAL_FEATURES``, or ``kapture:TYPE``.
        fusion: how queries fuse them, unless they say otherwise.
        features_dir: where ready-made features lie, when not in the dataset.
        pixel_origin: what the dataset's principal points and ready-made keypoints count from.
        weights_dir: folder with network weights.
        inference: how networks are computed.
        max_keypoints: strongest keypoints kept per photo, in the map and in queries.
        metric: whether a unit of the dataset's poses is a metre; None: yes, as kapture has it, but
            not for ``model``, since a reconstruction has the unit that its tool chose.
        depth: settings of ``rgbd``.
        depth_sensor: the depth sensor to use, when several go with a photo.
        sfm: settings of ``sfm``.
        gravity: a vector of any length that points down in the map's world; None where that is
            not known. A map that is anchored on Earth knows it without.
        keep_photos: whether the map keeps a small picture of each photo, for a person's eyes.
        keep_colours: whether it keeps the colours of the landmarks, for the same. Those that a
            model brings along stay in any case.
        workers: processes that work on photos and pairs.
        executor: where they are, a name of ``EXECUTORS``.
        ray_address: of the cluster, for ``ray``.
        force: publish a new version of a map that exists.
    """

    dataset: Path
    map_id: str
    maps_dir: Path
    method: str = "rgbd"
    local_features: str = DEFAULT_LOCAL_FEATURES
    global_features: tuple[str, ...] = DEFAULT_GLOBAL_FEATURES
    fusion: LateFusion = EQUAL_GHARM
    features_dir: Path | None = None
    pixel_origin: PixelOrigin = PixelOrigin.CORNER
    weights_dir: Path | None = None
    inference: Inference = Inference.AUTO
    max_keypoints: int = 5000
    metric: bool | None = None
    depth: DepthSettings = field(default_factory=DepthSettings)
    depth_sensor: str | None = None
    sfm: SfmSettings = field(default_factory=SfmSettings)
    gravity: tuple[float, float, float] | None = None
    keep_photos: bool = False
    keep_colours: bool = False
    workers: int = 1
    executor: str = EXECUTORS[0]
    ray_address: str = "auto"
    force: bool = False
    work_dir: Path | None = None
    cache_dir: Path = Path("maps-cache")


def build_map(settings: BuildSettings, progress: Progress, costs: Costs | None = None) -> Path:
    """Build a map and publish it as the current version.

    Killed at any moment, the same call finds its finished work again; the map that was current
    before stays so until the new one is complete and verified.

    Args:
        settings: what it is made of.
        progress: told the stage, how much of it is done, and how much there is.
        costs: told what the stages cost.

    Returns:
        The folder of the new version; of maps of a URL, that of the copy here.

    Raises:
        Conflict: ``map.exists`` without ``force``; ``build.running``.
        DatasetError, WeightsError, InvalidInput: with the file or the setting that is wrong.
        Unavailable: ``storage.failed`` when the disk is full or broken; what executors raise.
    """
    if settings.executor != "local" and settings.inference is Inference.AUTO:
        # What suits this machine; each of a cluster would choose for itself.
        settings = replace(settings, inference=choose_inference(settings.inference))
    _check(settings)
    store = open_store(settings.maps_dir, settings.cache_dir)
    versions = store.versions(settings.map_id)
    # Versions of which none is current are what a build left that was killed while it published.
    if versions and settings.map_id in store.ids() and not settings.force:
        raise refuse(
            "map.exists",
            (
                f"map {settings.map_id!r} exists (version {versions[-1]}); --force publishes "
                "a new version and keeps the old one"
            ),
            field="--map",
        )
    if not is_ready_made(settings.local_features):  # raises when it cannot
        open_extractor(settings.local_features, settings.weights_dir, settings.inference)
    scratch = scratch_folder(settings.maps_dir, settings.cache_dir, settings.map_id)
    work = WorkFolder(work_place(settings.work_dir or settings.maps_dir, settings.map_id))
    try:
        with (
            opened_dataset(settings.dataset) as dataset,
            exclusive(scratch.with_name(f"{scratch.name}.lock")),
        ):
            if settings.work_dir is not None:
                work.claim()
            with open_executor(
                settings.executor, settings.workers, settings.ray_address
            ) as workers:
                if costs is not None:
                    progress = costs.measured(progress, workers)
                dataset = dataset.with_pixels_from(settings.pixel_origin)
                with one_thread_here():  # so that processors do not change what comes out
                    folder = _build(settings, dataset, store, work, scratch, workers, progress)
            work.remove()
            shutil.rmtree(scratch, ignore_errors=True)
    except storage_errors() as error:
        raise refuse(
            "storage.failed",
            field=str(getattr(error, "filename", None) or work.root),
            why=getattr(error, "strerror", None) or error,
        ) from error
    return folder


def write_pairs_of(
    root: Path,
    output: Path,
    settings: SfmSettings,
    global_features: tuple[str, ...],
    features_dir: Path | None,
    pixel_origin: PixelOrigin,
    progress: Progress,
) -> tuple[int, list[str]]:
    """Pair the photos of a dataset and write the pairs file.

    Where a pairing goes by poses, photos without a pose or a camera are left out, as a build with
    given poses leaves them out. The other pairings take all photos.

    Args:
        root: kapture folder; the photos themselves need not be there.
        output: the file; it must not exist.
        settings: pairings and their settings.
        global_features: names ``kapture:TYPE``, for ``retrieval``.
        features_dir: where they lie, when not in the dataset.
        pixel_origin: what the dataset's principal points count from.
        progress: told the stage, how much is done, and how much there is.

    Returns:
        How many pairs were written, and notes on the photos that were left out.

    Raises:
        Conflict: ``pairs.exists``.
        InvalidInput, DatasetError: with the option or the file that is wrong.
    """
    refuse_existing(output, "pairs.exists")
    _check_names("--pairs", settings.pairs, tuple(PAIRINGS))
    dataset = read_dataset(root).with_pixels_from(pixel_origin)
    photos, notes = collect_photos(
        dataset,
        posed=not POSED_PAIRINGS.isdisjoint(settings.pairs),
        with_files=False,
        progress=partial(progress, "photos"),
    )
    described = [_read_global(dataset, name, features_dir, photos) for name in global_features]
    scene = make_scene(dataset, photos, described, settings)
    with one_step(progress, "pairs"):
        found = find_pairs(scene, settings)
    write_pairs(output, scene, found)
    return len(found), notes


def _read_global(
    dataset: Dataset, name: str, features_dir: Path | None, photos: Sequence[MappingPhoto]
) -> GlobalFeatures:
    features = open_features(dataset.root, "global_features", ready_made_type(name), features_dir)
    return read_global_features(features, photos)


def _check(settings: BuildSettings) -> None:
    """Refuse what would otherwise fail after hours, or give a useless map."""
    if settings.method not in METHODS:
        raise refuse("build.method", field="--method", expected=METHODS, got=settings.method)
    _check_names("--executor", (settings.executor,), EXECUTORS)
    if settings.work_dir is not None:
        _refuse_mixed_places(settings, settings.work_dir)
    if is_remote(settings.dataset) and (
        settings.method == "model"
        or any(is_ready_made(n) for n in (settings.local_features, *settings.global_features))
    ):
        raise refuse("build.dataset", field="dataset", got=str(settings.dataset))
    names = settings.global_features
    if not names or "" in names or len(set(names)) < len(names):
        raise refuse("build.global_features", field="--global-features", got=",".join(names))
    if settings.fusion.weights is not None:
        check_fusion_weights(settings.fusion.weights, "build.fusion_weights", "--fusion-weights")
        unknown = [name for name in settings.fusion.weights if name not in names]
        if unknown:
            raise refuse(
                "build.fusion_weights",
                field="--fusion-weights",
                expected=f"of {', '.join(names)}",
                got=",".join(unknown),
            )
    for name in names:
        if is_ready_made(name):
            continue
        descriptor = open_descriptor(name, settings.weights_dir, settings.inference)
        if descriptor.needs_image and is_ready_made(settings.local_features):
            raise refuse(
                "build.global_features",
                (
                    f"{name} is computed from the photo, which is missing when features are sent "
                    "instead"
                ),
                field="--global-features",
                expected="kapture:TYPE, or localvlad, with ready-made local features",
                got=name,
            )
    for name in ("voxel_size", "depth_scale"):
        value = getattr(settings.depth, name)
        if not (math.isfinite(value) and value > 0):
            raise refuse(f"build.{name}", field=f"--{name.replace('_', '-')}", got=value)
    if settings.gravity is not None:
        length = math.hypot(*settings.gravity)
        if not (math.isfinite(length) and length >= _MIN_LENGTH):
            raise refuse(
                "build.gravity",
                field="--gravity",
                got=",".join(f"{value:g}" for value in settings.gravity),
            )
    sfm = settings.sfm
    _check_names("--pairs", sfm.pairs, tuple(PAIRINGS))
    _check_names("--refine", sfm.refine, REFINABLE)
    _check_names("--mapper", (sfm.mapper,), tuple(MAPPER_CONFIGS))
    if sfm.estimate_poses and settings.method != "sfm":
        raise refuse(
            "build.poses", field="--poses", got=f"estimate with --method {settings.method}"
        )
    if sfm.estimate_poses and not set(sfm.refine) <= {"intrinsics"}:
        raise refuse("build.refine", field="--refine", got=",".join(sfm.refine))


def _refuse_mixed_places(settings: BuildSettings, work_dir: Path) -> None:
    """Refuse a folder for finished work that is among other things, or holds them.

    It is removed when the map is published.
    """
    root = work_place(work_dir, settings.map_id)
    for option, place in (
        ("DATASET", settings.dataset),
        ("--maps-dir", settings.maps_dir),
        ("--cache-dir", settings.cache_dir),
    ):
        if lies_in(root, place) or lies_in(place, root):
            raise refuse(
                "build.work_dir",
                (
                    f"finished work would be kept in {root}, which overlaps {option}, and "
                    "publishing the map removes it"
                ),
                field="--work-dir",
                expected=f"a folder apart from {option}, or without the option",
                got=str(work_dir),
            )


def _check_names(option: str, names: Sequence[str], known: Sequence[str]) -> None:
    unknown = [name for name in names if name not in known]
    if unknown or len(set(names)) < len(names):
        raise refuse(
            f"build.{option[2:]}",
            "a name is unknown" if unknown else "a name is given twice",
            field=option,
            expected=f"of {', '.join(known)}, each once",
            got=",".join(names),
        )


def _build(
    settings: BuildSettings,
    dataset: Dataset,
    store: MapStore,
    work: WorkFolder,
    scratch: Path,
    workers: Executor,
    progress: Progress,
) -> Path:
    features = local_features_source(
        work,
        settings.dataset,
        settings.local_features,
        max_keypoints=settings.max_keypoints,
        weights_dir=settings.weights_dir,
        inference=settings.inference,
        features_dir=settings.features_dir,
        pixel_origin=settings.pixel_origin,
    )
    photos, notes = collect_photos(
        dataset,
        posed=not settings.sfm.estimate_poses,
        with_files=isinstance(features, ExtractedFeatures)
        or settings.keep_photos
        or settings.keep_colours,
        has_features=features.has if isinstance(features, ReadyMadeFeatures) else None,
        with_depth=settings.method == "rgbd",
        depth_sensor=settings.depth_sensor,
        progress=partial(progress, "photos"),
    )
    # What cannot end well is refused before the long work begins.
    brought = {
        name: _read_global(dataset, name, settings.features_dir, photos)
        for name in settings.global_features
        if is_ready_made(name)
    }
    with one_step(progress, "checks"):
        _refuse_early(settings, dataset, photos)
    find_local_features(features, photos, workers, progress)
    global_features = [
        brought[name]
        if name in brought
        else describe_photos(
            work,
            photos,
            features,
            name,
            settings.weights_dir,
            settings.inference,
            workers,
            progress,
        )
        for name in settings.global_features
    ]
    made = _make_landmarks(
        settings, dataset, work, photos, features, global_features, workers, progress
    )
    if settings.keep_colours and made.landmarks.colors is None:
        placed = [photos[row] for row in made.photos]
        colours = landmark_colours(work, placed, made.landmarks, workers, progress)
        made = replace(made, landmarks=replace(made.landmarks, colors=colours))
    content = _content(
        settings, dataset, photos, features, global_features, made, (*dataset.notes, *notes)
    )
    kept = [photos[row] for row in made.photos] if settings.keep_photos else []
    return _publish(settings, content, made, kept, store, work, scratch, workers, progress)


def _refuse_early(
    settings: BuildSettings, dataset: Dataset, photos: Sequence[MappingPhoto]
) -> None:
    """Refuse photos without depth, points, positions or pairs, as far as that can be known already.

    Pairing twice takes seconds where finding features takes hours.
    """
    if settings.method == "rgbd":
        refuse_without_depth(dataset, photos)
    if settings.method == "model":
        refuse_without_points(dataset)
    if settings.sfm.estimate_poses:
        known = known_positions(dataset, photos)
        if known is not None and known.anchor.geodetic is not None:
            _refuse_gravity_that_is_not_down(settings)
    if settings.method == "sfm":
        others = tuple(name for name in settings.sfm.pairs if name != "retrieval")
        if others or settings.sfm.pairs_file is not None:
            pairing = replace(settings.sfm, pairs=others)
            find_pairs(make_scene(dataset, photos, (), pairing), pairing)


def _refuse_gravity_that_is_not_down(settings: BuildSettings) -> None:
    """Refuse a direction of gravity that contradicts a world whose axes point east, north and up.

    A little off is right: the axes of such a map are as good as the fixes behind them.
    """
    if settings.gravity is None:
        return
    x, y, z = settings.gravity
    angle_deg = math.degrees(math.atan2(math.hypot(x, y), -z))
    if angle_deg > MAX_DIRECTION_ERROR_DEG:
        raise refuse(
            "build.gravity",
            (
                "the map is anchored to GNSS fixes, its axes point east, north and up, and "
                "this is not down; leave the option out"
            ),
            field="--gravity",
            expected=f"0,0,-1 to within {MAX_DIRECTION_ERROR_DEG:g} degrees",
            got=f"{x:g},{y:g},{z:g}, {angle_deg:.1f} degrees off",
        )


def _make_landmarks(
    settings: BuildSettings,
    dataset: Dataset,
    work: WorkFolder,
    photos: Sequence[MappingPhoto],
    features: LocalFeaturesSource,
    global_features: Sequence[GlobalFeatures],
    workers: Executor,
    progress: Progress,
) -> MadeLandmarks:
    metric = settings.method != "model" if settings.metric is None else settings.metric
    if settings.method == "rgbd":
        return landmarks_from_depth(
            work, dataset, photos, features, settings.depth, metric, workers, progress
        )
    if settings.method == "model":
        return landmarks_from_reconstruction(
            work,
            dataset,
            photos,
            features,
            settings.pixel_origin,
            settings.sfm,
            metric,
            workers,
            progress,
        )
    return landmarks_from_matches(
        work,
        dataset,
        photos,
        features,
        global_features,
        settings.sfm,
        metric,
        workers,
        progress,
    )


def _content(
    settings: BuildSettings,
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    features: LocalFeaturesSource,
    global_features: Sequence[GlobalFeatures],
    made: MadeLandmarks,
    notes: tuple[str, ...],
) -> MapContent:
    placed = [photos[row] for row in made.photos]
    gravity, gravity_notes = _gravity(settings, made.anchor)

    def observed_descriptors() -> Iterator[NDArray[np.float32]]:
        for photo, kept in zip(placed, made.rows, strict=True):
            yield features.read(photo).descriptors[kept]

    return MapContent(
        metric=made.metric,
        method=settings.method,
        settings=made.settings,
        notes=(*notes, *made.notes, *gravity_notes),
        cameras={
            photo.record.sensor_id: view.camera
            for photo, view in zip(placed, made.views, strict=True)
        },
        rigs={
            rig: {
                sensor: pose_row(Pose(pose.rotation, pose.translation * made.rig_scale))
                for sensor, pose in members.items()
            }
            for rig, members in known_rigs(
                dataset, {photo.record.sensor_id for photo in placed}
            ).items()
        }
        if made.rig_scale is not None
        else {},
        images=tuple(
            ImageRecord(
                name=photo.name,
                camera=photo.record.sensor_id,
                timestamp=photo.record.timestamp,
                turn=features.turn(photo),
            )
            for photo in placed
        ),
        image_poses=np.array([pose_row(view.cam_from_world) for view in made.views]),
        landmarks=made.landmarks,
        local_fingerprint=FingerprintRecord.of(features.fingerprint),
        computed_with=features.computed_with,
        max_keypoints=features.max_keypoints,
        descriptor_dim=features.descriptor_dim,
        descriptors=observed_descriptors,
        global_features=tuple(
            GlobalFeatures(one.fingerprint, one.descriptors[made.photos], one.model)
            for one in global_features
        ),
        anchor=made.anchor,
        gravity=gravity,
        fusion=settings.fusion,
    )


def _gravity(
    settings: BuildSettings, anchor: Anchor
) -> tuple[tuple[float, float, float] | None, tuple[str, ...]]:
    """The unit vector that points down in the map's world, as far as it is known, and notes."""
    if settings.gravity is None:
        return (None if anchor.geodetic is None else _GEODETIC_DOWN), ()
    if anchor.kind == "none":
        return None, ("the frame is arbitrary, so --gravity says nothing of it and was left out",)
    length = math.hypot(*settings.gravity)
    x, y, z = (value / length for value in settings.gravity)
    return (x, y, z), ()


def _publish(
    settings: BuildSettings,
    content: MapContent,
    made: MadeLandmarks,
    kept: Sequence[MappingPhoto],
    store: MapStore,
    work: WorkFolder,
    scratch: Path,
    workers: Executor,
    progress: Progress,
) -> Path:
    incoming = scratch / "incoming"
    shutil.rmtree(incoming, ignore_errors=True)  # of a build that was killed here
    incoming.mkdir(parents=True)
    try:
        if kept:
            keep_photos(work, incoming, kept, workers, progress)
        with one_step(progress, "archive"):
            if made.pairs is not None:
                write_pairs(incoming / PAIRS, *made.pairs)
            if made.imported is not None:
                made.imported.write(incoming)
            folder = publish_content(store, incoming, content, settings.map_id)
            wrote(sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()))
        return folder
    finally:
        shutil.rmtree(incoming, ignore_errors=True)
