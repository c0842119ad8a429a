"""Maps for other tools: as a COLMAP model, a kapture dataset, or a point cloud."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  Pillow saves PNGs only when it was imported before pycolmap
import pycolmap
from numpy.typing import NDArray

from mapping.maps.colmap_database import (
    DatabasePhoto,
    matches_of_tracks,
    write_colmap_database,
)
from mapping.maps.colmap_queries import match_queries, usable_queries
from mapping.methods.retrieval_only import refuse_without_landmarks
from mapping.stages.imported_points import ImportedPoints, read_imported_points
from mapping.stages.landmarks import Observations, View, reprojection_errors
from mapping.stages.outputs import complete_output
from visloc.archive import ImageRecord, Map
from visloc.archive.gnss import read_fixes
from visloc.errors import refuse
from visloc.geometry import Pose
from visloc.kapture import (
    READY_MADE_PREFIX,
    Dataset,
    FileRecord,
    GnssRecord,
    Reconstruction,
    Sensor,
    write_dataset,
    write_global_features,
    write_keypoints,
    write_local_features,
    write_reconstruction,
)
from visloc.localization.localizer import Localizer
from visloc.pose.reprojection import colmap_camera

_NO_ERROR = -1.0  # COLMAP's word for a point whose error is not known
_IMPORTED = "imported"  # type of the keypoints of the reconstruction that a map came from


@dataclass(frozen=True, slots=True, eq=False)
class Queries:
    """Photos that a COLMAP database gets besides those of the map.

    Attributes:
        localizer: of the map; it finds and matches their features.
    """

    dataset: Dataset
    localizer: Localizer


def export_map(
    opened: Map, output: Path, format_name: str, queries: Queries | None = None
) -> tuple[str, ...]:
    """Write a map for other tools; nothing is left if it fails.

    Coordinates are those of the world, with the map's origin added, and names of photos are those
    of the map. Points keep their order, also those that no photo sees. Photos are not in a map.

    If a map was made from an imported reconstruction whose photos were matched again, the
    reconstruction is exported: its points and their observations, not the landmarks made since.

    Args:
        output: a folder to make, for ``ply`` a file; it must not exist.
        format_name: a key of ``EXPORTERS``: ``colmap`` is a binary model of one rig per camera,
            with ``database.db`` in the schema of COLMAP 3.8;
            ``kapture`` a kapture 1.1 dataset with keypoints, descriptors as the map has them in 8
            bits, points and global descriptors; ``ply`` points in binary, double precision.
        queries: photos to match and to add to the database; for ``colmap`` only.

    Returns:
        Notes on what is not as in the map, one sentence each.
    """
    export = EXPORTERS.get(format_name)
    if export is None:
        raise refuse("export.unknown_format", field="--format", expected=EXPORTERS, got=format_name)
    if queries is not None and (
        format_name != "colmap" or read_imported_points(opened) is not None
    ):
        raise refuse("export.queries", field="--queries", got=f"{format_name} of {opened.ref}")
    if queries is not None and not usable_queries(opened, queries.dataset):
        raise refuse("export.no_queries", field="--queries", got=str(queries.dataset.root))
    refuse_without_landmarks(opened)
    with complete_output(output, "export.exists") as partial:
        notes = export(opened, partial)
        if format_name == "colmap":
            notes += _write_database(opened, partial / "database.db", queries)
        return notes


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """A model to export: the map's landmarks, or the reconstruction that the map was imported from.

    Attributes:
        points: (P, 3) float64 in the world.
        colors: (P, 3) uint8; None without.
        keypoints: of each photo, (k, 2) float32 pixels.
        observations: (M, 3) rows: point, photo, keypoint of that photo.
        errors_px: (P,) mean reprojection error; NaN where no photo sees the point.
        described: whether the keypoints are those that the map has descriptors of.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.uint8] | None
    keypoints: list[NDArray[np.float32]]
    observations: NDArray[np.int64]
    errors_px: NDArray[np.float32]
    described: bool


