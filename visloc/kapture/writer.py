"""Writing the ``sensors`` folder of a dataset, or its rigs alone, as kapture 1.1."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

from visloc.errors import refuse
from visloc.geometry import Pose
from visloc.kapture.dataset import Dataset
from visloc.kapture.other_sensors import OTHER_FILES
from visloc.kapture.text import is_field, is_path_field

VERSION_LINE = "# kapture format: 1.1"

_POSE = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
_RIG_COLUMNS = ("rig_id", "sensor_id", *_POSE)
# Widths to which kapture's own tools pad columns.
_WIDTHS = {"timestamp": 8, "device_id": 3, **dict.fromkeys(_POSE, 4)}
_PATHS = ("image_path", "depth_map_path")


def write_dataset(dataset: Dataset) -> None:
    """Write ``sensors/*.txt`` under ``dataset.root``; ``sensors.txt`` comes last.

    Optional files without content are not written; files in ``records_data`` are the caller's.
    Reading returns the same numbers.

    Raises:
        Conflict: ``kapture.exists`` if one of the files exists.
        DatasetError: ``kapture.field`` for a text that kapture cannot hold, such as a comma.
    """
    folder = dataset.root / "sensors"
    contents: dict[str, str] = {}
    for name, columns, rows in _tables(dataset):
        if (folder / name).exists():
            raise refuse(
                "kapture.exists",
                "the folder already has a dataset",
                field=str(folder / name),
                expected="a folder without kapture files",
            )
        if rows or name == "sensors.txt":
            contents[name] = _text(name, columns, rows)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in contents.items():
        write_atomically(folder / name, text.encode("utf-8"))


def write_rigs(path: Path, rigs: Mapping[str, Mapping[str, Pose | None]]) -> None:
    """Write a ``rigs.txt``: rig id -> sensor id -> ``sensor_from_rig``."""
    if path.exists() or path.is_symlink():
        raise refuse("kapture.exists", field=str(path))
    text = _text("rigs.txt", _RIG_COLUMNS, _rig_rows(rigs))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text.encode("utf-8"))


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that it is complete or does not exist."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _tables(dataset: Dataset) -> Iterator[tuple[str, Sequence[str], list[list[str]]]]:
    yield "rigs.txt", _RIG_COLUMNS, _rig_rows(dataset.rigs)
    yield (
        "trajectories.txt",
        ("timestamp", "device_id", *_POSE),
        [
            [str(timestamp), device_id, *_pose_fields(dataset.trajectories[timestamp, device_id])]
            for timestamp, device_id in sorted(dataset.trajectories)
        ],
    )
    yield (
        "records_camera.txt",
        ("timestamp", "device_id", "image_path"),
        [[str(r.timestamp), r.sensor_id, r.path] for r in dataset.images],
    )
    yield (
        "records_depth.txt",
        ("timestamp", "device_id", "depth_map_path"),
        [[str(r.timestamp), r.sensor_id, r.path] for r in dataset.depth_maps],
    )
    yield (
        "records_gnss.txt",
        ("timestamp", "device_id", "x", "y", "z", "utc", "dop"),
        [
            [str(r.timestamp), r.sensor_id]
            + [repr(float(value)) for value in (r.x, r.y, r.z, r.utc, r.dop)]
            for r in dataset.gnss
        ],
    )
    for name, other in dataset.other_records.items():
        yield name, OTHER_FILES[name], [list(row) for row in other]
    yield (
        "sensors.txt",
        ("sensor_id", "name", "sensor_type", "[sensor_params]+"),
        [[s.id, s.name, s.kind, *s.params] for s in dataset.sensors.values()],
    )


def _rig_rows(rigs: Mapping[str, Mapping[str, Pose | None]]) -> list[list[str]]:
    return [
        [rig_id, sensor_id, *_pose_fields(sensor_from_rig)]
        for rig_id, members in rigs.items()
        for sensor_id, sensor_from_rig in members.items()
    ]


def _pose_fields(pose: Pose | None) -> list[str]:
    if pose is None:
        return [""] * 7
    return [repr(number) for number in (*pose.rotation_wxyz.tolist(), *pose.translation.tolist())]


def _text(name: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [VERSION_LINE, f"# {', '.join(columns)}"]
    for row in rows:
        # The last column may stand for several fields, or for none.
        cells = list(zip_longest(columns[: len(row)], row, fillvalue=""))
        for index, (column, field) in enumerate(cells):
            if not _comes_back(field, is_first=index == 0, is_path=column in _PATHS):
                raise refuse("kapture.field", field=f"sensors/{name}", got=field)
        lines.append(", ".join(field.rjust(_WIDTHS.get(column, 0)) for column, field in cells))
    return "\n".join(lines) + "\n"


def _comes_back(field: str, *, is_first: bool, is_path: bool) -> bool:
    if is_first and field[:1] in ("", "#"):  # reads as nothing, or as a comment
        return False
    return is_path_field(field) if is_path else is_field(field)
