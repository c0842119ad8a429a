"""The photos of a dataset, put together as its rigs took them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from clients.evaluation.queries import Query, QuerySet
from clients.wire.rigs import Rig, RigSensor
from clients.wire.types import MapInfo
from visloc.errors import VislocError, refuse
from visloc.geometry import Pose


@dataclass(frozen=True, slots=True, eq=False)
class QueryInstant:
    """Photos that were taken together.

    Attributes:
        rig: how their cameras sit, or the id of a rig of the map; a camera without a rig is a rig
            of its own.
        photos: each of another camera, in the order of the dataset.
    """

    rig: Rig
    photos: tuple[Query, ...]


def instants_of_dataset(queries: QuerySet, *, or_else: str = "") -> list[QueryInstant]:
    """Put photos of one rig and one timestamp together, in the order of their first ones.

    The rig of a camera is the outermost one that carries it.

    Args:
        queries: the photos and the rigs.
        or_else: what would do instead of rigs, for errors.

    Raises:
        DatasetError: ``queries.no_rigs`` when no photo was taken by a rig;
            ``queries.rig_ambiguous`` when a camera is carried by several rigs;
            ``queries.rig_transform`` when it is not known where it sits.
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
    """Put photos of one rig that the map knows and of one timestamp together.

    Raises:
        NotFound: ``rig.unknown``.
        DatasetError: ``queries.no_rigs`` when no photo was taken by one of its cameras.
    """
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
    # Nested rigs are all listed with all their cameras: the outermost has those of the others.
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
