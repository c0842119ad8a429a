"""OpenMVG's feature files: ``NAME.feat`` (text) and ``NAME.desc`` (binary)."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.importers.model import ImportedImage
from mapping.importers.reading.json_fields import read_json
from mapping.importers.reading.text_lines import TextLines
from visloc.errors import refuse
from visloc.geometry import PixelOrigin
from visloc_extensions.importers.tracks import Measurements, keypoints_of

PIXELS = PixelOrigin.CENTER  # where OpenMVG counts from
# Positions in .feat files are rounded to six digits; those of another extraction are not near.
_SAME_POSITION = 0.1
_DIMENSIONS = 128  # of SIFT; a descriptor is that many bytes


def read_keypoints(path: Path) -> NDArray[np.float32]:
    """Read the features (n, 4) of a photo: x, y, scale, orientation (rad), as in the file."""
    rows = []
    with TextLines(path) as lines:
        while (line := lines.next_or_none()) is not None:
            fields = line.split()
            if len(fields) != 4:
                raise lines.error(
                    "the line has the wrong number of fields",
                    expected="4: x y scale orientation",
                    got=len(fields),
                )
            rows.append([lines.to_number(field) for field in fields])
    return np.array(rows, np.float32).reshape(-1, 4)


def read_descriptors(path: Path, count: int) -> NDArray[np.uint8]:
    """Read SIFT descriptors (count, 128): a 64-bit count, little-endian, and the bytes."""
    size = 8 + count * _DIMENSIONS
    try:
        with path.open("rb") as file:
            data = file.read(size + 1)
    except OSError as error:
        raise refuse("import.unreadable", field=str(path), got=error.strerror) from error
    announced = int.from_bytes(data[:8], "little")
    if announced != count or len(data) != size:
        raise refuse(
            "import.descriptors",
            field=str(path),
            expected=f"{count} descriptors of {_DIMENSIONS} bytes: {size} bytes",
            got=f"{announced} announced, "
            + (f"{len(data)} bytes" if len(data) <= size else "more bytes"),
        )
    return np.frombuffer(data, np.uint8, offset=8).reshape(count, _DIMENSIONS)


def with_features(
    path: Path, stems: list[str], images: list[ImportedImage], measurements: Measurements
) -> tuple[str, list[ImportedImage], NDArray[np.int64], list[str]]:
    """Give the images their features, or else what was observed of them.

    Args:
        stems: of each image, the name of its feature files.
        measurements: their observations, in our pixels.

    Returns:
        The type of the keypoints, the images, the observations (M, 3) and notes.
    """
    notes: list[str] = []
    files = _feature_files(path, stems)
    keypoints = [_in_our_pixels(read_keypoints(file)) for file in files]
    if files and not _are_in(measurements, keypoints):
        notes.append(
            f"the features in {files[0].parent} are not those that the model was made of; the "
            "observations are the keypoints"
        )
        files = []
    if not files:
        if not len(measurements):
            return "openmvg", images, np.empty((0, 3), np.int64), notes
        if not notes:
            notes.append("the photos' feature files are absent; the observations are the keypoints")
        keypoints, rows = keypoints_of(measurements, measurements.xy, len(images), str(path))
        return "openmvg", _with_keypoints(images, keypoints), rows, notes
    rows = np.column_stack([measurements.point, measurements.image, measurements.feature])
    images = _with_keypoints(images, keypoints)
    kind = _regions_type(files[0].parent / "image_describer.json")
    if kind != "SIFT_Regions":
        notes.append(f"descriptors of the kind {kind!r} are not read: keypoints only")
        return "openmvg", images, rows, notes
    described = [
        replace(
            image, descriptors=read_descriptors(file.with_suffix(".desc"), len(image_keypoints))
        )
        for image, image_keypoints, file in zip(images, keypoints, files, strict=True)
    ]
    return "sift", described, rows, notes


def _in_our_pixels(keypoints: NDArray[np.float32]) -> NDArray[np.float32]:
    moved = keypoints.copy()
    moved[:, :2] += PIXELS.shift
    return moved


def _with_keypoints(
    images: list[ImportedImage], keypoints: list[NDArray[np.float32]]
) -> list[ImportedImage]:
    return [replace(image, keypoints=k) for image, k in zip(images, keypoints, strict=True)]


def _feature_files(path: Path, stems: list[str]) -> list[Path]:
    """Return each photo's ``.feat``; nothing if one has none, or two have the same."""
    if Counter(stems).most_common(1)[0][1] > 1:
        return []  # OpenMVG let one photo's features overwrite the other's
    folder = path.parent
    for candidate in (folder, folder / "matches", folder.parent / "matches"):
        files = [candidate / f"{stem}.feat" for stem in stems]
        if all(os.path.isfile(file) for file in files):  # noqa: PTH113 - is_file raises
            return files
    return []


def _are_in(measurements: Measurements, keypoints: list[NDArray[np.float32]]) -> bool:
    for rank, found in enumerate(keypoints):
        rows = measurements.image == rank
        features = measurements.feature[rows]
        if features.max(initial=-1) >= len(found):
            return False
        off = np.abs(found[features, :2] - measurements.xy[rows]).max(initial=0.0)
        if off > _SAME_POSITION:
            return False
    return True


def _regions_type(path: Path) -> str:
    if not path.is_file():
        return "SIFT_Regions"  # what OpenMVG extracts unless told otherwise; sizes are checked
    return read_json(path)["regions_type"]["polymorphic_name"].text()
