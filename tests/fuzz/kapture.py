"""Datasets in kapture's format: sensors, poses, records, features, points."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.fuzz.edits import Edit, EditedFolder, decode, encode
from tests.fuzz.target import holds, refusal
from visloc.errors import InvalidInput
from visloc.geometry import Camera, PixelOrigin, Pose
from visloc.kapture import (
    Dataset,
    FileRecord,
    GnssRecord,
    Reconstruction,
    Sensor,
    feature_types,
    open_features,
    open_local_features,
    read_dataset,
    read_local,
    read_reconstruction,
    write_dataset,
    write_global_features,
    write_local_features,
    write_reconstruction,
)

_PHOTOS = ("a.jpg", "b/b.jpg")


class Kapture:
    """Reads all of a small dataset of which some files are altered."""

    def __init__(self, folder: Path) -> None:
        _write(folder / "dataset")
        self._dataset = EditedFolder(folder / "dataset")
        self._copy = folder / "copy"

    def run(self, data: bytes) -> str:
        """Alter the dataset and read it; what is accepted can be written and read again."""
        _, edits = decode(self._dataset.names, data)
        try:
            list(self._dataset.alter(edits))
            outcomes = [_outcome(read) for read in self._readers_of(edits)]
        finally:
            self._dataset.restore()
        return next((each for each in outcomes if each != "accepted"), "accepted")

    def repair(self, data: bytes) -> bytes:
        """Make the checksums of a tar archive right, where one is replaced."""
        start = data.find(b"ustar") - 257
        if start < 0 or len(data) < start + 512:
            return data
        header = data[start : start + 148] + b" " * 8 + data[start + 156 : start + 512]
        return data[: start + 148] + b"%06o\0 " % sum(header) + data[start + 156 :]

    def seeds(self) -> Iterator[bytes]:
        """Yield every file as it is, its first version and others that are legal, and edits."""
        names, good = self._dataset.names, self._dataset.good
        for name in names:
            yield encode(names, [Edit(name, "content", good[name])])
            yield encode(names, [Edit(name, "patch", b"\x20\0\x31")])
            for kind in ("cut", "missing", "folder", "link", "pipe"):
                yield encode(names, [Edit(name, kind, b"\x10\0")])
        rigs = "rig, cam, 1, 0, 0, 0, 0, 0, 0\nouter, rig, 1, 0, 0, 0, 1, 2, 3\n"
        yield encode(names, [Edit("sensors/rigs.txt", "content", rigs.encode())])
        yield encode(names, [Edit("sensors/rigs.txt", "content", b"r, cam, , , , , , , \n")])
        old = good["sensors/sensors.txt"].replace(b"1.1", b"1.0")
        yield encode(names, [Edit("sensors/sensors.txt", "content", old)])
        coloured = b"# kapture format: 1.1\n1, 2, 3, 255, 0, 0\n4, 5, 6, 0, 0, 0\n"
        yield encode(names, [Edit("reconstruction/points3d.txt", "content", coloured)])

    def _readers_of(self, edits: list[Edit]) -> list[Callable[[], None]]:
        """Return what reads any of the altered files."""
        names = [edit.name.removeprefix("reconstruction/") for edit in edits]
        readers = {
            self._read_sensors: ("sensors/",),
            self._read_points: ("points3d", "observations", "keypoints/"),
            self._read_features: ("keypoints/", "descriptors/", "global_features/"),
        }
        return [
            read for read, prefixes in readers.items() if any(n.startswith(prefixes) for n in names)
        ]

    def _read_sensors(self) -> None:
        dataset = read_dataset(self._dataset.folder)
        with holds("usable"):
            for record in (*dataset.images, *dataset.depth_maps):
                pose = dataset.pose(record)
                assert pose is None or np.isfinite(pose.translation).all()
                dataset.has_file(record)
                dataset.rigs_of(record.sensor_id)
            for sensor in dataset.sensors.values():
                assert sensor.image_size is None or min(sensor.image_size) > 0
        (self._copy / "sensors").mkdir(parents=True, exist_ok=True)
        for file in (self._copy / "sensors").iterdir():
            file.unlink()
        write_dataset(replace(dataset, root=self._copy))
        with holds("the same when it is written and read"):
            again = read_dataset(self._copy)
            assert again.images == dataset.images
            assert again.depth_maps == dataset.depth_maps
            assert again.gnss == dataset.gnss
            assert again.sensors.keys() == dataset.sensors.keys()
            empty = {rig for rig, members in dataset.rigs.items() if not members}  # not written
            poses = {k: pose for k, pose in dataset.trajectories.items() if k[1] not in empty}
            assert again.trajectories.keys() == poses.keys()
            for key, pose in poses.items():
                np.testing.assert_allclose(
                    again.trajectories[key].rotation, pose.rotation, atol=1e-12
                )
                assert (again.trajectories[key].translation == pose.translation).all()

    def _read_points(self) -> None:
        found = read_reconstruction(self._dataset.folder)
        if found is None:
            return
        with holds("usable"):
            assert np.isfinite(found.points).all()
            assert found.points.shape == (len(found.points), 3)
            limits = (len(found.points), len(found.images), 2**31)
            assert ((found.observations >= 0) & (found.observations < limits)).all()

    def _read_features(self) -> None:
        root = self._dataset.folder
        for kind in ("keypoints", "descriptors", "global_features"):
            feature_types(root, kind)
        keypoints, descriptors = open_local_features(root, "sift")
        vectors = open_features(root, "global_features", "vlad")
        for photo in _PHOTOS:
            xy, rows = read_local(keypoints, descriptors, photo, (64, 48), PixelOrigin.CENTER)
            with holds("usable"):
                assert np.isfinite(xy).all()
                assert len(xy) == len(rows) == keypoints.count(photo)
            if vectors.has(photo):
                assert vectors.read(photo).shape == (1, vectors.dsize)


def _outcome(read: Callable[[], None]) -> str:
    try:
        read()
    except InvalidInput as error:
        return refusal(error, "kapture.", "camera.", "pose.")
    return "accepted"


def _write(root: Path) -> None:
    """Write a dataset of two photos with everything that a dataset can have."""
    pose = Pose.from_quaternion([0.6, 0.8, 0.0, 0.0], [1.0, 2.0, 3.0])
    camera = Camera("OPENCV", 64, 48, (50.0, 50.0, 32.0, 24.0, 0.1, 0.0, 0.0, 0.0))
    write_dataset(
        Dataset(
            root,
            sensors={
                "cam": Sensor.with_camera("cam", camera),
                "depth": Sensor.with_camera(
                    "depth", Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0)), "depth"
                ),
                "unknown": Sensor("unknown", "n", "camera", ("UNKNOWN_CAMERA", "64", "48"), None),
                "gps": Sensor("gps", "", "gnss", ("EPSG:4326",), None),
            },
            rigs={"rig": {"cam": pose, "depth": None}},
            trajectories={(0, "rig"): pose, (1, "cam"): pose},
            images=(FileRecord(0, "cam", _PHOTOS[0]), FileRecord(1, "cam", _PHOTOS[1])),
            depth_maps=(FileRecord(0, "depth", "a.depth"),),
            gnss=(GnssRecord(0, "gps", 5.8, 45.2, 300.0, 1.0, 2.0),),
        )
    )
    rng = np.random.default_rng(0)
    for photo in _PHOTOS:
        keypoints = rng.uniform(0, 48, (3, 2)).astype(np.float32)
        write_local_features(root, "sift", photo, keypoints, np.ones((3, 4), np.uint8), name="SIFT")
        write_global_features(root, "vlad", photo, np.ones(3, np.float32), name="VLAD")
    write_reconstruction(
        root,
        Reconstruction(
            rng.normal(size=(2, 3)),
            None,
            "sift",
            _PHOTOS,
            np.array([[0, 0, 0], [0, 1, 2], [1, 0, 1]]),
        ),
    )
    # One kind in the variant with a tar.
    folder = root / "reconstruction" / "descriptors" / "sift"
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        for path in sorted(folder.rglob("*.desc")):
            tar.add(path, path.relative_to(folder).as_posix())
            path.unlink()
    (folder / "descriptors.tar").write_bytes(archive.getvalue())
