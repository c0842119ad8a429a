"""Landmarks from matches: pairs, matches, verification, triangulation.

The mapping strategy for posed photos without depth of Humenberger et al. 2020; with estimated poses
also for photos without poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from mapping.frames.anchor import (
    MAX_SCALE_ERROR,
    about_rows,
    align_positions,
    at_own_scale,
    known_positions,
    scale_margin,
)
from mapping.frames.anchor_error import place_error
from mapping.methods.matching.stages import (
    Matches,
    Verification,
    find_fixed,
    match_pairs,
    matches_among,
    outside_fixed,
)
from mapping.methods.model_stage import believed_pairs, make_model, with_latecomers, without_poses
from mapping.methods.pieces import models_beside
from mapping.methods.scenes import find_pairs, make_scene
from mapping.methods.sfm_settings import SfmSettings
from mapping.methods.sparse.colmap_scene import Rigs
from mapping.methods.sparse.intrinsics import (
    CAMERAS,
    CameraOrigin,
    names_by_sensor,
    notes_on,
    origin_of,
)
from mapping.methods.sparse.model import MAPPER_CONFIGS, SparseModel
from mapping.methods.sparse.pair_agreement import doubts_about_poses
from mapping.progress import one_step
from mapping.stages.camera_mask import CameraMask, where_in_picture
from mapping.stages.context import BuildContext
from mapping.stages.landmarks import MadeLandmarks, View, assemble_landmarks, rows_by_value
from mapping.stages.photos import MappingPhoto, some
from mapping.stages.work_folder import key_of
from visloc.archive import Anchor, GlobalFeatures
from visloc.archive.schema import Doubt
from visloc.errors import InvalidInput
from visloc.geometry import Pose, Similarity
from visloc.kapture import Dataset
from visloc.kapture.matches import open_matches

# Points that move less (rms) between the cameras of a rig may as well be at any distance: as many
# pixels is a match off that is still believed.
_LEAST_PARALLAX_PX = 4.0
# When more of the photos have no place, what is missing may be most of the place.
_MANY_ABSENT = 0.4
UNPLACED = "nothing says where the photos were taken: the frame and unit are arbitrary"
"""The note on a map that has no place in the world, nor rigs that tell its unit."""


def landmarks_from_matches(
    context: BuildContext,
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    global_features: Sequence[GlobalFeatures],
    settings: SfmSettings,
    *,
    metric: bool,
) -> tuple[MadeLandmarks, ...]:
    """Pair, match and verify the photos, and make landmarks of the matches.

    Args:
        metric: whether a unit of the dataset's poses is a metre.

    Returns:
        The landmarks of each piece that photos fall apart into while their poses are estimated, the
        largest first; one piece of photos with poses.
    """
    config = MAPPER_CONFIGS[settings.mapper]
    if settings.matches_dir is not None:
        context = replace(context, matches=open_matches(settings.matches_dir))
    scene = make_scene(dataset, photos, global_features, settings)
    with one_step(context.progress, "pairs"):
        pairs = find_pairs(scene, settings)
    verification = Verification(
        max_error_px=config.filter_max_reproj_error,
        min_matches=config.min_num_matches,
        poses_known=not settings.estimate_poses,
    )
    fixed = find_fixed(context, photos, pairs.rows, verification)
    context = outside_fixed(context, photos, fixed)
    matched = match_pairs(context, photos, pairs.rows, verification)
    rigs = known_rigs(dataset, {photo.record.sensor_id for photo in photos})
    model = make_model(context, photos, rigs, *matched, settings)
    models: list[tuple[SparseModel, tuple[Doubt, ...]]] = [(model, ())]
    notes = _notes_on_fixed(photos, fixed)
    if settings.estimate_poses:
        look = _Look(context, photos, rigs, pairs.rows, verification, settings)
        models, believed = look.models(model, *matched)
        made = [one for one, _ in models]
        notes = (*notes, *_notes_on_absent(photos, made, matched[0], believed))
    placed = (
        (_placed_landmarks(dataset, photos, one, settings, metric=metric, notes=notes), doubts)
        for one, doubts in models
    )
    return tuple(
        replace(
            made,
            pairs=(scene, pairs),
            doubts=(*made.doubts, *doubts),
            fixed=context.features.fixed,
        )
        for made, doubts in placed
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Matched:
    """Photos, matches between them, and what stands for these in the key of a result."""

    photos: Sequence[MappingPhoto]
    matches: Sequence[Matches]
    key: str

    def some(self, rows: Sequence[int]) -> _Matched:
        """Return some of the photos, and the matches between them."""
        return _Matched(
            [self.photos[row] for row in rows],
            matches_among(rows, self.matches),
            key_of("matches_of_some", 1, matches=self.key, photos=list(rows)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """A second look at photos that found no place while poses were estimated."""

    context: BuildContext
    photos: Sequence[MappingPhoto]
    rigs: Rigs
    pairs: NDArray[np.int64]
    verification: Verification
    settings: SfmSettings

    def models(
        self, model: SparseModel, matches: list[Matches], matches_key: str
    ) -> tuple[list[tuple[SparseModel, tuple[Doubt, ...]]], list[Matches]]:
        """Return a model with more of the photos, and models of the photos that it still lacks.

        With what speaks against the poses of each; and the pairs that seem to show one place.

        The cameras that the model found help. When many photos found no place, all are mapped anew.
        Else those without one are placed in the model as it is.
        """
        found = with_found_cameras(self.photos, model)
        begun, of_absent = self.photos, (matches, matches_key)
        if found is not None:
            begun = [replace(p, camera=new.camera) for p, new in zip(begun, found, strict=True)]
            absent = np.array([view is None for view in model.views])
            if model.on_rigs or absent.mean() > _MANY_ABSENT:
                of_absent = match_pairs(self.context, found, self.pairs, self.verification)
                matches, matches_key = of_absent
                with suppress(InvalidInput):  # a second look that finds nothing takes nothing away
                    again = make_model(self.context, begun, self.rigs, *of_absent, self.settings)
                    model = min(again, model, key=lambda each: each.views.count(None))
            else:
                pairs = self.pairs[_with_their_groups(self.pairs, absent)]
                of_absent = match_pairs(self.context, found, pairs, self.verification)
        verified = _Matched(self.photos if found is None else found, *of_absent)
        model = self._with_late(model, verified)
        believed = believed_pairs(self.context, begun, matches, matches_key, self.settings)
        whole = _Matched(begun, believed, matches_key)

        def make(rows: Sequence[int], among: Sequence[Matches]) -> SparseModel:
            part = whole.some(rows)
            piece = make_model(self.context, part.photos, self.rigs, among, part.key, self.settings)
            return self._with_late(piece, verified.some(rows))

        made = (model, *models_beside(model, believed, make))
        given, error = without_poses(self.context, begun), self.verification.max_error_px
        return [(one, doubts_about_poses(one, given, believed, error)) for one in made], believed

    def _with_late(self, model: SparseModel, verified: _Matched) -> SparseModel:
        return with_latecomers(
            self.context, verified.photos, model, verified.matches, verified.key, self.settings
        )


def _with_their_groups(pairs: NDArray[np.int64], absent: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which pairs to verify again: those of photos that are absent.

    With all others of their first photos, as they are matched and kept together.
    """
    firsts = pairs[absent[pairs].any(axis=1), 0]
    return np.isin(pairs[:, 0], firsts)


