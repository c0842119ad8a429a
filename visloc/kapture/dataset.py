"""A kapture dataset in memory: sensors, poses and records, without pixels."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from visloc.geometry import Camera, PixelOrigin, Pose
from visloc.kapture.other_sensors import OtherRecords

UNKNOWN_CAMERA = "UNKNOWN_CAMERA"


@dataclass(frozen=True, slots=True)
class Sensor:
    """One line of ``sensors.txt``.

    Attributes:
        id: any text; do not use it as a file name.
        name: for people; may be empty.
        kind: "camera", "depth", "gnss" or any other word.
        params: the parameters as in the file; for a camera: model, width, height, ...
        camera: intrinsics of a camera or depth sensor; None for UNKNOWN_CAMERA and other kinds.
    """

    id: str
    name: str
    kind: str
    params: tuple[str, ...]
    camera: Camera | None

    @staticmethod
    def with_camera(sensor_id: str, camera: Camera, kind: str = "camera", name: str = "") -> Sensor:
        values = (_shortest(value) for value in camera.params)
        params = (camera.model, str(camera.width), str(camera.height), *values)
        return Sensor(sensor_id, name, kind, params, camera)

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) in pixels, also for UNKNOWN_CAMERA; None for other kinds."""
        if self.camera is not None:
            return self.camera.width, self.camera.height
        if self.kind in ("camera", "depth") and self.params[:1] == (UNKNOWN_CAMERA,):
            return int(float(self.params[1])), int(float(self.params[2]))  # 640.0 is legal
        return None


@dataclass(frozen=True, slots=True)
class FileRecord:
    """A photo or depth map.

    Attributes:
        timestamp: in the dataset's own unit.
        path: relative to ``sensors/records_data``, with forward slashes; its identity.
    """

    timestamp: int
    sensor_id: str
    path: str


@dataclass(frozen=True, slots=True)
class GnssRecord:
    """A GNSS fix.

    Attributes:
        timestamp: in the dataset's own unit.
        sensor_id: the receiver; its parameter names the coordinate system, EPSG:4326 by default.
        x: longitude in degrees for EPSG:4326, otherwise easting.
        y: latitude in degrees for EPSG:4326, otherwise northing.
        z: altitude in metres.
        utc: Unix time in seconds, 0 when unknown.
        dop: dilution of precision, 0 when unknown.
    """

    timestamp: int
    sensor_id: str
    x: float
    y: float
    z: float
    utc: float
    dop: float


class RecordFiles(Protocol):
    """Finds files of records outside their dataset by name."""

    def path_of(self, name: str) -> Path: ...

    def has(self, name: str) -> bool: ...

    def identity(self, name: str) -> str:
        """Return a text that changes when the content does."""

    def without_listing(self) -> RecordFiles:
        """Return the same places without the list of files."""


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """The ``sensors`` folder of a kapture dataset.

    Attributes:
        root: the folder that holds ``sensors``.
        sensors: by id.
        rigs: rig id -> sensor id -> ``sensor_from_rig``, None if unknown; nested rigs are unrolled.
        trajectories: (timestamp, sensor or rig id) -> ``device_from_world``.
        images: sorted by (timestamp, sensor_id, path).
        depth_maps: sorted the same way.
        gnss: sorted by (timestamp, sensor_id).
        notes: bad rows that were tolerated, one sentence each, with file and count.
        files: where photos and depth maps lie, if not in ``sensors/records_data``.
        other_records: of sensors that nothing here uses, by a name in
            ``visloc.kapture.other_sensors.OTHER_FILES``.
    """

    root: Path
    sensors: Mapping[str, Sensor]
    rigs: Mapping[str, Mapping[str, Pose | None]]
    trajectories: Mapping[tuple[int, str], Pose]
    images: tuple[FileRecord, ...]
    depth_maps: tuple[FileRecord, ...]
    gnss: tuple[GnssRecord, ...]
    notes: tuple[str, ...] = ()
    files: RecordFiles | None = None
    other_records: Mapping[str, OtherRecords] = field(default_factory=dict)
    _rigs_of_sensor: Mapping[str, list[str]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rigs_of_sensor: dict[str, list[str]] = {}
        for rig_id, members in self.rigs.items():
            for sensor_id in members:
                rigs_of_sensor.setdefault(sensor_id, []).append(rig_id)
        object.__setattr__(self, "_rigs_of_sensor", rigs_of_sensor)

    def pose(self, record: FileRecord) -> Pose | None:
        """Return ``sensor_from_world`` of a record; None when unknown.

        The sensor's own trajectory has priority over those of its rigs.
        """
        own = self.trajectories.get((record.timestamp, record.sensor_id))
        return self.pose_by_rig(record) if own is None else own

    def pose_by_rig(self, record: FileRecord) -> Pose | None:
        """Return ``sensor_from_world`` by the first of the sensor's rigs that has a pose."""
        for rig_id in self._rigs_of_sensor.get(record.sensor_id, ()):
            sensor_from_rig = self.rigs[rig_id][record.sensor_id]
            rig_from_world = self.trajectories.get((record.timestamp, rig_id))
            if sensor_from_rig is not None and rig_from_world is not None:
                return sensor_from_rig @ rig_from_world
        return None

    def rigs_of(self, sensor_id: str) -> tuple[str, ...]:
        """Return the ids of the rigs that carry a sensor, in the dataset's order."""
        return tuple(self._rigs_of_sensor.get(sensor_id, ()))

    def path_of(self, record: FileRecord) -> Path:
        """Return where the record's file should lie; it may be missing."""
        if self.files is not None:
            return self.files.path_of(record.path)
        return self.root / "sensors" / "records_data" / record.path

    def without_records(self) -> Dataset:
        """Return a dataset that only finds files, small enough to send to other processes."""
        files = None if self.files is None else self.files.without_listing()
        return replace(
            self,
            trajectories={},
            images=(),
            depth_maps=(),
            gnss=(),
            notes=(),
            files=files,
            other_records={},
        )

    def with_pixels_from(self, origin: PixelOrigin) -> Dataset:
        """Return this dataset in our pixel convention, given that of its calibrations."""
        sensors = {
            key: sensor
            if sensor.camera is None
            else Sensor.with_camera(
                key, sensor.camera.with_pixels_from(origin), sensor.kind, sensor.name
            )
            for key, sensor in self.sensors.items()
        }
        return replace(self, sensors=sensors)

    def has_file(self, record: FileRecord) -> bool:
        if self.files is not None:
            return self.files.has(record.path)
        # Path.is_file raises for names that are longer than a file's name can be.
        return os.path.isfile(self.path_of(record))  # noqa: PTH113


def _shortest(value: float) -> str:
    # kapture's own tools write whole numbers without a point; repr keeps all other digits.
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(float(value))