def _model(opened: Map) -> _Model:
    imported = read_imported_points(opened)
    if imported is not None:
        return _Model(
            points=imported.points,
            colors=imported.colors,
            keypoints=np.split(imported.keypoints, imported.keypoint_offsets[1:-1]),
            observations=imported.observations,
            errors_px=_mean_errors(opened, imported),
            described=False,
        )
    offsets = opened.observation_offsets
    photo = np.repeat(np.arange(len(opened.images)), np.diff(offsets))
    landmark = opened.observation_landmarks.astype(np.int64)
    origin = np.array(opened.manifest.world.origin, np.float64)
    return _Model(
        points=opened.landmarks.astype(np.float64) + origin,
        colors=None if opened.colors is None else np.asarray(opened.colors),
        keypoints=[opened.keypoints(row) for row in range(len(opened.images))],
        observations=np.column_stack([landmark, photo, np.arange(len(photo)) - offsets[photo]]),
        errors_px=np.asarray(opened.errors_px, np.float32),
        described=True,
    )


def _mean_errors(opened: Map, imported: ImportedPoints) -> NDArray[np.float32]:
    views = [
        View(opened.cameras[image.camera], Pose.from_quaternion(pose[:4], pose[4:]))
        for image, pose in zip(opened.images, opened.image_poses, strict=True)
    ]
    points, photos, rows = imported.observations.T
    pixels = imported.keypoints[imported.keypoint_offsets[photos] + rows]
    errors = reprojection_errors(views, imported.points, Observations(points, photos, rows, pixels))
    count = np.bincount(points, minlength=len(imported.points))
    with np.errstate(invalid="ignore"):
        mean = np.bincount(points, errors, len(imported.points)) / count
    return mean.astype(np.float32)


def _export_colmap(opened: Map, output: Path) -> tuple[str, ...]:
    exported = _model(opened)
    model = pycolmap.Reconstruction()
    camera_ids = {name: number for number, name in enumerate(opened.cameras, 1)}
    for name, camera in opened.cameras.items():
        made = colmap_camera(camera)
        made.camera_id = camera_ids[name]
        model.add_camera_with_trivial_rig(made)
    for row, record in enumerate(opened.images):
        image = pycolmap.Image(
            name=record.name,
            keypoints=exported.keypoints[row].astype(np.float64),
            camera_id=camera_ids[record.camera],
            image_id=row + 1,
        )
        pose = opened.image_poses[row]
        rotation = pycolmap.Rotation3d(pose[[1, 2, 3, 0]])  # pycolmap has w last
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, pose[4:]))
    tracks = [pycolmap.Track() for _ in range(len(exported.points))]
    for point, photo, keypoint in exported.observations.tolist():
        tracks[point].add_element(photo + 1, keypoint)
    black = np.zeros((len(tracks), 3), np.uint8)
    colors = black if exported.colors is None else exported.colors
    errors = np.where(np.isfinite(exported.errors_px), exported.errors_px, _NO_ERROR)
    for index, track in enumerate(tracks):
        point_id = model.add_point3D(exported.points[index], track, colors[index])
        model.points3D[point_id].error = float(errors[index])
    output.mkdir()
    model.write_binary(output)
    return ()


def _write_database(opened: Map, path: Path, queries: Queries | None) -> tuple[str, ...]:
    exported = _model(opened)
    is_sift = opened.manifest.local_features.fingerprint.name == "sift" and exported.described
    scale = np.float32(opened.manifest.local_features.descriptor_scale)
    photos = [
        DatabasePhoto(
            *(record.name, record.camera, opened.cameras[record.camera], exported.keypoints[row]),
            opened.observations(row)[1] * scale if is_sift else None,
            Pose.from_quaternion(opened.image_poses[row][:4], opened.image_poses[row][4:]),
        )
        for row, record in enumerate(opened.images)
    ]
    matches, notes = matches_of_tracks(exported.observations), tuple[str, ...]()
    if queries is not None:
        added, theirs, notes = match_queries(opened, queries.localizer, queries.dataset)
        photos, matches = photos + added, matches | theirs
    write_colmap_database(path, photos, opened.cameras, matches)
    if is_sift:
        return notes
    return (*notes, "the database has no descriptors: COLMAP 3.8 has a place for SIFT's only")


