"""The photos of a dataset that a map can be made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from mapping.methods.depth import DepthMatch, DepthMatcher
from visloc.archive import sha256_of
from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.images import Photo, read_photo_file, upright
from visloc.kapture import Dataset, FileRecord
from visloc.localization.query_camera import GUESSED_FOCAL


@dataclass(frozen=True, slots=True, eq=False)
class MappingPhoto:
    """A photo with all that is known of it.

    Attributes:
        record: its name, sensor and timestamp in the dataset.
        path: the file; it exists when ``sha256`` is not None.
        sha256: of the file; of one below a URL, what its storage says instead.
        camera: intrinsics.
        camera_known: whether they are the dataset's; else a guess to start from.
        cam_from_world: pose, when known.
        depth: its depth map, if it has one.
        depth_sha256: of the depth map's file.
    """

    record: FileRecord
    path: Path
    sha256: str | None
    camera: Camera
    camera_known: bool
    cam_from_world: Pose | None
    depth: DepthMatch | None
    depth_sha256: str | None

    @property
    def name(self) -> str:
        """The photo's name in the dataset and in the map."""
        return self.record.path

    @property
    def pose(self) -> Pose:
        """``cam_from_world`` of a photo that was collected with poses."""
        assert self.cam_from_world is not None
        return self.cam_from_world

    def read(self) -> Photo:
        """Decode the file in the frame of its camera, as ``read_in_frame``."""
        size = self.camera.width, self.camera.height
        return read_in_frame(self.path, size, self.record.sensor_id)


def read_in_frame(path: Path, size: tuple[int, int], sensor_id: str) -> Photo:
    """Decode a photo of a dataset in the frame of its camera: the pixels as stored.

    If the camera has the size of the upright picture instead (width and height swapped, EXIF
    orientation 5 to 8), whatever made the dataset turned the pixels when it read them. Camera,
    pose and depth map are then those of the upright picture, and so is what this returns.

    Args:
        path: the file.
        size: width and height of the camera, pixels.
        sensor_id: of the camera, for the error.

    Raises:
        DatasetError: ``dataset.photo_size``.
        VislocError: what ``read_photo_file`` raises.
    """
    photo = read_photo_file(path)
    stored = photo.width, photo.height
    if stored == size:
        return photo
    if photo.is_on_its_side and stored[::-1] == size:
        return replace(photo, rgb=upright(photo.rgb, photo.exif_orientation), exif_orientation=1)
    raise refuse(
        "dataset.photo_size",
        field=str(path),
        expected=f"{size[0]} x {size[1]} as sensors.txt has it for {sensor_id}",
        got=f"{stored[0]} x {stored[1]}",
    )


def collect_photos(
    dataset: Dataset,
    *,
    posed: bool = True,
    with_files: bool = True,
    has_features: Callable[[str], bool] | None = None,
    with_depth: bool = False,
    depth_sensor: str | None = None,
    progress: Callable[[int, int], None],
) -> tuple[list[MappingPhoto], list[str]]:
    """Gather the photos that can be used, and their depth maps.

    Args:
        dataset: the dataset.
        posed: take only photos with intrinsics and a pose; else those without get guessed
            intrinsics (SIMPLE_RADIAL) and stay without a pose.
        with_files: take only photos whose file exists.
        has_features: tells whether a photo, by name, has ready-made features; others are left out.
        with_depth: look for depth maps.
        depth_sensor: the depth sensor to use, when several go with a photo.
        progress: told how many photos are done, and how many there are.

    Returns:
        The photos in the dataset's order, and notes on what was left out.

    Raises:
        DatasetError: ``dataset.no_photos`` when none is left.
    """
    photos: list[MappingPhoto] = []
    left_out: dict[str, list[str]] = {}
    matcher = DepthMatcher(dataset, depth_sensor) if with_depth else None
    for done, record in enumerate(dataset.images, 1):
        path = dataset.path_of(record)
        camera = dataset.sensors[record.sensor_id].camera
        pose = dataset.pose(record)
        if with_files and not dataset.has_file(record):
            left_out.setdefault("are listed, but the file is absent", []).append(record.path)
        elif has_features is not None and not has_features(record.path):
            left_out.setdefault("have no ready-made features", []).append(record.path)
        elif posed and camera is None:
            left_out.setdefault("have a camera of unknown model", []).append(record.path)
        elif posed and pose is None:
            left_out.setdefault("have no pose", []).append(record.path)
        else:
            depth = matcher.match(record) if matcher else None
            if matcher and depth is None:
                left_out.setdefault("have no depth map: retrieval only", []).append(record.path)
            photos.append(
                MappingPhoto(
                    record,
                    path,
                    _checksum(dataset, record) if with_files else None,
                    camera or _guessed_camera(dataset, record),
                    camera is not None,
                    pose,
                    depth,
                    _checksum(dataset, depth.record) if depth else None,
                )
            )
        progress(done, len(dataset.images))
    notes = [
        f"{len(names)} of {len(dataset.images)} photos {why}: {', '.join(names[:3])}"
        + (", ..." if len(names) > 3 else "")
        for why, names in left_out.items()
    ]
    if not photos:
        needed = [
            *(["a file"] if with_files else []),
            *(["ready-made features"] if has_features is not None else []),
            *(["a camera of a known model", "a pose"] if posed else []),
        ]
        raise refuse(
            "dataset.no_photos",
            "no photo of the dataset can be used" + "".join(f"; {note}" for note in notes),
            field=str(dataset.root / "sensors" / "records_camera.txt"),
            expected=f"photos with {', '.join(needed)}",
        )
    return photos, notes


def _guessed_camera(dataset: Dataset, record: FileRecord) -> Camera:
    size = dataset.sensors[record.sensor_id].image_size
    assert size is not None  # every sensor of a photo has one
    width, height = size
    focal = GUESSED_FOCAL * max(width, height)
    return Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, 0.0))


def _checksum(dataset: Dataset, record: FileRecord) -> str:
    path = dataset.path_of(record)
    try:
        return sha256_of(path) if dataset.files is None else dataset.files.identity(record.path)
    except OSError as error:
        raise refuse("dataset.unreadable", field=str(path), got=error.strerror) from error
