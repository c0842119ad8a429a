"""How good poses are that exist already: by scene, by condition, and on average."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from clients.evaluation.pairs import of_photos
from visloc.accuracy import Compared, accuracy_of
from visloc.errors import refuse
from visloc.evaluation import Threshold
from visloc.kapture.text import plain_name
from visloc_extensions.research.evaluation.pose_files import KnownPose, read_poses

_AVERAGED = (
    *("median_position_error_m", "median_orientation_error_deg"),
    *("median_position_error_of_all_m", "median_orientation_error_of_all_deg"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Poses and what they are compared with.

    Attributes:
        name: how the user called the true poses.
        photos: those whose true pose is known, by name, in the order of the true poses.
        unknown: how many poses are of other photos.
    """

    name: str
    photos: Mapping[str, Compared]
    unknown: int


@dataclass(frozen=True, slots=True)
class Conditions:
    """Which photos were taken when, or how.

    Attributes:
        patterns: (condition, pattern of photo names, in which ``*`` also stands for slashes).
        listed: condition by the name of the photo.
    """

    patterns: tuple[tuple[str, str], ...]
    listed: Mapping[str, str]

    @property
    def names(self) -> list[str]:
        """The conditions, in the order in which they were given."""
        return list(dict.fromkeys([*(name for name, _ in self.patterns), *self.listed.values()]))

    def split(self, photos: Iterable[str]) -> dict[str, list[str]]:
        """Return the photos by condition; a photo may have several, or none."""
        photos = list(photos)
        listed, _ = of_photos(self.listed, photos)
        found: dict[str, list[str]] = defaultdict(list)
        for photo in photos:
            its = {name for name, pattern in self.patterns if fnmatchcase(photo, pattern)}
            if photo in listed:
                its.add(listed[photo])
            for name in its:
                found[name].append(photo)
        return {name: found[name] for name in self.names if name in found}


def read_scene(poses: Path, truth: Path) -> Scene:
    """Compare the poses of a file with true ones."""
    true_poses = read_poses(truth)
    if not true_poses:
        raise refuse("evaluation.no_truth", field=str(truth))
    given = read_poses(poses)
    found, unknown = of_photos(given, true_poses)
    if given and not found:
        raise refuse(
            "evaluation.names",
            field=str(poses),
            expected=f"names such as {next(iter(true_poses))}",
            got=next(iter(given)),
        )
    compared = {name: _compared(known, found.get(name)) for name, known in true_poses.items()}
    return Scene(str(truth), compared, unknown)


def read_conditions(patterns: Sequence[str], listed: Path | None) -> Conditions:
    """Parse texts ``NAME=PATTERN``, and a file with lines ``photo condition``.

    The fields of a line are separated by a comma or by blanks. Lines that begin with ``#`` are
    skipped; ``./#1.jpg`` is the photo ``#1.jpg``.
    """
    pairs = []
    for text in patterns:
        name, equals, pattern = text.partition("=")
        if not (name and equals and pattern):
            raise refuse("conditions.syntax", field="condition", got=text)
        pairs.append((name, pattern))
    by_photo = {} if listed is None else _listed(listed)
    return Conditions(tuple(pairs), by_photo)


def score(
    scenes: Sequence[Scene], conditions: Conditions, thresholds: Sequence[Threshold]
) -> dict[str, Any]:
    """Summarize scenes as plain JSON; null where there is no figure.

    ``average`` is the plain mean over the finest rows: the conditions of all scenes where
    conditions are given, else the scenes. A median is averaged when every row has it.
    """
    rows, finest = [], []
    seen: set[str] = set()
    for scene in scenes:
        split = conditions.split(scene.photos)
        seen |= split.keys()
        parts = {
            name: _figures([scene.photos[photo] for photo in photos], thresholds)
            for name, photos in split.items()
        }
        whole = _figures(list(scene.photos.values()), thresholds)
        rows.append({"scene": scene.name, "unknown": scene.unknown, **whole, "conditions": parts})
        finest += list(parts.values()) if conditions.names else [whole]
    for name in conditions.names:
        if name not in seen:
            raise refuse("conditions.empty", field="condition", got=name)
    return {"scenes": rows, "average": _average(finest, thresholds)}


def _compared(truth: KnownPose, found: KnownPose | None) -> Compared:
    if found is None:
        return Compared(truth.pose, None)
    return Compared(truth.pose, found.pose, found.covariance)


def _figures(photos: Sequence[Compared], thresholds: Sequence[Threshold]) -> dict[str, Any]:
    with_pose = sum(each.pose is not None for each in photos)
    return {"photos": len(photos), "with_pose": with_pose, **accuracy_of(photos, thresholds)}


def _average(rows: Sequence[Mapping[str, Any]], thresholds: Sequence[Threshold]) -> dict[str, Any]:
    def mean(values: Sequence[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return math.fsum(known) / len(known) if len(known) == len(values) else None

    recall = [
        {**rows[0]["recall"][i], "fraction": mean([row["recall"][i]["fraction"] for row in rows])}
        for i in range(len(thresholds))
    ]
    return {
        "rows": len(rows),
        "recall": recall,
        "recall_of_all_thresholds": mean([each["fraction"] for each in recall]),
        **{name: mean([row[name] for row in rows]) for name in _AVERAGED},
    }


def _listed(path: Path) -> dict[str, str]:
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise refuse("conditions.unreadable", field=str(path), got=str(error)) from error
    found: dict[str, str] = {}
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        fields = [part.strip() for part in (text.split(",") if "," in text else text.split())]
        name = plain_name(fields[0])
        if len(fields) != 2 or not all(fields) or name in found:
            raise refuse("conditions.line", field=f"{path}:{number}", got=text)
        found[name] = fields[1]
    return found
