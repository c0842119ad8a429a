"""Whether the GNSS fixes that a map keeps contradict where its anchor puts it on Earth."""

from __future__ import annotations

import numpy as np

from mapping.frames.anchor import EPSG_GEODETIC, GNSS_ERROR_M
from visloc.archive import Anchor, Map
from visloc.archive.gnss import read_fixes
from visloc.archive.places import enu_of, origin_of
from visloc.geodesy import enu_from_geodetic
from visloc.geometry import Pose

# An anchor says how far off it is as a root mean square; so many times that is unlikely.
_ANCHOR_DEVIATIONS = 3.0


def contradiction_of_fixes(opened: Map, anchor: Anchor) -> str | None:
    """Compare the photos with the fixes at their timestamps, east and north.

    kapture's fixes have no accuracy, so ``GNSS_ERROR_M`` stands for it, as where a map is aligned
    to fixes. Altitudes are not compared: receivers often state them above another zero.

    Returns:
        What to tell when the median distance is larger than the fixes and the anchor allow. None
        for a map without fixes in degrees at the times of its photos, or without a place on Earth.
    """
    kept, geodetic = read_fixes(opened.path, opened.manifest.files), anchor.geodetic
    if kept is None or geodetic is None:
        return None
    fixes = {
        fix.timestamp: (fix.y, fix.x, fix.z)
        for fix in kept.fixes
        if kept.receivers[fix.receiver][:1] in [(system,) for system in EPSG_GEODETIC]
    }
    rows = [row for row, image in enumerate(opened.images) if image.timestamp in fixes]
    if not rows:
        return None
    told = np.array([fixes[opened.images[row].timestamp] for row in rows])
    poses = (Pose.from_quaternion(pose[:4], pose[4:]) for pose in opened.image_poses[rows])
    put = enu_of(np.array([pose.center for pose in poses]), geodetic)
    off = enu_from_geodetic(told, np.asarray(origin_of(geodetic))) - put
    metres = float(np.median(np.linalg.norm(off[:, :2], axis=1)))
    allowed = GNSS_ERROR_M + _ANCHOR_DEVIATIONS * geodetic.scale * (anchor.rms or 0.0)
    if metres <= allowed:
        return None
    return (
        f"the GNSS fixes that the map keeps contradict its place on Earth: {len(rows)} photos lie "
        f"{metres:.0f} m from their fixes in the median, at most {allowed:.0f} m is plausible; "
        "check the anchor, or the fixes in gnss.json"
    )
