"""A COLMAP database of photos, rigs and matches, and the way back from a reconstruction."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.colmap_calls import quiet
from mapping.methods.sparse.intrinsics import Doubt
from mapping.methods.sparse.model import SfmPhoto, SparseModel
from mapping.progress import ItemProgress, not_told
from mapping.stages.landmarks import Observations, View, rows_by_value
from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import colmap_camera, pose_from_colmap

Rigs = Mapping[str, Mapping[str, Pose]]
"""cam_from_rig by rig and sensor."""
# Points between two reports of progress: about a tenth of a second of work.
_TOLD_EVERY = 10_000


@contextmanager
def colmap_database(
    photos: Sequence[SfmPhoto], rigs: Rigs, matches: Sequence[Matches], work: Path
) -> Iterator[tuple[Path, ColmapScene]]:
    """Write a temporary COLMAP database; give its path and the ids in it."""
    if not matches:
        raise refuse(
            "sfm.no_matches",
            field="dataset",
            got=f"{len(photos)} photos, none of their pairs with enough verified matches",
        )
    work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work) as folder, quiet():
        path = Path(folder) / "database.db"
        with pycolmap.Database.open(path) as database:
            scene = ColmapScene(database, photos, _usable_rigs(photos, rigs))
            for pair in matches:
                geometry = pycolmap.TwoViewGeometry()
                known = photos[pair.first].camera_known and photos[pair.second].camera_known
                geometry.config = (
                    pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                    if known
                    else pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
                )
                geometry.inlier_matches = pair.rows
                ids = scene.images[pair.first].image_id, scene.images[pair.second].image_id
                database.write_matches(*ids, pair.rows)
                database.write_two_view_geometry(*ids, geometry)
        yield path, scene


def _usable_rigs(photos: Sequence[SfmPhoto], rigs: Rigs) -> Rigs:
    """Return the rigs with which all known poses of their photos agree.

    A sensor in several rigs belongs to none here, as in COLMAP.
    """
    sensors = [sensor for members in rigs.values() for sensor in members]
    usable = {}
    for rig, members in rigs.items():
        rig_from_world: dict[int, Pose] = {}
        fits = len(members) > 1 and all(sensors.count(sensor) == 1 for sensor in members)
        for photo in photos:
            if photo.sensor in members and photo.cam_from_world is not None:
                own = members[photo.sensor].inverse() @ photo.cam_from_world
                other = rig_from_world.setdefault(photo.timestamp, own)
                fits &= bool(
                    np.allclose(own.rotation, other.rotation, atol=1e-9)
                    and np.allclose(own.translation, other.translation, rtol=1e-9, atol=1e-9)
                )
        if fits:
            present = {photo.sensor for photo in photos}
            usable[rig] = {sensor: pose for sensor, pose in members.items() if sensor in present}
    return {rig: members for rig, members in usable.items() if members}


class ColmapScene:
    """The photos, cameras, rigs and frames of a database, with their ids."""

    def __init__(self, database: pycolmap.Database, photos: Sequence[SfmPhoto], rigs: Rigs) -> None:
        self.cameras: dict[str, pycolmap.Camera] = {}
        self.rigs: list[pycolmap.Rig] = []
        self.frames: list[pycolmap.Frame] = []
        for photo in photos:
            if photo.sensor not in self.cameras:
                camera = colmap_camera(photo.camera)
                camera.has_prior_focal_length = photo.camera_known
                camera.camera_id = database.write_camera(camera)
                self.cameras[photo.sensor] = camera
        self.camera_ids = {sensor: c.camera_id for sensor, c in self.cameras.items()}
        rig_of_sensor = self._write_rigs(database, rigs)
        self.images = []
        for photo in photos:
            image = pycolmap.Image(name=photo.name, camera_id=self.camera_ids[photo.sensor])
            image.image_id = database.write_image(image)
            self.images.append(image)
            database.write_keypoints(image.image_id, photo.keypoints)
        groups: dict[tuple[int, int], list[int]] = {}
        for row, photo in enumerate(photos):
            rig = rig_of_sensor[photo.sensor]
            groups.setdefault((rig.rig_id, photo.timestamp), []).append(row)
        self.frame_rows = list(groups.values())
        for (rig_id, _), rows in groups.items():
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            for row in rows:
                frame.add_data_id(self.images[row].data_id)
            frame.frame_id = database.write_frame(frame)
            self.frames.append(frame)
            for row in rows:
                self.images[row].frame_id = frame.frame_id
                database.update_image(self.images[row])

    def _write_rigs(self, database: pycolmap.Database, rigs: Rigs) -> dict[str, pycolmap.Rig]:
        rig_of_sensor = {}
        grouped = {sensor for members in rigs.values() for sensor in members}
        alone: Rigs = {s: {s: Pose.identity()} for s in self.cameras if s not in grouped}
        for members in [*rigs.values(), *alone.values()]:
            rig = pycolmap.Rig()
            (reference, reference_from_rig), *others = members.items()
            rig.add_ref_sensor(self.cameras[reference].sensor_id)
            for sensor, cam_from_rig in others:
                relative = cam_from_rig @ reference_from_rig.inverse()
                rig.add_sensor(self.cameras[sensor].sensor_id, _rigid(relative))
            rig.rig_id = database.write_rig(rig)
            self.rigs.append(rig)
            rig_of_sensor.update(dict.fromkeys(members, rig))
        return rig_of_sensor

    @property
    def on_rigs(self) -> bool:
        """Whether a rig holds several cameras together."""
        return len(self.rigs) < len(self.cameras)

    def with_poses(self, photos: Sequence[SfmPhoto]) -> pycolmap.Reconstruction:
        """Return a model of the photos at their given poses, without points."""
        model = pycolmap.Reconstruction()
        for camera in self.cameras.values():
            model.add_camera(camera)
        for rig in self.rigs:
            model.add_rig(rig)
        for frame, rows in zip(self.frames, self.frame_rows, strict=True):
            model.add_frame(frame)
            for row in rows:
                image = self.images[row]
                placed = pycolmap.Image(
                    name=image.name,
                    image_id=image.image_id,
                    camera_id=image.camera_id,
                    frame_id=image.frame_id,
                )
                placed.points2D = pycolmap.Point2DList(
                    [pycolmap.Point2D(xy) for xy in photos[row].keypoints.astype(np.float64)]
                )
                model.add_image(placed)
            pose = photos[rows[0]].cam_from_world
            assert pose is not None  # the photos come with poses
            camera_id = self.images[rows[0]].camera_id
            model.frame(frame.frame_id).set_cam_from_world(camera_id, _rigid(pose))
            model.register_frame(frame.frame_id)
        return model

    def read(
        self,
        model: pycolmap.Reconstruction,
        photos: Sequence[SfmPhoto],
        changed: Sequence[str],
        doubts: Mapping[str, Doubt],
        progress: ItemProgress = not_told,
    ) -> SparseModel:
        """Return a reconstruction as a model.

        What ``changed`` does not name, ``poses`` or ``intrinsics``, is taken from the photos.
        ``progress`` is in points.
        """
        rows_of_images = {image.image_id: row for row, image in enumerate(self.images)}
        views: list[View | None] = [None] * len(photos)
        for image_id in model.reg_image_ids():
            row = rows_of_images[image_id]
            camera, pose = photos[row].camera, photos[row].cam_from_world
            if "intrinsics" in changed:
                camera = _camera_of(model.camera(self.camera_ids[photos[row].sensor]))
            if pose is None or "poses" in changed:
                pose = pose_from_colmap(model.image(image_id).cam_from_world())
            views[row] = View(camera, pose)
        points, tracks = [], []
        count = model.num_points3D()
        progress(0, count)
        for number, (_, point) in enumerate(sorted(model.points3D.items())):
            if number % _TOLD_EVERY == 0:
                progress(number, count)
            points.append(point.xyz)
            tracks += [
                (number, rows_of_images[element.image_id], element.point2D_idx)
                for element in point.track.elements
            ]
        table = np.array(tracks, dtype=np.int64).reshape(-1, 3)
        pixels = np.empty((len(table), 2), dtype=np.float32)
        for row, own in rows_by_value(table[:, 1]):
            pixels[own] = photos[row].keypoints[table[own, 2]]
        observations = Observations(table[:, 0], table[:, 1], table[:, 2], pixels)
        xyz = np.array(points, dtype=np.float64).reshape(-1, 3)
        angles = np.zeros(len(xyz), np.float32)
        progress(count, count)
        return SparseModel(tuple(views), xyz, observations, angles, self.on_rigs, doubts)


def _camera_of(camera: pycolmap.Camera) -> Camera:
    return Camera(
        camera.model_name, camera.width, camera.height, tuple(float(p) for p in camera.params)
    )


def _rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation]))
