"""Points from verified matches through pycolmap, with known poses or together with them.

The mapper's thresholds are those of table 2 of Humenberger et al. 2020.
"""

from __future__ import annotations

import math
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.colmap
import pycolmap
from numpy.typing import NDArray

from mapping.build.landmarks import (
    Observations,
    View,
    reprojection_errors,
    rows_by_value,
    triangulation_angles,
)
from mapping.frames.anchor import align_poses
from mapping.methods.intrinsics import STEP, Doubt, doubt_of, is_plausible, no_lens
from mapping.methods.matching import Matches
from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.pose.colmap import colmap_camera, pose_from_colmap

T = TypeVar("T")

REFINABLE = ("poses", "points", "intrinsics")
# Scale of the robust loss in bundle adjustment.
_LOSS_SCALE_PX = 1.0
# After so many models that put cameras in doubt, no camera that has a prior is refined any more.
_MAX_JUDGEMENTS = 3


@dataclass(frozen=True, slots=True)
class MapperConfig:
    """Thresholds of a mapper run.

    Attributes:
        min_num_matches: fewest verified matches of a pair.
        init_min_num_inliers: of the first pair, when poses are estimated.
        abs_pose_min_num_inliers: of a photo that joins, when poses are estimated.
        abs_pose_min_inlier_ratio: the same.
        ba_local_max_num_iterations: of bundle adjustment around a photo that joined.
        abs_pose_max_error: pixels, of an inlier of a photo that joins.
        filter_max_reproj_error: pixels; sightings further from their point are dropped, and
            matches further from their epipolar line.
        min_track_length: photos that must see a landmark. Not in the paper. COLMAP drops tracks
            of two photos; with known poses that have verified the match they are worth keeping
            (docs/decisions/0008-two-photos-make-a-landmark.md).
        min_angle_deg: between two rays to a landmark; COLMAP's default.
    """

    min_num_matches: int
    init_min_num_inliers: int
    abs_pose_min_num_inliers: int
    abs_pose_min_inlier_ratio: float
    ba_local_max_num_iterations: int
    abs_pose_max_error: float
    filter_max_reproj_error: float
    min_track_length: int
    min_angle_deg: float


MAPPER_CONFIGS: Mapping[str, MapperConfig] = {
    "config1": MapperConfig(15, 100, 30, 0.25, 25, 12.0, 4.0, 2, 1.5),
    "config2": MapperConfig(4, 4, 4, 0.05, 50, 20.0, 12.0, 2, 1.5),
}


@dataclass(frozen=True, slots=True, eq=False)
class SfmPhoto:
    """What the mapper needs to know of a photo.

    Attributes:
        name: unique.
        sensor: id of its camera.
        timestamp: photos of a rig with equal timestamps were taken together.
        camera: intrinsics, equal for all photos of the sensor.
        camera_known: whether they are more than a guess.
        cam_from_world: pose, when known.
        keypoints: (n, 2) float32.
    """

    name: str
    sensor: str
    timestamp: int
    camera: Camera
    camera_known: bool
    cam_from_world: Pose | None
    keypoints: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class SparseModel:
    """Points with their observations, in photos with poses.

    Attributes:
        views: of each photo that was given; None for those that found no place.
        points: (P, 3) float64.
        observations: of the points; ``views`` are rows of the photos.
        angles_deg: (P,) largest angle between two rays.
        on_rigs: whether known rigs held cameras together; the model then has their unit.
        doubts: by sensor, why refined intrinsics are not believed: those that were known stayed
            as they were, and of the others, photos with a camera that no lens has were left out.
    """

    views: tuple[View | None, ...]
    points: NDArray[np.float64]
    observations: Observations
    angles_deg: NDArray[np.float32]
    on_rigs: bool
    doubts: Mapping[str, Doubt]