def with_found_cameras(
    photos: Sequence[MappingPhoto], model: SparseModel
) -> list[MappingPhoto] | None:
    """Return the photos with the cameras that a model found, as known ones.

    Between photos of known cameras, an essential matrix tells true matches from false ones better
    than a fundamental matrix: it has two degrees of freedom less. So photos that found no place may
    find one.

    Returns:
        None when all photos have a place, or lack one because they show another place that looks
        alike, or nothing was learnt of any camera.
    """
    learnt = {
        photo.record.sensor_id: view.camera
        for photo, view in zip(photos, model.views, strict=True)
        if view is not None and not photo.camera_known
    }
    usable = learnt.keys() - model.doubts.keys()
    if not usable or model.undone or None not in model.views:
        return None
    return [
        replace(photo, camera=learnt[sensor], camera_known=True)
        if (sensor := photo.record.sensor_id) in usable
        else photo
        for photo in photos
    ]


def _placed_landmarks(
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    model: SparseModel,
    settings: SfmSettings,
    *,
    metric: bool,
    notes: tuple[str, ...],
) -> MadeLandmarks:
    """Put a model where the photos were taken, and make landmarks of its points.

    ``notes`` come before those on the model's cameras and place.
    """
    used = {p.record.sensor_id for p, view in zip(photos, model.views, strict=True) if view}
    names = names_by_sensor(
        (photo.record.sensor_id, photo.name)
        for photo in photos
        if photo.record.sensor_id in used | model.doubts.keys()
    )
    origins = {
        sensor: origin_of(dataset.sensors[sensor], model.doubts.get(sensor)) for sensor in names
    }
    notes = (*notes, *notes_on(origins, names))
    placed = np.array([row for row, view in enumerate(model.views) if view is not None])
    views = [view for view in model.views if view is not None]
    points = model.points
    rig_scale: float | None = 1.0
    anchor = Anchor(kind="dataset", images=len(photos))
    doubts: tuple[Doubt, ...] = ()
    if settings.estimate_poses:
        parallax_px = _rig_parallax_px(photos, model, known_rigs(dataset, used))
        in_unit_of_rigs = parallax_px >= _LEAST_PARALLAX_PX
        unit_error = 1 / parallax_px if in_unit_of_rigs else None
        similarity, anchor, on_anchor, doubts = _anchored(dataset, photos, model, unit_error)
        notes = (*notes, *on_anchor)
        views = [View(v.camera, similarity.move(v.cam_from_world)) for v in views]
        points = similarity.apply(points)
        # Without rigs in it, the reconstruction had a unit of its own.
        rig_scale = similarity.scale if model.on_rigs else None
        if anchor.kind != "positions" and not in_unit_of_rigs:
            metric = anchor.kind == "gnss"
    number = np.full(len(photos), -1)
    number[placed] = np.arange(len(placed))
    observations = replace(model.observations, views=number[model.observations.views])
    landmarks, rows = assemble_landmarks(views, points, observations, angles_deg=model.angles_deg)
    return MadeLandmarks(
        photos=placed,
        views=tuple(views),
        landmarks=landmarks,
        rows=tuple(rows),
        settings={**settings.record(), **_origins_record(origins, settings)},
        metric=metric,
        anchor=anchor,
        rig_scale=rig_scale,
        notes=notes,
        doubts=doubts,
    )


