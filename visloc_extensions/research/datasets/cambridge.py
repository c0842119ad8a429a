"""Cambridge Landmarks: one scene, such as KingsCollege.

Layout of the archives of Kendall et al. 2015 (repository.cam.ac.uk/handle/1810/251342 and others),
as ``setup_cambridge.py`` of vislearn/dsacstar reads it: ``dataset_train.txt`` and
``dataset_test.txt`` have two lines of heading and a line ``seq1/frame00001.png X Y Z W P Q R`` for
each photo: the camera's centre in the world, and the quaternion of cam_from_world, scalar first.
``reconstruction.nvm`` of VisualSFM names the photos ``.jpg`` and has the focal length of each, in
pixels; the principal point is the centre. Its radial distortion is left out, as by the others.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from visloc.errors import DatasetError, InvalidInput, refuse
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, Sensor
from visloc_extensions.research.datasets.text import read_lines

_SPLITS = {"mapping": "dataset_train.txt", "query": "dataset_test.txt"}
_NVM = "reconstruction.nvm"
_NUM_HEADINGS = 2
# Poses beyond, of which the published lists have a few, are failures of the reconstruction.
_FARTHEST = 10_000.0


def read_cambridge(folder: Path) -> Mapping[str, Dataset]:
    """Read the mapping and the query photos of a scene, each with a camera of its own."""
    focal_lengths = _focal_lengths(folder / _NVM)
    return {part: _read(folder, name, focal_lengths) for part, name in _SPLITS.items()}


def _focal_lengths(path: Path) -> dict[str, float]:
    """Read the focal lengths by the photos' names without their suffix."""
    lines = read_lines(path, "the scene's VisualSFM model")
    if not lines[0].startswith("NVM_V3") or len(lines) < 2:
        raise refuse("archive.content", field=str(path), expected="NVM_V3", got=lines[0])
    found = {}
    try:
        for line in lines[2 : 2 + int(lines[1])]:
            name, focal_length, *_ = line.split()
            found[_without_suffix(name)] = float(focal_length)
    except ValueError as error:
        raise refuse("archive.content", field=str(path), got=str(error)) from error
    return found


def _read(folder: Path, name: str, focal_lengths: Mapping[str, float]) -> Dataset:
    path = folder / name
    expected = "seq1/frame00001.png X Y Z W P Q R, the folder of one scene"
    sensors, images, poses, num_far = {}, [], {}, 0
    for timestamp, line in enumerate(read_lines(path, expected)[_NUM_HEADINGS:]):
        photo, *numbers = line.split()
        where = f"{path}: {photo}"
        try:
            center, rotation = np.split(np.array([float(number) for number in numbers]), [3])
            turned = Pose.from_quaternion(rotation, np.zeros(3))
        except (InvalidInput, ValueError) as error:
            raise refuse("archive.content", field=where, expected=expected, got=line) from error
        if not np.isfinite(center).all() or photo in sensors:
            raise refuse("archive.content", field=where, expected=expected, got=line)
        if np.abs(center).max() > _FARTHEST:
            num_far += 1
            continue
        focal_length = focal_lengths.get(_without_suffix(photo))
        if focal_length is None:
            raise refuse("archive.missing", field=str(folder / _NVM), expected=f"camera of {photo}")
        sensors[photo] = Sensor.with_camera(photo, _camera(folder / photo, focal_length))
        images.append(FileRecord(timestamp, photo, photo))
        poses[timestamp, photo] = Pose(turned.rotation, -turned.rotation @ center)
    if not images:
        raise refuse("archive.content", field=str(path), expected=expected, got="no photo")
    notes = (f"{num_far} photos beyond {_FARTHEST:g} m were left out ({name})",) if num_far else ()
    return Dataset(
        root=folder,
        sensors=sensors,
        rigs={},
        trajectories=poses,
        images=tuple(images),
        depth_maps=(),
        gnss=(),
        notes=notes,
    )


def _camera(photo: Path, focal_length: float) -> Camera:
    try:
        with Image.open(photo) as opened:  # of the header only
            width, height = opened.size
    except FileNotFoundError:
        raise refuse("archive.missing", field=str(photo)) from None
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise refuse("archive.content", field=str(photo), got=str(error)) from error
    try:
        return Camera("SIMPLE_PINHOLE", width, height, (focal_length, width / 2, height / 2))
    except InvalidInput as error:
        raise error.about(str(photo), DatasetError) from None


def _without_suffix(name: str) -> str:
    return name.rpartition(".")[0]
