"""A map that is tied to the Earth, and GeoPoses in it."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

from mapping.frames.georeference import given_place, publish_anchored
from visloc.archive import MapStore
from visloc.geometry import Pose
from visloc.geopose import geopose_of

LATITUDE, LONGITUDE, ALTITUDE = 45.2178, 5.8083, 310.0


def write_anchored(built_maps: Path, maps: Path) -> None:
    """Write the map ``room``, its x axis pointing north."""
    shutil.copytree(built_maps, maps)
    room = MapStore(maps).open("room")
    place = (LATITUDE, LONGITUDE, ALTITUDE)
    found = given_place(room, place, 90.0, accuracy=0.1, gravity=(0.0, 0.0, -1.0))
    publish_anchored(room, found, maps, force=False)


def true_geopose(anchored_maps: Path, cam_from_world: Pose) -> dict[str, Any]:
    geodetic = MapStore(anchored_maps).open("room").geodetic
    assert geodetic is not None
    found = geopose_of(cam_from_world, geodetic)
    w, x, y, z = found.quaternion_wxyz.tolist()
    return {
        "position": {"lat": found.latitude, "lon": found.longitude, "h": found.height},
        "quaternion": {"x": x, "y": y, "z": z, "w": w},
    }


def is_near(found: dict[str, Any], true: dict[str, Any]) -> bool:
    """Within half a metre and three degrees."""
    f, t = found["position"], true["position"]
    metres = math.hypot(
        (f["lat"] - t["lat"]) * 111_000,
        (f["lon"] - t["lon"]) * 111_000 * math.cos(math.radians(LATITUDE)),
        f["h"] - t["h"],
    )
    dot = sum(found["quaternion"][name] * true["quaternion"][name] for name in "xyzw")
    return metres < 0.5 and 2 * math.acos(min(abs(dot), 1.0)) < math.radians(3)