def triangulate(
    photos: Sequence[SfmPhoto],
    rigs: Mapping[str, Mapping[str, Pose]],
    matches: Sequence[Matches],
    config: MapperConfig,
    refine: Sequence[str],
    work: Path,
) -> SparseModel:
    """Triangulate points with the poses of the photos.

    Args:
        photos: n photos with poses.
        rigs: cam_from_rig by rig and sensor; used where the poses agree with it.
        matches: verified.
        config: thresholds.
        refine: names of ``REFINABLE``: what bundle adjustment may change afterwards. When it
            changes poses, the result is aligned to the given ones again. Intrinsics in doubt
            (``SparseModel.doubts``) stay.
        work: folder for temporary files.

    Raises:
        InvalidInput: ``sfm.no_points``.
    """
    with _database(photos, rigs, matches, work) as (path, scene):
        options = _pipeline_options(config)

        def solve(held: Collection[str]) -> pycolmap.Reconstruction:
            model = scene.with_poses(photos)

            def run(token: pycolmap.CancellationToken) -> pycolmap.Reconstruction:
                return pycolmap.triangulate_points(
                    model,
                    path,
                    path.parent,
                    path.parent,
                    options=options,
                    cancellation_token=token,
                )

            result = _interruptible(run)
            if refine:
                _refine(result, photos, scene, refine, held)
            return result

        refined = set(scene.cameras) if "intrinsics" in refine else set()
        result, doubts = _believed(solve, scene, photos, refined, poses="poses" in refine)
    return _checked(scene.read(result, photos, refine, doubts), config)


def reconstruct(
    photos: Sequence[SfmPhoto],
    rigs: Mapping[str, Mapping[str, Pose]],
    matches: Sequence[Matches],
    config: MapperConfig,
    refine: Sequence[str],
    work: Path,
    progress: Callable[[int, int], None],
) -> SparseModel:
    """Find poses and points by incremental mapping; the frame and the unit of it are arbitrary.

    Known intrinsics stay as they are unless ``refine`` names them, and those in doubt
    (``SparseModel.doubts``) all the same. Of several models that do not connect the largest is
    taken. ``progress`` is told how many photos were placed, of the model that is being made, and of
    how many.

    Raises:
        InvalidInput: ``sfm.no_model``, ``sfm.camera``, ``sfm.no_points``.
    """
    with _database(photos, rigs, matches, work) as (path, scene):
        known = {photo.sensor for photo in photos if photo.camera_known}
        constant = set() if "intrinsics" in refine else known

        placed = 0

        def first_pair() -> None:
            nonlocal placed
            placed = 2
            tell()

        def one_more() -> None:
            nonlocal placed
            placed += 1
            tell()

        def tell() -> None:
            # Not yet all: what follows the last photo takes long too.
            progress(min(placed, len(photos) - 1), len(photos))

        def solve(doubts: Mapping[str, Doubt]) -> pycolmap.Reconstruction:
            left_out = doubts.keys() - known
            options = _pipeline_options(config)
            options.constant_cameras = {
                scene.camera_ids[sensor] for sensor in constant | (doubts.keys() & known)
            }
            options.image_names = [p.name for p in photos if p.sensor not in left_out]

            def run(token: pycolmap.CancellationToken) -> dict[int, pycolmap.Reconstruction]:
                return pycolmap.incremental_mapping(
                    path,
                    path.parent,
                    path.parent,
                    options=options,
                    initial_image_pair_callback=first_pair,
                    next_image_callback=one_more,
                    cancellation_token=token,
                )

            # No names would mean all photos.
            models = _interruptible(run) if options.image_names else {}
            if models:
                return max(models.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()))
            if left_out:
                raise no_lens({sensor: doubts[sensor] for sensor in left_out}, _names(photos))
            raise refuse(
                "sfm.no_model",
                "no two photos could be placed relative to each other with their known focal length"
                if doubts
                else None,
                field="dataset",
                expected="photos that overlap; see --pairs and --mapper",
                got=f"{len(photos)} photos, {len(matches)} pairs with verified matches",
            )

        result, doubts = _believed(
            solve, scene, photos, scene.cameras.keys() - constant, poses=True
        )
    return _checked(scene.read(result, photos, ("poses", "intrinsics"), doubts), config)


