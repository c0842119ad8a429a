"""Lists that name photos with cameras or poses, and datasets made of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from mapping.importers.reading.poses import pose_from_center
from visloc.errors import DatasetError, InvalidInput, refuse
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, Sensor
from visloc.kapture.text import relative_path
from visloc_extensions.research.datasets.text import read_lines


def read_cameras(path: Path) -> dict[str, Camera]:
    """Read lines ``name MODEL width height params...``; ``name`` is a photo's or a camera's."""
    expected = "name MODEL width height params..."
    found: dict[str, Camera] = {}
    for line in _without_comments(read_lines(path, expected)):
        name, _, camera = line.partition(" ")
        _check_name(path, name, found)
        try:
            found[name] = Camera.from_text(camera)
        except InvalidInput as error:
            raise error.about(f"{path}: {name}", DatasetError) from None
    return found


def read_centers(path: Path) -> dict[str, Pose]:
    """Read ``cam_from_world`` by photo from lines ``name qw qx qy qz cx cy cz``.

    The quaternion is that of ``cam_from_world``, and c is the camera's centre in the world.
    """
    expected = "name.jpg qw qx qy qz cx cy cz"
    found: dict[str, Pose] = {}
    for line in _without_comments(read_lines(path, expected)):
        name, *fields = line.split()
        _check_name(path, name, found)
        try:
            numbers = np.array([float(field) for field in fields])
            rotation, center = numbers[:4], numbers[4:]
            turned = Pose.from_quaternion(rotation, np.zeros(3)).rotation
            if center.shape != (3,) or not np.isfinite(center).all():
                raise ValueError  # noqa: TRY301  told like the others
        except (InvalidInput, ValueError):
            raise refuse("archive.content", field=str(path), expected=expected, got=line) from None
        found[name] = pose_from_center(turned, center)
    return found


def with_own_cameras(
    root: Path, cameras: Mapping[str, Camera], poses: Mapping[str, Pose]
) -> Dataset:
    """Make a dataset in which each photo has a camera of its own.

    Args:
        poses: ``cam_from_world`` by photo; of some, or of none.
    """
    check_photos(root, cameras)
    return Dataset(
        root=root,
        sensors={name: Sensor.with_camera(name, camera) for name, camera in cameras.items()},
        rigs={},
        trajectories={(t, name): poses[name] for t, name in enumerate(cameras) if name in poses},
        images=tuple(FileRecord(t, name, name) for t, name in enumerate(cameras)),
        depth_maps=(),
        gnss=(),
    )


def check_photos(root: Path, names: Iterable[str]) -> None:
    """Refuse an archive that lacks a photo; raises ``archive.missing``."""
    if not root.is_dir():
        raise refuse("archive.missing", field=str(root), expected="the folder of the photos")
    for name in names:
        if not (root / name).is_file():
            raise refuse("archive.missing", field=str(root / name), expected="a photo")


def _check_name(path: Path, name: str, known: Mapping[str, object]) -> None:
    try:
        relative_path(name)
    except ValueError:
        raise refuse("archive.content", field=str(path), expected="a name", got=name) from None
    if name in known:
        raise refuse("archive.content", field=str(path), expected="each name once", got=name)


def _without_comments(lines: list[str]) -> list[str]:
    return [line for line in lines if not line.startswith("#")]