def _export_kapture(opened: Map, output: Path) -> tuple[str, ...]:
    exported = _model(opened)
    poses = [Pose.from_quaternion(row[:4], row[4:]) for row in opened.image_poses]
    timestamps = _timestamps(opened.images)
    records = [
        FileRecord(timestamp, image.camera, image.name)
        for timestamp, image in zip(timestamps, opened.images, strict=True)
    ]
    receivers, fixes = _fixes(opened)
    write_dataset(
        Dataset(
            root=output,
            sensors={
                **{name: Sensor.with_camera(name, cam) for name, cam in opened.cameras.items()},
                **receivers,
            },
            rigs=opened.rigs,
            trajectories={
                (record.timestamp, record.sensor_id): pose
                for record, pose in zip(records, poses, strict=True)
            },
            images=tuple(sorted(records, key=lambda r: (r.timestamp, r.sensor_id, r.path))),
            depth_maps=(),
            gnss=fixes,
        )
    )
    local = opened.manifest.local_features.fingerprint.name.removeprefix(READY_MADE_PREFIX)
    keypoints_type = local if exported.described else _IMPORTED
    for row, record in enumerate(opened.images):
        keypoints = exported.keypoints[row]
        if exported.described:
            _, rows = opened.observations(row)
            descriptors = rows * np.float32(opened.manifest.local_features.descriptor_scale)
            write_local_features(output, local, record.name, keypoints, descriptors, name=local)
        else:
            write_keypoints(output, _IMPORTED, record.name, keypoints, name=_IMPORTED)
        for name, vectors in opened.global_descriptors.items():
            kind = name.removeprefix(READY_MADE_PREFIX)
            write_global_features(output, kind, record.name, vectors[row], name=kind)
    write_reconstruction(
        output,
        Reconstruction(
            points=exported.points,
            colors=exported.colors,
            keypoints_type=keypoints_type,
            images=tuple(record.name for record in opened.images),
            observations=exported.observations,
        ),
    )
    later = sum(
        timestamp != image.timestamp
        for timestamp, image in zip(timestamps, opened.images, strict=True)
    )
    if not later:
        return ()
    return (
        f"{later} of {len(timestamps)} photos have a later timestamp than in the map, which has "
        "several of one camera at one time",
    )


def _fixes(opened: Map) -> tuple[dict[str, Sensor], tuple[GnssRecord, ...]]:
    """Return the GNSS receivers of a map and their fixes, as kapture has them."""
    kept = read_fixes(opened.path, opened.manifest.files)
    if kept is None:
        return {}, ()
    taken = {name: f"gnss {name}" if name in opened.cameras else name for name in kept.receivers}
    receivers = {
        taken[name]: Sensor(taken[name], "", "gnss", params, None)
        for name, params in kept.receivers.items()
    }
    records = (
        GnssRecord(fix.timestamp, taken[fix.receiver], fix.x, fix.y, fix.z, fix.utc, fix.dop)
        for fix in kept.fixes
    )
    return receivers, tuple(sorted(records, key=lambda each: (each.timestamp, each.sensor_id)))


def _timestamps(images: Sequence[ImageRecord]) -> list[int]:
    """Return a timestamp per photo; as kapture requires, no camera takes two photos at one time.

    Captures whose clocks began anew come one after the other: the second photo of a camera and time
    is later by more than all photos span, the third by twice that. Photos of a rig stay together.
    """
    times = [image.timestamp for image in images]
    span = max(times) - min(times) + 1
    seen: Counter[tuple[int, str]] = Counter()
    found = []
    for image in images:
        key = image.timestamp, image.camera
        found.append(image.timestamp + seen[key] * span)
        seen[key] += 1
    return found


def _export_ply(opened: Map, output: Path) -> tuple[str, ...]:
    exported = _model(opened)
    # pycolmap writes single precision, which is half a metre at the coordinates of a city.
    columns = [(axis, "<f8") for axis in "xyz"]
    names = ["double x", "double y", "double z"]
    if exported.colors is not None:
        columns += [(channel, "u1") for channel in ("red", "green", "blue")]
        names += ["uchar red", "uchar green", "uchar blue"]
    vertices = np.empty(len(exported.points), dtype=columns)
    for index, axis in enumerate("xyz"):
        vertices[axis] = exported.points[:, index]
    if exported.colors is not None:
        for index, channel in enumerate(("red", "green", "blue")):
            vertices[channel] = exported.colors[:, index]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment map {opened.ref}",
        f"element vertex {len(vertices)}",
        *(f"property {name}" for name in names),
        "end_header\n",
    ]
    output.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes())
    return ()


EXPORTERS: Mapping[str, Callable[[Map, Path], tuple[str, ...]]] = {
    "colmap": _export_colmap,
    "kapture": _export_kapture,
    "ply": _export_ply,
}
