"""Where the maps of a set lie: as a file says, or as their places on Earth do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from visloc.archive import Geodetic, MapStore
from visloc.archive.places import origin_of
from visloc.archive.set_schema import MAX_SCALE, MIN_SCALE
from visloc.errors import InvalidInput, refuse
from visloc.geodesy import ecef_from_geodetic, enu_from_ecef
from visloc.geometry import Pose, Similarity

_LINE = "map qw qx qy qz tx ty tz [scale]"


def read_poses(path: Path, refs: Sequence[str]) -> list[tuple[str, Similarity]]:
    """Read where maps lie in the frame of a set, from lines ``map qw qx qy qz tx ty tz [scale]``.

    Blank lines, and what follows ``#``, do not count.

    Args:
        refs: of the maps as they were given; each has one line, under the same name.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise refuse(
            "set.poses", "the file cannot be read", field=str(path), expected="a text file"
        ) from error
    found: dict[str, Similarity] = {}
    for number, line in enumerate(lines, 1):
        name, *fields = line.partition("#")[0].split() or [""]
        if not name:
            continue
        where = f"{path}:{number}"
        if name in found or name not in refs:
            raise refuse(
                "set.poses",
                "the map has two lines"
                if name in found
                else "this is not one of the maps of the set",
                field=where,
                expected=f"one line for each of {', '.join(refs)}",
                got=name,
            )
        found[name] = _parsed(fields, where)
    absent = [ref for ref in refs if ref not in found]
    if absent:
        raise refuse(
            "set.poses", "a map has no line", field=str(path), expected=_LINE, got=absent[0]
        )
    return [(ref, found[ref]) for ref in refs]


def poses_on_earth(store: MapStore, refs: Sequence[str]) -> list[tuple[str, Similarity]]:
    """Say where maps lie that are tied to the Earth.

    The frame has metres east, north and up of the first map's origin on Earth.

    Args:
        refs: of the maps, at least one.
    """
    places = [_place(store, ref) for ref in refs]
    return [
        (ref, set_from_world(place, places[0])) for ref, place in zip(refs, places, strict=True)
    ]


def set_from_world(geodetic: Geodetic, origin: Geodetic) -> Similarity:
    """Return what takes a world to metres east, north and up of the origin of another one."""
    pose = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation)
    enu_from_map = Similarity(geodetic.scale, pose.rotation, pose.translation)
    here, there = origin_of(origin), origin_of(geodetic)
    to_origin = enu_from_ecef(here)
    # Differences of positions near each other, far from the centre of the Earth.
    offset = to_origin @ (ecef_from_geodetic(there[None]) - ecef_from_geodetic(here[None]))[0]
    turn = to_origin @ enu_from_ecef(there).T
    return Similarity(1.0, turn, offset) @ enu_from_map


def _place(store: MapStore, ref: str) -> Geodetic:
    geodetic = store.outline(ref).geodetic
    if geodetic is None:
        raise refuse(
            "set.poses",
            f"{ref} is not anchored to the Earth, so its place in the set is unknown",
            field="MAP",
            expected="--poses FILE, or maps that `mapping anchor` tied to the Earth",
        )
    return geodetic


def _parsed(fields: Sequence[str], where: str) -> Similarity:
    try:
        numbers = [float(field) for field in fields]
    except ValueError:
        numbers = []
    scale = numbers[7] if len(numbers) == 8 else 1.0
    if len(numbers) not in (7, 8) or not MIN_SCALE <= scale <= MAX_SCALE:
        raise refuse("set.poses", field=where, expected=_LINE, got=" ".join(fields))
    try:
        pose = Pose.from_quaternion(numbers[:4], numbers[4:7])
    except InvalidInput as error:
        raise error.about(where, InvalidInput) from error
    return Similarity(scale, pose.rotation, pose.translation)
