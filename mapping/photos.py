"""The photos of a dataset that a map can be made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mapping.depth import DepthMatch, DepthMatcher
from visloc.archive import sha256_of
from visloc.errors import DatasetError
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord


@dataclass(frozen=True, slots=True, eq=False)
class MappingPhoto:
    """A photo with all that is known of it.

    Attributes:
        record: its name, sensor and timestamp in the dataset.
        path: the file.
        sha256: of the file.
        camera: intrinsics.
        cam_from_world: pose.
        depth: its depth map, if it has one.
        depth_sha256: of the depth map's file.
    """

    record: FileRecord
    path: Path
    sha256: str
    camera: Camera
    cam_from_world: Pose
    depth: DepthMatch | None
    depth_sha256: str | None

    @property
    def name(self) -> str:
        """The photo's name in the dataset and in the map."""
        return self.record.path


def collect_photos(
    dataset: Dataset,
    *,
    with_depth: bool,
    depth_sensor: str | None,
    progress: Callable[[int, int], None],
) -> tuple[list[MappingPhoto], list[str]]:
    """Gather the photos that have a file, intrinsics and a pose, and their depth maps.

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
        if not dataset.has_file(record):
            left_out.setdefault("are listed, but the file is absent", []).append(record.path)
        elif camera is None:
            left_out.setdefault("have a camera of unknown model", []).append(record.path)
        elif pose is None:
            left_out.setdefault("have no pose", []).append(record.path)
        else:
            depth = matcher.match(record) if matcher else None
            if matcher and depth is None:
                left_out.setdefault("have no depth map: retrieval only", []).append(record.path)
            photos.append(
                MappingPhoto(
                    record,
                    path,
                    _checksum(path),
                    camera,
                    pose,
                    depth,
                    _checksum(dataset.path_of(depth.record)) if depth else None,
                )
            )
        progress(done, len(dataset.images))
    notes = [
        f"{len(names)} of {len(dataset.images)} photos {why}: {', '.join(names[:3])}"
        + (", ..." if len(names) > 3 else "")
        for why, names in left_out.items()
    ]
    if not photos:
        raise DatasetError(
            "dataset.no_photos",
            "no photo of the dataset can be used" + "".join(f"; {note}" for note in notes),
            field=str(dataset.root / "sensors" / "records_camera.txt"),
            expected="photos with a file, a camera of a known model, and a pose",
        )
    return photos, notes


def _checksum(path: Path) -> str:
    try:
        return sha256_of(path)
    except OSError as error:
        raise DatasetError(
            "dataset.unreadable", f"cannot be read: {error.strerror}", field=str(path)
        ) from error
