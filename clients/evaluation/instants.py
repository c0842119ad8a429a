"""The photos of a dataset, grouped by rig and timestamp."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from clients.evaluation.queries import Query, QuerySet
from clients.wire.rigs import Rig
from visloc.errors import VislocError, refuse
from visloc.geometry import Pose
from visloc.types import RigSensor
from visloc_api.words.maps import MapInfo


@dataclass(frozen=True, slots=True, eq=False)
class QueryInstant:
    """Photos that a rig took at one instant.

    Attributes:
        rig: how the cameras sit, or the id of a rig of the map. A camera without a rig is a rig
            of its own.
        photos: each of another camera, in the order of the dataset.
    """

    rig: Rig
    photos: tuple[Query, ...]


def instants_of_dataset(queries: QuerySet, *, or_else: str = "") -> list[QueryInstant]:
    """Group photos by rig and timestamp, in the order of their first photos.

    The rig of a camera is the outermost one that carries it.

    Args:
        or_else: names an alternative to rigs in the dataset, for the error.
    """
    rig_of = {
        sensor_id: _rig_of(queries, sensor_id)
        for sensor_id in dict.fromkeys(q.sensor_id for q in queries.photos)
        if sensor_id is not None
    }
    sensors: dict[str, dict[str, RigSensor]] = {}
    for sensor_id, rig_id in rig_of.items():
        if rig_id is None:
            continue
        cam_from_rig = queries.rigs[rig_id][sensor_id]
        if cam_from_rig is None:
            raise refuse(
                "queries.rig_transform",
                field=str(queries.source / "sensors" / "rigs.txt"),
                got=f"{rig_id}, {sensor_id}",
            )
        sensors.setdefault(rig_id, {})[sensor_id] = RigSensor(cam_from_rig)
    if not sensors:
        raise _no_rigs(queries, f"a kapture folder with sensors/rigs.txt{or_else}")
    return _grouped(queries.photos, rig_of, sensors)


def instants_of_map_rig(queries: QuerySet, info: MapInfo, rig_id: str) -> list[QueryInstant]:
    """Group the photos of a rig that the map knows by timestamp."""
    rigs = {rig.id: rig.sensors for rig in info.rigs}
    if rig_id not in rigs:
        raise refuse(
            "rig.unknown",
            field="rig",
            expected=f"one of {', '.join(rigs)}" if rigs else "a map that knows rigs",
            got=rig_id,
            ref=info.ref,
        )
    taken_by = {q.sensor_id for q in queries.photos if q.sensor_id is not None}
    rig_of = {sensor_id: rig_id if sensor_id in rigs[rig_id] else None for sensor_id in taken_by}
    if not any(rig_of.values()):
        cameras = ", ".join(rigs[rig_id])
        raise _no_rigs(queries, f"photos of cameras of rig {rig_id} of the map: {cameras}")
    return _grouped(queries.photos, rig_of, {rig_id: rig_id})


def _rig_of(queries: QuerySet, sensor_id: str) -> str | None:
    carriers = [rig_id for rig_id, members in queries.rigs.items() if sensor_id in members]
    if not carriers:
        return None
    # Every nested rig is listed with all of its cameras, so the outermost one has all of them.
    outermost = max(carriers, key=lambda rig_id: len(queries.rigs[rig_id]))
    others = [rig_id for rig_id in carriers if rig_id != outermost]
    if not all(queries.rigs[o].keys() < queries.rigs[outermost].keys() for o in others):
        raise refuse(
            "queries.rig_ambiguous",
            field=str(queries.source / "sensors" / "rigs.txt"),
            got=", ".join(carriers),
            sensor_id=sensor_id,
        )
    return outermost


def _grouped(
    photos: Sequence[Query], rig_of: Mapping[str, str | None], rigs: Mapping[str, Rig]
) -> list[QueryInstant]:
    grouped: dict[object, list[Query]] = {}
    for query in photos:
        rig_id = None if query.sensor_id is None else rig_of[query.sensor_id]
        key = query.name if rig_id is None else (rig_id, query.timestamp)
        grouped.setdefault(key, []).append(query)
    return [
        QueryInstant(rigs[key[0]] if isinstance(key, tuple) else _alone(together), tuple(together))
        for key, together in grouped.items()
    ]


def _alone(photos: Iterable[Query]) -> Rig:
    return {query.sensor: RigSensor(Pose.identity()) for query in photos}


def _no_rigs(queries: QuerySet, expected: str) -> VislocError:
    return refuse(
        "queries.no_rigs",
        field=str(queries.source),
        expected=expected,
        got=f"{len(queries.photos)} photos of cameras on their own",
    )