def _believed(
    solve: Callable[[dict[str, Doubt]], pycolmap.Reconstruction],
    scene: _Scene,
    photos: Sequence[SfmPhoto],
    refined: Collection[str],
    *,
    poses: bool,
) -> tuple[pycolmap.Reconstruction, dict[str, Doubt]]:
    """Solve, and solve again without refining the cameras that are in doubt.

    After ``_MAX_JUDGEMENTS`` such rounds all sensors that have a prior stay at it. From then on,
    each round leaves out at least one sensor without a prior. So ``solve`` is called at most
    ``_MAX_JUDGEMENTS`` + 1 times, and once more for each sensor without a prior.

    Args:
        solve: makes a model; of the sensors that it is given, those with a prior stay at it, and
            photos of the others are left out.
        scene: what the model is of.
        photos: the same.
        refined: sensors whose intrinsics ``solve`` refines.
        poses: whether it refines poses too.

    Returns:
        The model, and all doubts. Sensors without a prior that are merely undetermined have theirs,
        and are in the model.
    """
    priors = {p.sensor: p.camera.focal_length if p.camera_known else None for p in photos}
    doubts: dict[str, Doubt] = {}
    judgements = 0
    while True:
        model = solve(doubts)
        used = {model.image(image_id).camera_id for image_id in model.reg_image_ids()}
        free = {
            camera_id: sensor
            for sensor, camera_id in scene.camera_ids.items()
            if sensor in refined and sensor not in doubts and camera_id in used
        }
        if not free:
            return model, doubts
        sound = [camera_id for camera_id in free if is_plausible(model.camera(camera_id))]
        rises = _rises(model, sound, poses=poses)
        found = {
            sensor: doubt
            for camera_id, sensor in free.items()
            if (doubt := doubt_of(model.camera(camera_id), priors[sensor], rises.get(camera_id)))
        }
        again = {
            sensor: doubt
            for sensor, doubt in found.items()
            if priors[sensor] is not None or doubt.reason == "implausible"
        }
        if not again:
            return model, doubts | found
        judgements += 1
        doubts |= again
        if judgements == _MAX_JUDGEMENTS:
            focal = {s: float(model.camera(c).mean_focal_length()) for c, s in free.items()}
            # Those without a photo in this model too: they may have one in the next.
            doubts |= {
                sensor: Doubt("unsettled", focal.get(sensor, math.nan))
                for sensor in refined
                if sensor not in doubts and priors[sensor] is not None
            }


def _rises(
    model: pycolmap.Reconstruction, camera_ids: Collection[int], *, poses: bool
) -> dict[int, float]:
    """By camera, how reprojection errors rise as the focal lengths change and all else adapts.

    All cameras change at once, by ``STEP``: in a scene that determines none of them, each would
    still be determined by the others.

    Returns:
        Pixels, root mean square: of the squared errors, the mean after minus that before.
    """
    before, after = pycolmap.Reconstruction(model), pycolmap.Reconstruction(model)
    others = set(model.cameras) - set(camera_ids)
    with _quiet():
        for copy, step in ((before, 0.0), (after, STEP)):
            for camera_id in camera_ids:
                camera = copy.camera(camera_id)
                for index in camera.focal_length_idxs():
                    camera.params[index] *= 1 + step
            options = _adjustment_options(poses=poses, intrinsics=True)
            options.refine_focal_length = False
            _adjust(copy, options, others, poses=poses)
    errors = _squared_errors(before), _squared_errors(after)
    return {
        camera_id: math.sqrt(max(errors[1].get(camera_id, 0.0) - errors[0].get(camera_id, 0.0), 0))
        for camera_id in camera_ids
    }


def _squared_errors(model: pycolmap.Reconstruction) -> dict[int, float]:
    """By camera, the mean of the squared reprojection errors in its photos."""
    sums: dict[int, NDArray[np.float64]] = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        seen = image.get_observation_points2D()
        if not seen:
            continue
        points = np.array([model.point3D(point.point3D_id).xyz for point in seen])
        pixels = np.array([point.xy for point in seen])
        projected = np.asarray(
            model.camera(image.camera_id).img_from_cam(image.cam_from_world() * points)
        )
        squared = np.sum((projected - pixels) ** 2, axis=1)
        squared = squared[np.isfinite(squared)]
        total = sums.setdefault(image.camera_id, np.zeros(2))
        total += squared.sum(), len(squared)
    return {camera_id: total / count for camera_id, (total, count) in sums.items() if count}


def _names(photos: Sequence[SfmPhoto]) -> dict[str, list[str]]:
    """Names of photos by sensor."""
    names: dict[str, list[str]] = {}
    for photo in photos:
        names.setdefault(photo.sensor, []).append(photo.name)
    return names