def _notes_on_fixed(
    photos: Sequence[MappingPhoto], fixed: Mapping[str, CameraMask]
) -> tuple[str, ...]:
    """Return a note for each camera with something fixed to its picture."""
    notes = []
    for sensor, mask in fixed.items():
        names = [photo.name for photo in photos if photo.record.sensor_id == sensor]
        notes.append(
            f"something {where_in_picture(mask)} keeps its pixels while the rest moves (part of a "
            f"vehicle, a logo, dirt on the lens?); about {mask.mean():.0%} of the picture, with "
            f"its edge, was not used, in {len(names)} photos: {some(names)}"
        )
    return tuple(notes)


def _notes_on_absent(
    photos: Sequence[MappingPhoto],
    models: Sequence[SparseModel],
    matches: Sequence[Matches],
    believed: Sequence[Matches],
) -> tuple[str, ...]:
    """Return notes on pairs that were not used, and photos that are in no model."""
    notes = []
    if undone := sum(model.undone for model in models):
        notes.append(
            f"{undone} pairs of photos were not used: places that look alike, or something that "
            "moved, joined them, and photos in the joined model missed what others beside them saw"
        )
    views = zip(*(model.views for model in models), strict=True)
    absent = {row for row, seen in enumerate(views) if not any(seen)}
    if absent:
        names = some([photos[row].name for row in sorted(absent)])
        note = f"{len(absent)} of {len(photos)} photos found no place: {names}"
        theirs, used = (
            sum(not absent.isdisjoint((pair.first, pair.second)) for pair in pairs)
            for pairs in (matches, believed)
        )
        if used < theirs:
            note += (
                f"; {theirs - used} of the {theirs} pairs that match them were not used, as their "
                "photos seem to show places that look alike"
            )
        notes.append(note)
    return tuple(notes)


def _origins_record(
    origins: Mapping[str, CameraOrigin], settings: SfmSettings
) -> dict[str, JsonValue]:
    """Return them for the manifest; nothing when no camera was refined or estimated."""
    if not (settings.estimate_poses or "intrinsics" in settings.refine):
        return {}
    return {CAMERAS: {sensor: one.model_dump() for sensor, one in origins.items()}}


def known_rigs(
    dataset: Dataset, cameras: set[str], scale: float = 1.0
) -> dict[str, dict[str, Pose]]:
    """Return cam_from_rig of cameras, by rig and sensor, where the dataset knows it.

    Distances are multiplied by ``scale``.
    """
    rigs = {
        rig: {
            sensor: Pose(pose.rotation, pose.translation * scale)
            for sensor, pose in members.items()
            if sensor in cameras and pose
        }
        for rig, members in dataset.rigs.items()
    }
    return {rig: members for rig, members in rigs.items() if members}


