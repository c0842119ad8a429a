"""Reading the ``sensors`` folder of a dataset, kapture 1.0 or 1.1.

Bad data is either tolerated with a note or refused with file and line. Nothing is executed or
guessed, and no path leads out of ``records_data`` except through links in it.
"""

from __future__ import annotations

import os
from collections.abc import Container, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from visloc.geometry import CAMERA_MODELS, MAX_IMAGE_SIDE, Camera, Pose, rotation_angle
from visloc.kapture.dataset import (
    UNKNOWN_CAMERA,
    Dataset,
    FileRecord,
    GnssRecord,
    RecordFiles,
    Sensor,
)
from visloc.kapture.other_sensors import OTHER_FILES, read_other_records
from visloc.kapture.rigs import unroll_rigs
from visloc.kapture.table import Table

_NEWEST_VERSION = (1, 1)
# Two poses of a photo agree to this share of the size of the place, and to as many radians.
_SAME, _ROUNDING = 1e-4, 1e-9
_TABLES = {
    *("sensors.txt", "rigs.txt", "trajectories.txt", "records_camera.txt", "records_depth.txt"),
    *("records_gnss.txt", *OTHER_FILES),
}


def read_dataset(root: Path, files: RecordFiles | None = None) -> Dataset:
    """Read sensors, rigs, trajectories and records of a dataset; lidar records are not read.

    Only ``sensors/sensors.txt`` must exist.

    Args:
        root: the dataset.
        files: where photos and depth maps lie, if not in its ``sensors/records_data``.

    Raises:
        DatasetError: codes ``kapture.*``, ``camera.*`` and ``pose.*``; the field is the file,
            relative to ``root``, with the line.
    """
    notes: list[str] = []
    sensors = _read_sensors(root, notes)
    rigs = _read_rigs(root, sensors, notes)
    trajectories = _read_trajectories(root, sensors.keys() | rigs.keys(), notes)
    images = _read_files(root, "records_camera.txt", "camera", sensors, notes, files)
    depth_maps = _read_files(root, "records_depth.txt", "depth", sensors, notes, files)
    gnss = _read_gnss(root, sensors, notes)
    records = images, depth_maps, gnss
    other = read_other_records(root)
    found = {path.name for path in (root / "sensors").glob("*.txt")}
    notes += [f"sensors/{name} is not read" for name in sorted(found - _TABLES)]
    dataset = Dataset(root, sensors, rigs, trajectories, *records, (), files, other)
    return replace(dataset, notes=(*notes, *_notes_on_rigs(dataset)))


def _notes_on_rigs(dataset: Dataset) -> list[str]:
    """Name the photos whose own pose is not the one that their rig tells."""
    twice = [
        (record.path, own, told)
        for record in dataset.images
        if (own := dataset.trajectories.get((record.timestamp, record.sensor_id))) is not None
        and (told := dataset.pose_by_rig(record)) is not None
    ]
    if not twice:
        return []
    centers = np.array([(own.center, told.center) for _, own, told in twice])
    far = np.linalg.norm(centers[:, 0] - centers[:, 1], axis=1)
    turned = [rotation_angle(own.rotation @ told.rotation.T) for _, own, told in twice]
    off = (far > _SAME * np.ptp(centers, axis=(0, 1)).max() + _ROUNDING) | (
        np.array(turned) > _SAME
    )
    if not off.any():
        return []
    worst = int(np.argmax(far * off))
    return [
        f"{off.sum()} photos have a pose of their own that contradicts that of their rig, which "
        f"was not used: {twice[worst][0]} is {far[worst]:.3g} units from there"
    ]


def _read_sensors(root: Path, notes: list[str]) -> dict[str, Sensor]:
    table = Table(root, "sensors/sensors.txt", None)
    if not table.exists():
        raise table.error("kapture.no_dataset", root=root)
    _check_version(table, notes)
    sensors: dict[str, Sensor] = {}
    for fields in table:
        if len(fields) < 3:
            raise table.error(
                "kapture.column_count",
                expected="sensor_id, name, sensor_type, parameters",
                got=len(fields),
            )
        sensor_id, name, kind, *params = fields
        _refuse_duplicate(table, sensor_id, sensors)
        _refuse_empty(table, sensor_id)
        camera = _parse_camera(table, params) if kind in ("camera", "depth") else None
        sensors[sensor_id] = Sensor(sensor_id, name, kind, tuple(params), camera)
    return sensors


def _check_version(table: Table, notes: list[str]) -> None:
    version = table.version()
    if version is None or not (1, 0) <= version <= _NEWEST_VERSION:
        raise table.error(
            "kapture.version",
            "the first line does not declare a version"
            if version is None
            else "this version of kapture is not supported",
            got=None if version is None else f"{version[0]}.{version[1]}",
        )
    if version == (1, 0):
        notes.append(f"{table.relative}: version 1.0, whose reconstruction folder is not read")


def _parse_camera(table: Table, params: list[str]) -> Camera | None:
    model, *values = params or [""]
    names = () if model == UNKNOWN_CAMERA else CAMERA_MODELS.get(model)
    if names is None:
        raise table.error("camera.model", expected=(UNKNOWN_CAMERA, *CAMERA_MODELS), got=model)
    if len(values) != 2 + len(names):
        raise table.error(
            "camera.param_count",
            expected=f"{2 + len(names)}: {', '.join(('width', 'height', *names))}",
            got=len(values),
            model=model,
        )
    width, height, *numbers = table.numbers(values)
    if not all(0 < side <= MAX_IMAGE_SIDE and side.is_integer() for side in (width, height)):
        raise table.error(
            "camera.size",
            expected=f"1 to {MAX_IMAGE_SIDE} whole pixels",
            got=f"{values[0]} x {values[1]}",
        )
    if model == UNKNOWN_CAMERA:
        return None
    with table.errors_at_row():
        return Camera(model, int(width), int(height), tuple(numbers))