class _Scene:
    """The ids that photos, cameras, rigs and frames have in the database."""

    def __init__(
        self, database: pycolmap.Database, photos: Sequence[SfmPhoto], rigs: _Rigs
    ) -> None:
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

    def _write_rigs(self, database: pycolmap.Database, rigs: _Rigs) -> dict[str, pycolmap.Rig]:
        rig_of_sensor = {}
        grouped = {sensor for members in rigs.values() for sensor in members}
        alone: _Rigs = {s: {s: Pose.identity()} for s in self.cameras if s not in grouped}
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
        """The photos at their given poses, without points."""
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
    ) -> SparseModel:
        """The model in our terms; what was not to change is taken from the photos."""
        rows_of_images = {image.image_id: row for row, image in enumerate(self.images)}
        views: list[View | None] = [None] * len(photos)
        for image_id in model.reg_image_ids():
            row = rows_of_images[image_id]
            camera, pose = photos[row].camera, photos[row].cam_from_world
            if "intrinsics" in changed:
                camera = _camera_from_colmap(model.camera(self.camera_ids[photos[row].sensor]))
            if pose is None or "poses" in changed:
                pose = pose_from_colmap(model.image(image_id).cam_from_world())
            views[row] = View(camera, pose)
        points, tracks = [], []
        for number, (_, point) in enumerate(sorted(model.points3D.items())):
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
        return SparseModel(tuple(views), xyz, observations, angles, self.on_rigs, doubts)


_Rigs = Mapping[str, Mapping[str, Pose]]


def _camera_from_colmap(camera: pycolmap.Camera) -> Camera:
    """Return pycolmap's camera as ours."""
    return Camera(
        camera.model_name, camera.width, camera.height, tuple(float(p) for p in camera.params)
    )


@contextmanager
def _database(
    photos: Sequence[SfmPhoto], rigs: _Rigs, matches: Sequence[Matches], work: Path
) -> Iterator[tuple[Path, _Scene]]:
    """A temporary COLMAP database with everything in it."""
    if not matches:
        raise refuse(
            "sfm.no_matches",
            field="dataset",
            got=f"{len(photos)} photos, none of their pairs with enough verified matches",
        )
    work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work) as folder, _quiet():
        path = Path(folder) / "database.db"
        with pycolmap.Database.open(path) as database:
            scene = _Scene(database, photos, _usable_rigs(photos, rigs))
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


def _usable_rigs(photos: Sequence[SfmPhoto], rigs: _Rigs) -> _Rigs:
    """The rigs of which every photo's pose, where known, agrees with its place on the rig.

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


def _pipeline_options(config: MapperConfig) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.num_threads = 1  # sums of several are not the same bits each time
    options.extract_colors = False
    options.min_num_matches = config.min_num_matches
    options.ba_local_max_num_iterations = config.ba_local_max_num_iterations
    options.ba_refine_principal_point = False
    options.ba_refine_sensor_from_rig = False
    options.min_model_size = 2
    mapper, triangulation = options.mapper, options.triangulation
    mapper.random_seed = triangulation.random_seed = 0
    mapper.init_min_num_inliers = config.init_min_num_inliers
    mapper.abs_pose_min_num_inliers = config.abs_pose_min_num_inliers
    mapper.abs_pose_min_inlier_ratio = config.abs_pose_min_inlier_ratio
    mapper.abs_pose_max_error = config.abs_pose_max_error
    mapper.filter_max_reproj_error = config.filter_max_reproj_error
    mapper.filter_min_tri_angle = triangulation.min_angle = config.min_angle_deg
    triangulation.merge_max_reproj_error = config.filter_max_reproj_error
    triangulation.complete_max_reproj_error = config.filter_max_reproj_error
    triangulation.ignore_two_view_tracks = config.min_track_length > 2
    return options


def _refine(
    model: pycolmap.Reconstruction,
    photos: Sequence[SfmPhoto],
    scene: _Scene,
    refine: Sequence[str],
    held: Collection[str],
) -> None:
    """Bundle adjustment of what may change, but not intrinsics of ``held``; points always do."""
    poses = "poses" in refine
    options = _adjustment_options(poses=poses, intrinsics="intrinsics" in refine)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS_SCALE_PX
    with _quiet():
        _adjust(model, options, {scene.camera_ids[sensor] for sensor in held}, poses=poses)
        if "poses" in refine:
            given = [photo.cam_from_world for photo in photos if photo.cam_from_world is not None]
            moved = [
                pose_from_colmap(model.image(image.image_id).cam_from_world())
                for image in scene.images
            ]
            back = align_poses(moved, given)
            if scene.on_rigs:  # they fix the scale
                back = replace(back, scale=1.0)
            model.transform(
                pycolmap.Sim3d(back.scale, pycolmap.Rotation3d(back.rotation), back.translation)
            )


def _adjustment_options(*, poses: bool, intrinsics: bool) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_rig_from_world = poses
    options.refine_sensor_from_rig = False
    options.refine_focal_length = options.refine_extra_params = intrinsics
    options.ceres.solver_options.num_threads = 1  # as the mapper
    return options


def _adjust(
    model: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    constant: Collection[int],
    *,
    poses: bool,
) -> None:
    """Bundle adjustment of a model, without the intrinsics of the cameras ``constant``."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for camera_id in constant:
        config.set_constant_cam_intrinsics(camera_id)
    if poses:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not pycolmap.bundle_adjustment: that prints on stderr whatever it is told.
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    _interruptible(lambda token: adjuster.solve())  # noqa: ARG005  it cannot be cancelled


