"""Checks of settings and datasets before the long work begins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from mapping.cluster.executors import executor_names
from mapping.cluster.storage import is_remote, lies_in, work_place
from mapping.frames.anchor import MAX_DIRECTION_ERROR_DEG, known_positions
from mapping.methods.known_model import refuse_without_points
from mapping.methods.retrieval_only import RETRIEVAL_ONLY
from mapping.methods.rgbd import refuse_without_depth
from mapping.methods.scenes import find_pairs, make_scene
from mapping.methods.sfm_settings import POSES
from mapping.methods.sparse.adjustment import REFINABLE
from mapping.methods.sparse.model import MAPPER_CONFIGS
from mapping.pairing import PAIRINGS
from mapping.pipeline.settings import METHODS, BuildSettings
from mapping.stages.networks import Networks
from mapping.stages.photos import MappingPhoto
from visloc.errors import refuse
from visloc.features.local.readymade import is_ready_made
from visloc.kapture import Dataset
from visloc.options import check_fusion_weights

# Shorter vectors are round-off, not a direction.
_MIN_LENGTH = 1e-6


def check_settings(settings: BuildSettings) -> None:
    """Refuse settings that would fail after hours, or give a useless map."""
    if settings.method not in METHODS:
        raise refuse("build.method", field="--method", expected=METHODS, got=settings.method)
    check_names("--executor", (settings.executor,), executor_names())
    if settings.masks is not None and is_ready_made(settings.local_features):
        raise refuse("masks.ready_made", field="--masks", got=settings.local_features)
    _refuse_mixed_places(settings)
    _refuse_remote_features(settings)
    _check_global_features(settings)
    _check_lengths(settings)
    _check_sfm(settings)
    if settings.keep_colours and settings.method == RETRIEVAL_ONLY:
        raise refuse("build.keep_colours", field="--keep-colours")


def check_names(option: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Refuse unknown names, and names that are given twice."""
    unknown = [name for name in names if name not in known]
    if unknown or len(set(names)) < len(names):
        raise refuse(
            f"build.{option[2:]}",
            "a name is unknown" if unknown else "a name is given twice",
            field=option,
            expected=f"of {', '.join(known)}, each once",
            got=",".join(names),
        )


def _refuse_remote_features(settings: BuildSettings) -> None:
    names = (settings.local_features, *settings.global_features)
    if is_remote(settings.dataset) and (
        settings.method == "model" or any(is_ready_made(name) for name in names)
    ):
        raise refuse("build.dataset", field="dataset", got=str(settings.dataset))


def _refuse_mixed_places(settings: BuildSettings) -> None:
    if settings.work_dir is None:
        return
    # The folder for finished work is removed when the map is published.
    root = work_place(settings.work_dir, settings.map_id)
    for option, place in (
        ("DATASET", settings.dataset),
        ("--maps-dir", settings.maps_dir),
        ("--cache-dir", settings.cache_dir),
    ):
        if lies_in(root, place) or lies_in(place, root):
            raise refuse(
                "build.work_dir",
                f"finished work would be kept in {root}, which overlaps {option}, and "
                "publishing the map removes it",
                field="--work-dir",
                expected=f"a folder apart from {option}, or without the option",
                got=str(settings.work_dir),
            )


def _check_global_features(settings: BuildSettings) -> None:
    names, weights = settings.global_features, settings.fusion_weights
    if not names or "" in names or len(set(names)) < len(names):
        raise refuse("build.global_features", field="--global-features", got=",".join(names))
    if weights is not None:
        check_fusion_weights(weights, "build.fusion_weights", "--fusion-weights")
        unknown = [name for name in weights if name not in names]
        if unknown:
            raise refuse(
                "build.fusion_weights",
                field="--fusion-weights",
                expected=f"of {', '.join(names)}",
                got=",".join(unknown),
            )
    networks = Networks(settings.weights_dir, settings.inference)
    for name in names:
        if is_ready_made(name):
            continue
        if networks.descriptor(name).needs_image and is_ready_made(settings.local_features):
            raise refuse(
                "build.global_features",
                f"{name} is computed from the photo, which is missing when features are sent "
                "instead",
                field="--global-features",
                expected="kapture:TYPE, or localvlad, with ready-made local features",
                got=name,
            )


def _check_lengths(settings: BuildSettings) -> None:
    for name in ("voxel_size", "depth_scale"):
        value = getattr(settings.depth, name)
        if value is not None and not (math.isfinite(value) and value > 0):
            raise refuse(f"build.{name}", field=f"--{name.replace('_', '-')}", got=value)
    if settings.gravity is not None:
        length = math.hypot(*settings.gravity)
        if not (math.isfinite(length) and length >= _MIN_LENGTH):
            raise refuse(
                "build.gravity",
                field="--gravity",
                got=",".join(f"{value:g}" for value in settings.gravity),
            )


def _check_sfm(settings: BuildSettings) -> None:
    sfm = settings.sfm
    if sfm.poses not in POSES:
        raise refuse(
            "build.poses",
            "the value is unknown",
            field="--poses",
            expected=" or ".join(POSES),
            got=sfm.poses,
        )
    check_names("--pairs", sfm.pairs, tuple(PAIRINGS))
    check_names("--refine", sfm.refine, REFINABLE)
    check_names("--mapper", (sfm.mapper,), tuple(MAPPER_CONFIGS))
    if sfm.estimate_poses and settings.method != "sfm":
        raise refuse(
            "build.poses", field="--poses", got=f"estimate with --method {settings.method}"
        )
    if sfm.estimate_poses and not set(sfm.refine) <= {"intrinsics"}:
        raise refuse("build.refine", field="--refine", got=",".join(sfm.refine))


def refuse_early(settings: BuildSettings, dataset: Dataset, photos: Sequence[MappingPhoto]) -> None:
    """Refuse photos without depth, points, positions or pairs, if that is known already.

    Pairing twice takes seconds; finding features first would take hours.
    """
    if settings.method == "rgbd":
        refuse_without_depth(dataset, photos)
    if settings.method == "model":
        refuse_without_points(dataset)
    if settings.sfm.estimate_poses:
        known = known_positions(dataset, photos)
        if known is not None and known.anchor.geodetic is not None:
            _refuse_gravity_that_is_not_down(settings)
    if settings.sfm.matches_dir is not None and not is_ready_made(settings.local_features):
        raise refuse("sfm.matches", field="--matches-dir", got=settings.local_features)
    if settings.method == "sfm":
        others = tuple(name for name in settings.sfm.pairs if name != "retrieval")
        if others or settings.sfm.pairs_file is not None or settings.sfm.matches_dir is not None:
            pairing = replace(settings.sfm, pairs=others)
            find_pairs(make_scene(dataset, photos, (), pairing), pairing)


def _refuse_gravity_that_is_not_down(settings: BuildSettings) -> None:
    """Refuse gravity that contradicts a world whose axes point east, north and up.

    A small angle is accepted: the axes of such a map are only as good as its fixes.
    """
    if settings.gravity is None:
        return
    x, y, z = settings.gravity
    angle_deg = math.degrees(math.atan2(math.hypot(x, y), -z))
    if angle_deg > MAX_DIRECTION_ERROR_DEG:
        raise refuse(
            "build.gravity",
            "the map is anchored to GNSS fixes, its axes point east, north and up, and "
            "this is not down; leave the option out",
            field="--gravity",
            expected=f"0,0,-1 to within {MAX_DIRECTION_ERROR_DEG:g} degrees",
            got=f"{x:g},{y:g},{z:g}, {angle_deg:.1f} degrees off",
        )
