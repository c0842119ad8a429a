"""Modes that fill poses from other photos, as in the tables of Humenberger et al. 2020."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

from clients.evaluation.instants import QueryInstant, instants_of_dataset, instants_of_map_rig
from clients.evaluation.queries import Query, QuerySet
from visloc.errors import refuse
from visloc.sequences.filling import (
    DEFAULT_MAX_GAP_S,
    TimeUnit,
    TracedPose,
    fill_rig,
    fill_sequence,
    guess_time_unit,
)
from visloc_api.words.maps import MapInfo


class Mode(StrEnum):
    """How photos of a dataset help each other."""

    SINGLE = "single"  # not at all
    RIG = "rig"  # a photo without a pose takes it from the best camera of its rig and instant
    SEQ = "seq"  # ... from the instants before and after
    RIG_SEQ = "rig+seq"  # ... from both, in this order
    GP3P = "gp3p"  # the photos of a rig and instant solve one pose, also for those without inliers

    @property
    def fills_rigs(self) -> bool:
        """Whether a camera takes the pose of another one."""
        return self in (Mode.RIG, Mode.RIG_SEQ)

    @property
    def fills_sequences(self) -> bool:
        """Whether an instant takes the pose of others."""
        return self in (Mode.SEQ, Mode.RIG_SEQ)

    @property
    def fills(self) -> bool:
        """Whether poses are filled here; in gp3p the server fills them."""
        return self.fills_rigs or self.fills_sequences


@dataclass(frozen=True, slots=True, eq=False)
class Arrangement:
    """The groups of a dataset's photos that the modes need.

    Attributes:
        filled: the instants in which one camera's pose fills another's.
        asked: the instants that are sent in one request each.
        time_unit: of the timestamps; None when no mode needs it.
        max_gap_s: longest time between the poses that others are filled from, seconds.
    """

    photos: tuple[Query, ...]
    filled: tuple[QueryInstant, ...]
    asked: tuple[QueryInstant, ...]
    time_unit: TimeUnit | None
    max_gap_s: float

    def fill(self, mode: Mode, poses: Sequence[TracedPose | None]) -> list[TracedPose | None]:
        """Fill the poses ``cam_from_world`` of all photos as the mode does."""
        by_name = {query.name: pose for query, pose in zip(self.photos, poses, strict=True)}
        if mode.fills_rigs:
            for instant in self.filled:
                _fill_instant(instant, by_name)
        if mode.fills_sequences and self.time_unit is not None:
            sequences: dict[str | None, list[Query]] = {}
            for query in self.photos:
                sequences.setdefault(query.sensor_id, []).append(query)
            for taken_by_one in sequences.values():
                _fill_sequence(taken_by_one, by_name, self.time_unit, self.max_gap_s)
        return [by_name[query.name] for query in self.photos]


def parse_modes(texts: Iterable[str]) -> list[Mode]:
    """Parse modes, also with commas between; ``all`` is every mode, none at all is ``single``."""
    modes: list[Mode] = []
    for word in (word for text in texts for word in text.split(",")):
        if word == "all":
            modes += Mode
            continue
        try:
            modes.append(Mode(word))
        except ValueError:
            raise refuse(
                "mode.unknown", field="mode", expected=f"one of {', '.join(Mode)}, all", got=word
            ) from None
    return list(dict.fromkeys(modes)) or [Mode.SINGLE]


def arrange(
    queries: QuerySet,
    modes: Sequence[Mode],
    info: MapInfo,
    *,
    rig_id: str | None = None,
    time_unit: TimeUnit | None = None,
    max_gap_s: float = DEFAULT_MAX_GAP_S,
) -> Arrangement:
    """Group the photos of a dataset as the modes need it.

    Args:
        rig_id: for ``gp3p``: a rig that the map knows, instead of the dataset's rigs.
        time_unit: of the timestamps; None infers it from their size.
        max_gap_s: longest time between the poses that others are filled from.
    """
    filled: list[QueryInstant] = []
    asked: list[QueryInstant] = []
    if any(mode.fills_rigs for mode in modes):
        filled = instants_of_dataset(queries)
    if Mode.GP3P in modes:
        asked = (
            instants_of_dataset(
                queries, or_else=", or one of cameras of a rig that the map knows, with --rig ID"
            )
            if rig_id is None
            else instants_of_map_rig(queries, info, rig_id)
        )
    unit = None
    if any(mode.fills_sequences for mode in modes):
        unit = _time_unit(queries, time_unit)
    return Arrangement(queries.photos, tuple(filled), tuple(asked), unit, max_gap_s)


def _fill_instant(instant: QueryInstant, by_name: dict[str, TracedPose | None]) -> None:
    assert not isinstance(instant.rig, str)  # a rig of the dataset
    cam_from_rig = {sensor: known.cam_from_rig for sensor, known in instant.rig.items()}
    names = {query.sensor: query.name for query in instant.photos}
    poses = fill_rig({sensor: by_name[name] for sensor, name in names.items()}, cam_from_rig)
    by_name.update({names[sensor]: pose for sensor, pose in poses.items()})


def _fill_sequence(
    photos: Sequence[Query],
    by_name: dict[str, TracedPose | None],
    unit: TimeUnit,
    max_gap_s: float,
) -> None:
    in_time = sorted((query.timestamp or 0, query.name) for query in photos)
    first = in_time[0][0]
    # Subtracted as whole numbers: as floats, Unix times lose digits.
    times_s = [(timestamp - first) * unit.seconds for timestamp, _ in in_time]
    poses = fill_sequence(times_s, [by_name[name] for _, name in in_time], max_gap_s)
    by_name.update({name: pose for (_, name), pose in zip(in_time, poses, strict=True)})


def _time_unit(queries: QuerySet, given: TimeUnit | None) -> TimeUnit:
    timestamps = [query.timestamp for query in queries.photos if query.timestamp is not None]
    if len(timestamps) < len(queries.photos):
        raise refuse("queries.no_timestamps", field=str(queries.source), got="a list of photos")
    unit = given or guess_time_unit(timestamps)
    if unit is None:
        raise refuse(
            "queries.time_unit",
            field=str(queries.source / "sensors" / "records_camera.txt"),
            expected=f"--time-unit {', '.join(TimeUnit)}",
            got=f"timestamps from {min(timestamps)} to {max(timestamps)}",
        )
    return unit
