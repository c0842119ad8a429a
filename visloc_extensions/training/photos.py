"""The photographs to learn from, packed into one file.

The pack holds the photos as they are compressed, so that it travels well; unpacked they are 8-bit
pixels, each with halves of itself for looking at it from further away.
"""

from __future__ import annotations

import csv
import hashlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load
from torch import Tensor

from visloc.errors import NotFound, refuse
from visloc.photos.reading import read_photo
from visloc_extensions.training.files import read_about, write_tensors

VALIDATION = "validation"
_RESEARCH_SUFFIX = "_research"  # of folders whose licences do not allow every use
_SHORTEST_SIDE_PX = 64  # of a halved photo that is still worth looking at


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """One photo.

    Attributes:
        levels: (3, H, W) uint8 RGB each; the first as taken, each further one of half the size.
    """

    name: str
    levels: tuple[Tensor, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Pack:
    """A pack of photos.

    Attributes:
        photos: in the order of their names.
        sha256: of the file, lower-case hexadecimal.
        licences: each licence with the number of photos under it.
    """

    photos: tuple[Photo, ...]
    sha256: str
    licences: dict[str, int]


def pack_photos(source: Path, output: Path, *, research: bool, validation: bool) -> int:
    """Pack the photos of a folder of folders, and return their number.

    Args:
        source: its folders hold ``*.jpg`` and ``SOURCES.tsv`` with columns file and licence.
        research: also those of folders ``*_research``, whose licences forbid commercial use.
        validation: only those held back for validation; otherwise all but those.
    """
    arrays, licences = {}, {}
    for path in sorted(source.glob("*/*.jpg")):
        folder = path.parent.name
        is_held_back = folder == VALIDATION
        if is_held_back != validation or (folder.endswith(_RESEARCH_SUFFIX) and not research):
            continue
        name = f"{folder}/{path.name}"
        arrays[name] = np.frombuffer(path.read_bytes(), np.uint8)
        licences[name] = _licences(path.parent / "SOURCES.tsv").get(path.name, "not stated")
    if not arrays:
        raise refuse("training.photos", field=str(source))
    write_tensors(output, arrays, {"licences": licences})
    return len(arrays)


def _licences(table: Path) -> dict[str, str]:
    with table.open(encoding="utf-8", newline="") as file:
        return {row["file"]: row["licence"] for row in csv.DictReader(file, delimiter="\t")}


def read_pack(path: Path) -> Pack:
    """Read a pack and decode its photos."""
    if not path.is_file():
        raise refuse("training.pack", field=str(path), kind=NotFound)
    data = path.read_bytes()
    try:
        packed = load(data)
        told = read_about(path)["licences"]
        licences = Counter(str(told[name]) for name in packed)
    except (SafetensorError, LookupError, TypeError, ValueError) as error:
        raise refuse(
            "training.pack",
            "this is not a pack of photos of this version; make one with: "
            "python -m visloc_extensions.training pack",
            field=str(path),
            got=f"{type(error).__name__}: {error}",
        ) from error
    photos: list[Photo] = []
    for name in sorted(packed):
        rgb = read_photo(packed[name].tobytes()).rgb
        photos.append(Photo(name, photo_levels(rgb)))
    return Pack(tuple(photos), hashlib.sha256(data).hexdigest(), licences)


def photo_levels(rgb: np.ndarray) -> tuple[Tensor, ...]:
    """Halve a photo (H, W, 3) until its short side would be less than 64 px."""
    levels = []
    while True:
        levels.append(torch.from_numpy(rgb).permute(2, 0, 1).contiguous())
        height, width = rgb.shape[0] // 2, rgb.shape[1] // 2
        if min(height, width) < _SHORTEST_SIDE_PX:
            return tuple(levels)
        # Area averaging keeps the outer corners where they are, also for odd sizes.
        rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