def _read_rigs(
    root: Path, sensors: Mapping[str, Sensor], notes: list[str]
) -> dict[str, dict[str, Pose | None]]:
    table = Table(root, "sensors/rigs.txt", 9)
    if not table.exists():
        return {}
    members: dict[str, dict[str, Pose | None]] = {}
    lines: dict[tuple[str, str], int] = {}
    for rig_id, member_id, *fields in table:
        _refuse_empty(table, rig_id)
        if rig_id in sensors:
            raise table.error("kapture.rig_is_sensor", got=rig_id)
        rig = members.setdefault(rig_id, {})
        _refuse_duplicate(table, member_id, rig)
        rig[member_id] = _parse_pose(table, fields)
        if rig[member_id] is None:
            table.tolerate("transforms are unknown or incomplete", f"{rig_id}, {member_id}")
        lines[rig_id, member_id] = table.line
    # Only now is it known which ids are rigs.
    for (rig_id, member_id), line in lines.items():
        if member_id not in sensors and member_id not in members:
            table.line = line
            table.tolerate("members that sensors.txt does not have were left out", member_id)
            del members[rig_id][member_id]
    notes += table.notes()
    table.line = 0
    return unroll_rigs(members, table)


def _read_trajectories(
    root: Path, devices: Container[str], notes: list[str]
) -> dict[tuple[int, str], Pose]:
    table = Table(root, "sensors/trajectories.txt", 9)
    if not table.exists():
        return {}
    poses: dict[tuple[int, str], Pose | None] = {}
    for timestamp, device_id, *fields in table:
        key = (table.timestamp(timestamp), device_id)
        _refuse_duplicate(table, key, poses)
        pose = _parse_pose(table, fields)
        if device_id not in devices:
            table.tolerate("poses of unknown devices were left out", device_id)
            pose = None
        elif pose is None:
            table.tolerate("poses without rotation or translation were left out", device_id)
        poses[key] = pose
    notes += table.notes()
    return {key: pose for key, pose in poses.items() if pose is not None}


def _parse_pose(table: Table, fields: list[str]) -> Pose | None:
    rotation, translation = (
        table.numbers([field for field in part if field]) for part in (fields[:4], fields[4:])
    )
    if len(rotation) < 4 or len(translation) < 3:
        return None
    with table.errors_at_row():
        return Pose.from_quaternion(rotation, translation)


def _read_files(
    root: Path,
    name: str,
    kind: str,
    sensors: Mapping[str, Sensor],
    notes: list[str],
    files: RecordFiles | None,
) -> tuple[FileRecord, ...]:
    table = Table(root, f"sensors/{name}", 3)
    if not table.exists():
        return ()
    records: dict[tuple[int, str], FileRecord | None] = {}
    paths: set[str] = set()
    data = root / "sensors" / "records_data"
    for timestamp, sensor_id, path_text in table:
        key = (table.timestamp(timestamp), sensor_id)
        _refuse_duplicate(table, key, records)
        path = table.path(path_text, "sensors/records_data")
        if not _is_known(table, sensors, sensor_id, kind):
            records[key] = None
            continue
        if path in paths:
            raise table.error(
                "kapture.duplicate",
                "the path is listed twice",
                expected="every path once",
                got=path,
            )
        paths.add(path)
        records[key] = FileRecord(*key, path)
        # Path.is_file raises for a name that is too long.
        is_there = os.path.isfile(data / path) if files is None else files.has(path)  # noqa: PTH113
        if not is_there:
            table.tolerate("files do not exist", path)
    notes += table.notes()
    return tuple(record for key in sorted(records) if (record := records[key]) is not None)


def _read_gnss(
    root: Path, sensors: Mapping[str, Sensor], notes: list[str]
) -> tuple[GnssRecord, ...]:
    table = Table(root, "sensors/records_gnss.txt", 7)
    if not table.exists():
        return ()
    records: dict[tuple[int, str], GnssRecord | None] = {}
    for timestamp, sensor_id, *fields in table:
        key = (table.timestamp(timestamp), sensor_id)
        _refuse_duplicate(table, key, records)
        fix = GnssRecord(*key, *table.numbers(fields))
        records[key] = fix if _is_known(table, sensors, sensor_id, "gnss") else None
    notes += table.notes()
    return tuple(record for key in sorted(records) if (record := records[key]) is not None)


def _is_known(table: Table, sensors: Mapping[str, Sensor], sensor_id: str, kind: str) -> bool:
    sensor = sensors.get(sensor_id)
    if sensor is None:
        table.tolerate("records of unknown sensors were left out", sensor_id)
    elif sensor.kind != kind:
        table.tolerate(
            f"records of sensors that are not of type {kind} were left out",
            f"{sensor_id} is of type {sensor.kind!r}",
        )
    return sensor is not None and sensor.kind == kind


def _refuse_duplicate(table: Table, key: object, known: Container[object]) -> None:
    if key in known:
        raise table.error(
            "kapture.duplicate",
            expected="every key once",
            got=", ".join(map(str, key)) if isinstance(key, tuple) else key,
        )


def _refuse_empty(table: Table, device_id: str) -> None:
    if not device_id:
        raise table.error("kapture.field", "the id is empty", expected="an id in the first column")
