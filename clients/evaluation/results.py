"""Results on disk: ``results.jsonl``, poses, and files that are written whole or not at all."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from clients.evaluation.filling import pose_as_json, uncertainty_of
from clients.evaluation.run import Outcome
from clients.wire.answers import parse_coarse, parse_pose
from visloc.errors import InvalidInput, refuse
from visloc.geometry import Pose
from visloc.sequences.filling import TracedPose
from visloc.types import PoseSource
from visloc_api.words.poses import CoarsePose, PoseEstimate

_LOCALIZED, _NOT_LOCALIZED, _ERROR, _FILLED = "localized", "not_localized", "error", "filled"
_COARSE = "coarse"
_STATUSES = (_LOCALIZED, _COARSE, _NOT_LOCALIZED, _ERROR)
# Errors that say nothing about the photo: it may be answered when it is sent again.
_PASSING_CODES = ("server.internal", "server.timeout")
_PASSING_KINDS = ("Unavailable", "Overloaded")


@dataclass(frozen=True, slots=True, eq=False)
class StoredResult:
    """One line of ``results.jsonl``.

    Attributes:
        status: localized, coarse, not_localized or error; for a filled photo, its status before
            filling.
        filled: the pose from other photos, when the line has one.
        retrieved: names of the mapping photos that were matched against, best first.
        is_final: False for errors of the server: the photo is sent again.
        coarse: the pose that retrieval alone told.
        offset: of the line in the file, bytes.
        length: of the line with its end, bytes.
    """

    name: str
    status: str
    pose: PoseEstimate | None
    num_inliers: int
    filled: TracedPose | None
    retrieved: tuple[str, ...]
    is_final: bool
    coarse: CoarsePose | None
    offset: int
    length: int


def result_line(outcome: Outcome) -> str:
    """Write an outcome as one line of JSON: the name, then the answer as received.

    ``source`` is the source of the pose, null without one. A photo without an answer has
    ``"status": "error"`` and an object ``error`` with kind, code, message, field, expected and
    got. A filled photo has status filled and a ``pose``; the rest is as before filling.
    """
    entry: dict[str, Any] = {"name": outcome.query.name}
    if outcome.result is not None:
        source = PoseSource.ESTIMATED.value if outcome.result.localized else None
        entry |= {**outcome.result.raw, "source": source}
    else:
        error = outcome.error
        assert error is not None
        details = {
            name: getattr(error, name) for name in ("code", "message", "field", "expected", "got")
        }
        entry |= {"status": _ERROR, "error": {"kind": type(error).__name__} | details}
        entry["source"] = None
    if outcome.filled is not None:
        _fill(entry, outcome.filled)
    return json.dumps(entry) + "\n"


def drop_torn_line(path: Path) -> None:
    """Cut off an incomplete last line, as a killed run leaves it; a missing file stays missing."""
    if not path.exists():
        return
    with path.open("r+b") as file:
        size = file.seek(0, os.SEEK_END)
        end = size
        while end > 0:
            start = max(0, end - 65536)
            file.seek(start)
            newline = file.read(end - start).rfind(b"\n")
            if newline >= 0:
                end = start + newline + 1
                break
            end = start
        if end < size:
            file.truncate(end)


def read_results(path: Path) -> Iterator[StoredResult]:
    """Read ``results.jsonl``; a missing file has no lines."""
    if not path.exists():
        return
    offset = 0
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            try:
                parsed = _parse_line(line)
            except (KeyError, TypeError, ValueError, RecursionError, InvalidInput) as error:
                raise refuse("results.line", field=f"{path}:{number}", got=str(error)) from error
            yield StoredResult(*parsed, offset, len(line))
            offset += len(line)


def copy_lines(
    source: Path,
    results: Iterable[StoredResult],
    target: Path,
    filled: Mapping[str, TracedPose] | None = None,
) -> None:
    """Copy lines of ``source`` to ``target``, in the order given; they may be the same file.

    Args:
        filled: poses from other photos, by the photo's name. Lines of other photos lose theirs.
    """
    filled = filled or {}
    with source.open("rb") as file:

        def lines() -> Iterator[bytes]:
            for result in results:
                file.seek(result.offset)
                line = file.read(result.length)
                pose = filled.get(result.name)
                yield line if pose is result.filled else _refilled(line, pose)

        write_whole(target, lines())


def write_poses(path: Path, poses: Iterable[tuple[str, PoseEstimate | CoarsePose | Pose]]) -> None:
    """Write ``name qw qx qy qz tx ty tz`` lines of ``cam_from_world``, every digit as received.

    Readers of this format split at blanks and skip lines that begin with ``#``, so these, ``%`` and
    a byte order mark are percent-encoded in names: ``a b.jpg`` becomes ``a%20b.jpg``, and
    ``urllib.parse.unquote`` gives the name back.
    """
    write_whole(path, (_pose_line(name, pose).encode() for name, pose in poses))


def write_whole(path: Path, parts: Iterable[bytes]) -> None:
    """Write a file so that a reader sees the old or the new one, never a part."""
    unfinished = path.with_name(f".{path.name}.new")
    with unfinished.open("wb") as file:
        _write_and_sync(file, parts)
    unfinished.replace(path)


def check_can_be_written(paths: Sequence[Path]) -> None:
    """Check before a long run that its files can be written."""
    for path in paths:
        if path.is_dir() or not os.access(path.parent, os.W_OK):
            raise refuse(
                "output.folder",
                "the file cannot be written",
                field=str(path),
                expected="a file in an existing folder that is not write-protected",
            )


def _parse_line(
    line: bytes,
) -> tuple[
    str,
    str,
    PoseEstimate | None,
    int,
    TracedPose | None,
    tuple[str, ...],
    bool,
    CoarsePose | None,
]:
    entry = json.loads(line)
    name, status = entry["name"], entry["status"]
    filled = None
    if status == _FILLED:
        status, other = _before_filling(entry), parse_pose(entry["pose"])
        source, uncertainty = PoseSource(entry["source"]), uncertainty_of(other)
        filled = TracedPose(other.cam_from_world, other.covariance, source, uncertainty)
    if not isinstance(name, str) or status not in _STATUSES:
        raise ValueError(f"name {name!r}, status {status!r}")
    pose, num_inliers = None, 0
    if status == _LOCALIZED:
        pose, num_inliers = parse_pose(entry["pose"]), int(entry["inliers"])
    is_final = status != _ERROR or not (
        entry["error"]["code"] in _PASSING_CODES or entry["error"]["kind"] in _PASSING_KINDS
    )
    retrieved = tuple(str(each["image"]) for each in entry.get("retrieved", ()))
    coarse = parse_coarse(entry["coarse"]) if status == _COARSE else None
    return name, status, pose, num_inliers, filled, retrieved, is_final, coarse


def _before_filling(entry: Mapping[str, Any]) -> str:
    if "error" in entry:
        return _ERROR
    return _NOT_LOCALIZED if entry.get("coarse") is None else _COARSE


def _refilled(line: bytes, pose: TracedPose | None) -> bytes:
    """Put a pose from other photos into a line, or take it out; the rest stays."""
    entry = json.loads(line)
    entry["status"], entry["source"] = _before_filling(entry), None
    if "error" in entry:
        entry.pop("pose", None)
    else:
        entry["pose"] = None
    if pose is not None:
        _fill(entry, pose)
    return json.dumps(entry).encode() + b"\n"


def _fill(entry: dict[str, Any], pose: TracedPose) -> None:
    entry["status"], entry["source"] = _FILLED, pose.source.value
    entry["pose"] = pose_as_json(pose)


def _pose_line(name: str, pose: PoseEstimate | CoarsePose | Pose) -> str:
    numbers = (repr(float(value)) for value in (*pose.rotation_wxyz, *pose.translation))
    encoded = re.sub(r"^#|[\s%\ufeff]", lambda found: quote(found[0]), name)
    return f"{encoded} {' '.join(numbers)}\n"


def _write_and_sync(file: BinaryIO, parts: Iterable[bytes]) -> None:
    file.writelines(parts)
    file.flush()
    os.fsync(file.fileno())