def _rig_parallax_px(photos: Sequence[MappingPhoto], model: SparseModel, rigs: Rigs) -> float:
    """Return by how far points move (rms) from a photo to one beside it on a rig.

    An error of a pixel in the calibration of the rig changes the unit of a model by about the
    inverse. 0 where rigs hold no cameras apart.
    """
    if not model.on_rigs:
        return 0.0
    rig_of = {sensor: rig for rig, members in rigs.items() for sensor in members}
    beside: dict[tuple[str, int], list[tuple[int, View]]] = {}
    for row, (photo, view) in enumerate(zip(photos, model.views, strict=True)):
        if view is not None and (rig := rig_of.get(photo.record.sensor_id)) is not None:
            beside.setdefault((rig, photo.record.timestamp), []).append((row, view))
    rays = dict(rows_by_value(model.observations.views))
    squares = [np.empty(0)]
    for instant in beside.values():
        for (row, view), (_, other) in permutations(instant, 2):
            own = model.observations.points[rays.get(row, np.empty(0, np.int64))]
            ahead = model.points[own] - view.cam_from_world.center
            across = np.cross(ahead, other.cam_from_world.center - view.cam_from_world.center)
            shift = np.linalg.norm(across, axis=1) / np.sum(ahead**2, axis=1)
            squares.append((view.camera.focal_length * shift) ** 2)
    every = np.concatenate(squares)
    return float(np.sqrt(every.mean())) if len(every) else 0.0


def _anchored(
    dataset: Dataset, photos: Sequence[MappingPhoto], model: SparseModel, unit_error: float | None
) -> tuple[Similarity, Anchor, tuple[str, ...], tuple[Doubt, ...]]:
    """Return where an estimated model lies according to known positions, notes and doubts.

    With ``unit_error``, how far off as a part the model's unit may be, positions move and turn it,
    but its scale stays.
    """
    free = Similarity.identity(), Anchor(kind="none", images=0)
    arbitrary = (
        "the frame and unit are arbitrary" if unit_error is None else "the frame is arbitrary"
    )
    known = known_positions(dataset, photos)
    if known is None:
        return *free, (f"nothing says where the photos were taken: {arbitrary}",), ()
    placed = np.flatnonzero([model.views[row] is not None for row in known.photos])
    views = [view for row in known.photos if (view := model.views[row]) is not None]
    centers = np.array([view.cam_from_world.center for view in views]).reshape(-1, 3)
    positions = known.positions[placed]
    found = align_positions(centers, positions, known.max_error)
    if isinstance(found, str):
        note = (
            f"{len(known.photos)} photos have a known position ({known.anchor.kind}), but {found}: "
            f"{arbitrary}"
        )
        return *free, (note,), ()
    similarity, agrees = found
    off = np.linalg.norm(similarity.apply(centers) - positions, axis=1)
    wrong = [row for row in np.argsort(-off) if not agrees[row]]
    names = some([f"{photos[known.photos[placed[i]]].name} ({off[i]:.3g} off)" for i in wrong])
    unused = f"{len(wrong)} of {len(placed)} known positions ({known.anchor.kind}) contradict the "
    unused += f"others by more than {known.max_error:.3g} and are not used: {names}"
    notes = (unused,) if wrong else ()
    known, moved = about_rows(known, placed[agrees])
    similarity = moved @ similarity
    centers, positions = centers[agrees], known.positions[placed[agrees]]
    doubts: tuple[Doubt, ...] = ()
    if unit_error is not None:
        margin = scale_margin(similarity.apply(centers), positions)
        on_unit, doubts = _on_unit(similarity.scale, margin, unit_error)
        notes = (*notes, *on_unit)
        similarity = at_own_scale(similarity, centers, positions)
    aligned = similarity.apply(centers)
    rms = float(np.sqrt(np.mean(np.sum((aligned - positions) ** 2, axis=1))))
    anchor = known.anchor.model_copy(update={"images": int(agrees.sum()), "rms": rms})
    if anchor.geodetic is not None:  # then the world's axes are east, north and up of it
        error = place_error(anchor.geodetic, aligned, positions, fits_scale=unit_error is None)
        geodetic = anchor.geodetic.model_copy(update={"error": error})
        anchor = anchor.model_copy(update={"geodetic": geodetic})
    return similarity, anchor, notes, doubts


def _on_unit(
    scale: float, margin: float, unit_error: float
) -> tuple[tuple[str, ...], tuple[Doubt, ...]]:
    """Return a note where known positions and rigs differ in their unit, and a doubt if by much.

    ``margin`` is how far off as a part the positions' scale may be, ``unit_error`` that of the rig.
    """
    differs = abs(scale - 1) - scale * margin
    if differs <= MAX_SCALE_ERROR:
        return (), ()
    message = (
        "the distances between the cameras of rigs.txt give the map its unit, but by known "
        f"positions it should be {scale:.4g} times as large (within {MAX_SCALE_ERROR:.0%} of 1 is "
        "expected): correct rigs.txt, the intrinsics or the positions, and build again"
    )
    doubtful = differs > MAX_SCALE_ERROR + unit_error
    return ((), (Doubt(kind="unit", message=message),)) if doubtful else ((message,), ())
