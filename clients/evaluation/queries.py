"""The photos to localize: a kapture dataset, or a list of photos with cameras."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from visloc.errors import DatasetError, InvalidInput, refuse
from visloc.geometry import CAMERA_MODELS, Camera, PixelOrigin, Pose
from visloc.kapture import read_dataset
from visloc.kapture.text import plain_name, relative_path

_UNKNOWN_CAMERA = "UNKNOWN_CAMERA"
_MODELS = "|".join((_UNKNOWN_CAMERA, *CAMERA_MODELS))
_WITH_CAMERA = re.compile(rf"(.*\S)\s+((?:{_MODELS})(?:\s.*)?)")


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """One photo to localize.

    Attributes:
        name: in the dataset or list; unique.
        path: the file, which may be missing.
        camera: intrinsics; None when unknown.
        truth: the true ``cam_from_world``, when known; never sent.
        sensor_id: None in a list.
        timestamp: in the dataset's own unit; None in a list.
    """

    name: str
    path: Path
    camera: Camera | None
    truth: Pose | None
    sensor_id: str | None = None
    timestamp: int | None = None

    @property
    def sensor(self) -> str:
        """The name of the sensor in a request, also when it is unknown."""
        return "camera" if self.sensor_id is None else self.sensor_id


@dataclass(frozen=True, slots=True, eq=False)
class QuerySet:
    """The photos to localize, and the rigs of their cameras.

    Attributes:
        photos: in the order of the list, or by time, then by sensor.
        rigs: rig id -> sensor id -> ``cam_from_rig``, None where it is unknown; empty for a list.
    """

    source: Path
    photos: tuple[Query, ...]
    rigs: Mapping[str, Mapping[str, Pose | None]]


def read_queries(
    source: Path, origin: PixelOrigin = PixelOrigin.CORNER, image_root: Path | None = None
) -> QuerySet:
    """Read a kapture folder or a text file that lists photos, in their order.

    Each line of a list is ``image_name`` or ``image_name MODEL width height params...``, separated
    by blanks, which names of photos may hold as well. Empty lines, and those that begin with ``#``
    and are not about a photo of such a name, are skipped. For UNKNOWN_CAMERA, here or in kapture,
    no camera is sent. Principal points count from ``origin``.

    Args:
        source: the folder, the list, or a pattern of lists such as ``queries/*_time_queries.txt``.
        image_root: the folder that names in a list are relative to; by default that of the list.
    """
    if source.is_dir():
        if image_root is not None:
            raise refuse("queries.image_root", field="image_root", got=str(image_root))
        queries = _read_kapture(source, origin)
    elif image_root is not None and not image_root.is_dir():
        raise refuse(
            "queries.missing",
            field=str(image_root),
            expected="the folder of the photos of the list",
        )
    elif lists := _lists_of(source):
        queries = QuerySet(source, tuple(_read_lists(lists, origin, image_root)), {})
    else:
        raise refuse("queries.missing", field=str(source))
    if not queries.photos:
        raise refuse(
            "queries.empty",
            field=str(source),
            expected="photos in sensors/records_camera.txt" if source.is_dir() else "a line each",
        )
    return queries


def _read_kapture(root: Path, origin: PixelOrigin) -> QuerySet:
    dataset = read_dataset(root).with_pixels_from(origin)
    photos = (
        Query(
            record.path,
            dataset.path_of(record),
            dataset.sensors[record.sensor_id].camera,
            dataset.pose(record),
            record.sensor_id,
            record.timestamp,
        )
        for record in dataset.images
    )
    return QuerySet(root, tuple(photos), dataset.rigs)


def _lists_of(source: Path) -> list[Path]:
    if source.is_file():
        return [source]
    return sorted(path for path in source.parent.glob(source.name) if path.is_file())


def _read_lists(
    paths: Sequence[Path], origin: PixelOrigin, image_root: Path | None
) -> Iterator[Query]:
    seen: set[str] = set()
    for path in paths:
        for query in _read_list(path, origin, path.parent if image_root is None else image_root):
            if query.name in seen:
                raise refuse("list.duplicate", field=str(path), got=query.name)
            seen.add(query.name)
            yield query


def _read_list(path: Path, origin: PixelOrigin, folder: Path) -> list[Query]:
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise refuse("list.unreadable", field=str(path), got=str(error)) from error
    queries: dict[str, Query] = {}
    for number, line in enumerate(lines, start=1):
        text, fields = _name_and_camera(line.strip(), folder)
        if not text or (text.startswith("#") and not _is_photo(folder, text)):
            continue
        where = f"{path}:{number}"
        name = _parse_name(where, text)
        if name in queries:
            raise refuse("list.duplicate", field=where, got=name)
        camera = _parse_camera(where, fields)
        if camera is not None:
            camera = camera.with_pixels_from(origin)
        queries[name] = Query(name, folder / name, camera, None)
    return list(queries.values())


def _name_and_camera(line: str, folder: Path) -> tuple[str, list[str]]:
    """Split a line before the model of its camera, or else at its first blank."""
    if _is_photo(folder, line):
        return line, []
    name, *camera = (
        found.groups()
        if (found := _WITH_CAMERA.fullmatch(line))
        else line.split(maxsplit=1) or [""]
    )
    return name, " ".join(camera).split()


def _is_photo(folder: Path, name: str) -> bool:
    return os.path.isfile(folder / plain_name(name))  # noqa: PTH113 - is_file raises


def _parse_name(where: str, text: str) -> str:
    try:
        return relative_path(text)
    except ValueError:
        raise refuse("list.path", field=where, got=text) from None


def _parse_camera(where: str, fields: Sequence[str]) -> Camera | None:
    if not fields:
        return None
    if fields[0] == _UNKNOWN_CAMERA:
        if len(fields) == 3 and all(field.isdecimal() for field in fields[1:]):
            return None
        raise refuse(
            "camera.param_count",
            field=where,
            expected="2: width, height",
            got=" ".join(fields[1:]),
            kind=DatasetError,
            model=_UNKNOWN_CAMERA,
        )
    try:
        return Camera.from_text(" ".join(fields))
    except InvalidInput as error:
        raise error.about(where, DatasetError) from None
