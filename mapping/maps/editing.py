"""Maps as values: read as content, cut, moved and joined, to be written as another version."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from visloc.archive import (
    Anchor,
    GlobalFeatures,
    Landmarks,
    Map,
    MapContent,
    pose_row,
)
from visloc.archive.checks import read_record
from visloc.archive.content import PoseRow
from visloc.archive.gnss import read_fixes
from visloc.archive.npz import read_npz
from visloc.archive.schema import CamerasFile
from visloc.errors import refuse
from visloc.geometry import Camera, Pose, Similarity
from visloc.retrieval.index import IndexKind

# Names that an error lists.
_NAMED = 3


def content_of(opened: Map) -> MapContent:
    """Return a map as content that, when written, gives the same bytes.

    Large arrays stay memory-mapped, so the map's files must exist as long as the content is used;
    keypoints are converted to float32. Files beside the arrays (photos, pairs, imported points) are
    not part of the content.
    """
    manifest = opened.manifest
    local, scale = manifest.local_features, manifest.local_features.descriptor_scale
    images = range(len(opened.images))

    def descriptors() -> Iterator[NDArray[np.float32]]:
        for image in images:
            yield opened.observations(image)[1].astype(np.float32) * np.float32(scale)

    return MapContent(
        metric=manifest.world.metric,
        method=manifest.method.name,
        settings=manifest.method.settings,
        notes=manifest.notes,
        cameras=opened.cameras,
        rigs=read_record(opened.path, "cameras.json", CamerasFile).rigs,
        images=opened.images,
        image_poses=opened.image_poses,
        landmarks=Landmarks(
            origin=np.array(manifest.world.origin),
            points=opened.landmarks,
            track_lengths=opened.track_lengths,
            errors_px=opened.errors_px.astype(np.float32),
            angles_deg=opened.angles_deg.astype(np.float32),
            offsets=opened.observation_offsets,
            observed=opened.observation_landmarks,
            keypoints=np.concatenate([opened.keypoints(image) for image in images]),
            colors=opened.colors,
        ),
        local_fingerprint=local.fingerprint,
        max_keypoints=local.max_keypoints,
        descriptor_dim=local.descriptor_dim,
        descriptors=descriptors,
        global_features=tuple(
            GlobalFeatures(
                record.fingerprint,
                opened.global_descriptors[record.fingerprint.name][:],
                # Taken as stored, because converting would not give back all of its scales exactly.
                read_npz(opened.path / f"global/{record.fingerprint.file_stem}.model.npz"),
            )
            for record in manifest.global_features
        ),
        anchor=manifest.world.anchor,
        gravity=manifest.world.gravity,
        computed_with=local.computed_with,
        fusion=opened.fusion,
        descriptor_scale=scale,
        own_test=manifest.parts.own_test,
        index=IndexKind.IVF if opened.has_index else IndexKind.AUTO,
        fixes=read_fixes(opened.path, opened.manifest.files),
    )


def selected(
    content: MapContent,
    images: NDArray[np.bool_] | None = None,
    landmarks: NDArray[np.bool_] | None = None,
    observations: NDArray[np.bool_] | None = None,
) -> MapContent:
    """Return a part of a map.

    Observations of what is dropped go too, and so do landmarks that no photo observes any more.
    Cameras and rigs stay, since queries may come from any of them.

    Args:
        images: (n,) photos to keep; None for all.
        landmarks: (P,) landmarks to keep; None for all.
        observations: (M,) observations to keep; None for all.
    """
    old = content.landmarks
    counts = np.diff(old.offsets)
    kept_images = np.ones(len(counts), np.bool_) if images is None else images
    kept = np.repeat(kept_images, counts)
    if landmarks is not None:
        kept &= landmarks[old.observed]
    if observations is not None:
        kept &= observations
    seen = np.bincount(old.observed[kept], minlength=len(old.points))
    stay = seen > 0
    row_of = np.cumsum(stay) - 1
    kept_by_image = np.array([int(kept[a:b].sum()) for a, b in pairwise(old.offsets.tolist())])
    rows = np.flatnonzero(kept_images)

    def descriptors() -> Iterator[NDArray[np.float32]]:
        bounds = pairwise(old.offsets.tolist())
        for use, (start, stop), block in zip(
            kept_images, bounds, content.descriptors(), strict=True
        ):
            if use:
                yield block[kept[start:stop]]

    return replace(
        content,
        images=tuple(content.images[row] for row in rows),
        image_poses=content.image_poses[rows],
        landmarks=Landmarks(
            origin=old.origin,
            points=old.points[stay],
            track_lengths=np.minimum(seen[stay], 65535).astype(np.uint16),
            errors_px=old.errors_px[stay],
            angles_deg=old.angles_deg[stay],
            offsets=np.concatenate([[0], np.cumsum(kept_by_image[rows])]).astype(np.int64),
            observed=row_of[old.observed[kept]].astype(np.uint32),
            keypoints=old.keypoints[kept],
            colors=None if old.colors is None else old.colors[stay],
        ),
        descriptors=descriptors,
        global_features=tuple(
            replace(one, descriptors=one.descriptors[rows]) for one in content.global_features
        ),
    )


def moved(content: MapContent, new_from_old: Similarity, *, metric: bool) -> MapContent:
    """Return a map in another frame.

    Args:
        metric: whether a unit of the other world is a metre.
    """
    old, turn = (
        content.landmarks,
        Similarity(new_from_old.scale, new_from_old.rotation, np.zeros(3)),
    )
    poses = (Pose.from_quaternion(row[:4], row[4:]) for row in content.image_poses)
    settings, voxel_size = content.settings, content.settings.get("voxel_size")
    if isinstance(voxel_size, int | float):  # of landmarks by depth; captures that join keep it
        settings = {**settings, "voxel_size": new_from_old.scale * voxel_size}
    gravity = None if content.gravity is None else turn.rotation @ np.array(content.gravity)
    return replace(
        content,
        metric=metric,
        settings=settings,
        rigs={
            rig: {
                key: (*row[:4], *(new_from_old.scale * np.array(row[4:])).tolist())
                for key, row in members.items()
            }
            for rig, members in content.rigs.items()
        },
        image_poses=np.array([pose_row(new_from_old.move(pose)) for pose in poses]),
        landmarks=replace(
            old,
            origin=new_from_old.apply(old.origin),
            points=turn.apply(old.points.astype(np.float64)).astype(np.float32),
        ),
        anchor=None if content.anchor is None else moved_anchor(content.anchor, new_from_old),
        gravity=None if gravity is None else tuple((gravity / np.linalg.norm(gravity)).tolist()),
    )


def joined(a: MapContent, b: MapContent, same: NDArray[np.int64] | None = None) -> MapContent:
    """Return one map of two that are in one frame and have the same features and global models.

    What ``a`` has stays as it is, row by row, and what ``b`` brings follows. Descriptors of ``b``
    are stored in the steps of ``a``. What a world and a method are called is taken from ``a``.

    Args:
        b: another one.
        same: (P_b,) for each landmark of ``b`` the row of the landmark of ``a`` that it is, or
            -1 if it is none of them; None if all are new.
    """
    refuse_other_features(a, b)
    if bool(len(a.landmarks.points)) != bool(len(b.landmarks.points)):
        raise refuse("merge.landmarks", field="MAP")
    names = {image.name for image in a.images}
    both = [image.name for image in b.images if image.name in names]
    if both:
        raise refuse(
            "merge.photos",
            field="MAP",
            got=", ".join(both[:_NAMED]) + (", ..." if len(both) > _NAMED else ""),
            count=len(both),
        )
    cameras, rigs, camera_of = _joined_cameras(a, b)
    return replace(
        a,
        notes=tuple(dict.fromkeys((*a.notes, *b.notes))),
        cameras=cameras,
        rigs=rigs,
        images=(*a.images, *(replace(i, camera=camera_of[i.camera]) for i in b.images)),
        image_poses=np.concatenate([a.image_poses, b.image_poses]),
        landmarks=_joined_landmarks(a.landmarks, b.landmarks, same),
        max_keypoints=max(a.max_keypoints, b.max_keypoints),
        fixes=a.fixes.joined(b.fixes) if a.fixes and b.fixes else a.fixes or b.fixes,
        descriptors=lambda: _chained(a, b),
        global_features=tuple(
            _joined_rows(one, other)
            for one, other in zip(a.global_features, b.global_features, strict=True)
        ),
    )


def refuse_other_features(a: MapContent, b: MapContent) -> None:
    """Raise Conflict ``merge.features`` unless two maps have the same local features."""
    if a.local_fingerprint != b.local_fingerprint:
        raise refuse(
            "merge.features",
            field="MAP",
            expected=a.local_fingerprint.model_dump_json(),
            got=b.local_fingerprint.model_dump_json(),
        )


def same_model(one: GlobalFeatures, other: GlobalFeatures) -> bool:
    """Tell whether two global descriptors are comparable: made alike, and with the same model."""
    return (
        one.fingerprint == other.fingerprint
        and one.model.keys() == other.model.keys()
        and all(np.array_equal(array, other.model[name]) for name, array in one.model.items())
    )


def _chained(a: MapContent, b: MapContent) -> Iterator[NDArray[np.float32]]:
    yield from a.descriptors()
    yield from b.descriptors()


def _joined_rows(one: GlobalFeatures, other: GlobalFeatures) -> GlobalFeatures:
    if not same_model(one, other):
        raise AssertionError(f"{one.fingerprint.name}: describe the photos with one model first")
    return replace(one, descriptors=np.concatenate([one.descriptors, other.descriptors]))


def _joined_landmarks(a: Landmarks, b: Landmarks, same: NDArray[np.int64] | None) -> Landmarks:
    count = len(a.points)
    known = np.full(len(b.points), -1) if same is None else same
    new = known < 0
    row_of = np.where(new, count + np.cumsum(new) - 1, known)
    if len(b.points):
        observed = row_of[b.observed]
        again = np.bincount(observed[observed < count], minlength=count)
    else:  # without landmarks, observations name themselves
        observed, again = len(a.observed) + b.observed.astype(np.int64), np.zeros(count, np.int64)
    lengths = np.minimum(a.track_lengths + again, 65535).astype(np.uint16)
    points = (b.points[new] + (b.origin - a.origin)).astype(np.float32)
    # Colours of some landmarks alone are none of the map.
    colors = (
        None if a.colors is None or b.colors is None else np.concatenate([a.colors, b.colors[new]])
    )
    return Landmarks(
        origin=a.origin,
        points=np.concatenate([a.points, points]),
        track_lengths=np.concatenate([lengths, b.track_lengths[new]]),
        errors_px=np.concatenate([a.errors_px, b.errors_px[new]]),
        angles_deg=np.concatenate([a.angles_deg, b.angles_deg[new]]),
        offsets=np.concatenate([a.offsets, a.offsets[-1] + b.offsets[1:]]),
        observed=np.concatenate([a.observed, observed.astype(np.uint32)]),
        keypoints=np.concatenate([a.keypoints, b.keypoints]),
        colors=colors,
    )


def _joined_cameras(
    a: MapContent, b: MapContent
) -> tuple[dict[str, Camera], dict[str, Mapping[str, PoseRow]], dict[str, str]]:
    """The cameras and rigs of both, and what those cameras of ``b`` are called there.

    Those of one name and other values are two: the second gets a number behind its name.
    """
    cameras, rigs = dict(a.cameras), dict(a.rigs)
    camera_of = {}
    for name, camera in b.cameras.items():
        camera_of[name] = _free_name(name, camera, cameras)
        cameras[camera_of[name]] = camera
    for name, members in b.rigs.items():
        # A rig may have sensors that are no cameras.
        renamed = {camera_of.get(key, key): row for key, row in members.items()}
        rigs[_free_name(name, renamed, rigs)] = renamed
    return cameras, rigs, camera_of


def _free_name(name: str, value: object, taken: Mapping[str, object]) -> str:
    candidate, number = name, 2
    while candidate in taken and taken[candidate] != value:
        candidate, number = f"{name}-{number}", number + 1
    return candidate


def moved_anchor(anchor: Anchor, new_from_old: Similarity) -> Anchor:
    """Return what a world rests on, in another frame of it."""
    geodetic = anchor.geodetic
    if geodetic is not None:
        pose = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation)
        enu_from_old = Similarity(geodetic.scale, pose.rotation, pose.translation)
        enu_from_new = enu_from_old @ new_from_old.inverse()
        row = pose_row(Pose(enu_from_new.rotation, enu_from_new.translation))
        geodetic = geodetic.model_copy(
            update={
                "scale": enu_from_new.scale,
                "rotation_wxyz": row[:4],
                "translation": row[4:],
            }
        )
    rms = None if anchor.rms is None else anchor.rms * new_from_old.scale
    return anchor.model_copy(update={"rms": rms, "geodetic": geodetic})
