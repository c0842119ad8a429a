"""Maps for other tools: as a COLMAP model, a kapture dataset, or a point cloud."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  Pillow saves PNGs only when it was imported before pycolmap
import pycolmap
from numpy.typing import NDArray

from mapping.outputs import complete_output
from visloc.archive import Map
from visloc.errors import InvalidInput
from visloc.geometry import Pose
from visloc.kapture import (
    Dataset,
    FileRecord,
    Reconstruction,
    Sensor,
    write_dataset,
    write_global_features,
    write_local_features,
    write_reconstruction,
)
from visloc.pose.colmap import colmap_camera

_READY_MADE = "kapture:"  # begins the names of features that came with a dataset
_NO_ERROR = -1.0  # COLMAP's word for a point whose error is not known


def export_map(opened: Map, output: Path, format_name: str) -> None:
    """Write a map for other tools; nothing is left if it fails.

    Coordinates are those of the world, with the map's origin added, and names of photos are those
    of the map. Points keep their order, also those that no photo sees. Photos are not in a map.

    Args:
        opened: the map.
        output: a folder to make, for ``ply`` a file; it must not exist.
        format_name: a key of ``EXPORTERS``: ``colmap`` is a binary model of one rig per camera;
            ``kapture`` a kapture 1.1 dataset with keypoints, descriptors as the map has them in 8
            bits, points and global descriptors; ``ply`` points in binary, double precision.

    Raises:
        InvalidInput: ``export.unknown_format``.
        Conflict: ``export.exists``.
        DatasetError: ``kapture.field`` for a name that kapture cannot hold.
    """
    export = EXPORTERS.get(format_name)
    if export is None:
        raise InvalidInput(
            "export.unknown_format",
            "no such format",
            field="--format",
            expected=f"one of {', '.join(EXPORTERS)}",
            got=format_name,
        )
    with complete_output(output, "export.exists") as partial:
        export(opened, partial)


def _export_colmap(opened: Map, output: Path) -> None:
    model = pycolmap.Reconstruction()
    camera_ids = {name: number for number, name in enumerate(opened.cameras, 1)}
    for name, camera in opened.cameras.items():
        made = colmap_camera(camera)
        made.camera_id = camera_ids[name]
        model.add_camera_with_trivial_rig(made)
    tracks = [pycolmap.Track() for _ in range(len(opened.landmarks))]
    for row, record in enumerate(opened.images):
        image_id = row + 1
        start, stop = opened.observation_offsets[row : row + 2]
        keypoints = opened.observation_keypoints[start:stop].astype(np.float64)
        image = pycolmap.Image(
            name=record.name,
            keypoints=keypoints,
            camera_id=camera_ids[record.camera],
            image_id=image_id,
        )
        pose = opened.image_poses[row]
        rotation = pycolmap.Rotation3d(pose[[1, 2, 3, 0]])  # pycolmap has w last
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, pose[4:]))
        for index, landmark in enumerate(opened.observation_landmarks[start:stop].tolist()):
            tracks[landmark].add_element(image_id, index)
    points, colors = _points(opened), _colors(opened)
    errors = np.where(np.isfinite(opened.errors_px), opened.errors_px, _NO_ERROR)
    for index, track in enumerate(tracks):
        point_id = model.add_point3D(points[index], track, colors[index])
        model.points3D[point_id].error = float(errors[index])
    output.mkdir()
    model.write_binary(output)


def _export_kapture(opened: Map, output: Path) -> None:
    local = opened.manifest.local_features.fingerprint.name.removeprefix(_READY_MADE)
    poses = [Pose.from_quaternion(row[:4], row[4:]) for row in opened.image_poses]
    records = [FileRecord(i.timestamp, i.camera, i.name) for i in opened.images]
    write_dataset(
        Dataset(
            root=output,
            sensors={
                name: Sensor.with_camera(name, camera) for name, camera in opened.cameras.items()
            },
            rigs=opened.rigs,
            trajectories={
                (record.timestamp, record.sensor_id): pose
                for record, pose in zip(records, poses, strict=True)
            },
            images=tuple(sorted(records, key=lambda r: (r.timestamp, r.sensor_id, r.path))),
            depth_maps=(),
            gnss=(),
        )
    )
    offsets = opened.observation_offsets
    for row, record in enumerate(opened.images):
        keypoints = np.asarray(opened.observation_keypoints[offsets[row] : offsets[row + 1]])
        _, descriptors = opened.observations(row)
        write_local_features(output, local, record.name, keypoints, descriptors, name=local)
        for name, vectors in opened.global_descriptors.items():
            kind = name.removeprefix(_READY_MADE)
            write_global_features(output, kind, record.name, vectors[row], name=kind)
    image = np.repeat(np.arange(len(records)), np.diff(offsets))
    write_reconstruction(
        output,
        Reconstruction(
            points=_points(opened),
            colors=None if opened.colors is None else np.asarray(opened.colors),
            keypoints_type=local,
            images=tuple(record.name for record in opened.images),
            observations=np.column_stack(
                [
                    opened.observation_landmarks.astype(np.int64),
                    image,
                    np.arange(len(image)) - offsets[image],
                ]
            ).astype(np.int64),
        ),
    )


def _export_ply(opened: Map, output: Path) -> None:
    # pycolmap writes single precision, which is half a metre at the coordinates of a city.
    columns = [(axis, "<f8") for axis in "xyz"]
    names = ["double x", "double y", "double z"]
    if opened.colors is not None:
        columns += [(channel, "u1") for channel in ("red", "green", "blue")]
        names += ["uchar red", "uchar green", "uchar blue"]
    vertices = np.empty(len(opened.landmarks), dtype=columns)
    points = _points(opened)
    for index, axis in enumerate("xyz"):
        vertices[axis] = points[:, index]
    if opened.colors is not None:
        for index, channel in enumerate(("red", "green", "blue")):
            vertices[channel] = opened.colors[:, index]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment map {opened.ref}",
        f"element vertex {len(vertices)}",
        *(f"property {name}" for name in names),
        "end_header\n",
    ]
    output.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes())


def _points(opened: Map) -> NDArray[np.float64]:
    origin = np.array(opened.manifest.world.origin, np.float64)
    points: NDArray[np.float64] = opened.landmarks.astype(np.float64) + origin
    return points


def _colors(opened: Map) -> NDArray[np.uint8]:
    if opened.colors is None:
        return np.zeros((len(opened.landmarks), 3), np.uint8)
    return np.asarray(opened.colors)


EXPORTERS: Mapping[str, Callable[[Map, Path], None]] = {
    "colmap": _export_colmap,
    "kapture": _export_kapture,
    "ply": _export_ply,
}