def _checked(model: SparseModel, config: MapperConfig) -> SparseModel:
    """Drop the points that do not reach the thresholds, after whatever moved them."""
    views = [view or _NOWHERE for view in model.views]
    observations = model.observations
    errors = reprojection_errors(views, model.points, observations)
    observations = _once_per_view(observations, errors, config.filter_max_reproj_error)
    angles = triangulation_angles(views, model.points, observations)
    lengths = np.bincount(observations.points, minlength=len(model.points))
    good = (lengths >= config.min_track_length) & (angles >= config.min_angle_deg)
    if not good.any():
        raise refuse(
            "sfm.no_points",
            field="dataset",
            expected=(
                f"points seen by {config.min_track_length} photos and more, from directions "
                f"{config.min_angle_deg} degrees apart; see --pairs and --mapper"
            ),
            got=f"{len(model.points)} points, none of them good enough",
        )
    number = np.cumsum(good) - 1
    observations = observations.take(good[observations.points])
    return SparseModel(
        model.views,
        model.points[good],
        Observations(
            number[observations.points],
            observations.views,
            observations.rows,
            observations.pixels,
        ),
        angles[good],
        model.on_rigs,
        model.doubts,
    )


def _once_per_view(
    observations: Observations, errors: NDArray[np.float64], max_error: float
) -> Observations:
    """Sightings within the error; of several of one point in one photo the best."""
    order = np.lexsort((errors, observations.views, observations.points))
    order = order[errors[order] <= max_error]
    best = np.ones(len(order), dtype=bool)
    best[1:] = (np.diff(observations.points[order]) != 0) | (
        np.diff(observations.views[order]) != 0
    )
    return observations.take(order[best])


# Stands in for a photo without a place, which observes nothing.
_NOWHERE = View(Camera("SIMPLE_PINHOLE", 1, 1, (1.0, 0.5, 0.5)), Pose.identity())


def _rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation]))


def _interruptible(run: Callable[[pycolmap.CancellationToken], T]) -> T:
    """Run a long call of pycolmap so that Ctrl-C ends it, not only Python's waiting."""
    token = pycolmap.CancellationToken()
    result: list[T] = []
    failed: list[BaseException] = []

    def call() -> None:
        try:
            result.append(run(token))
        except BaseException as error:  # noqa: BLE001  raised again in the caller's thread
            failed.append(error)

    thread = threading.Thread(target=call, name="pycolmap")
    thread.start()
    try:
        while thread.is_alive():
            thread.join(0.2)
    except BaseException:
        token.cancel()
        thread.join()
        raise
    if failed:
        raise failed[0]
    return result[0]


@contextmanager
def _quiet() -> Iterator[None]:
    """Let pycolmap report errors only."""
    before: Any = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 2
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
