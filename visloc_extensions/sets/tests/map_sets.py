"""What tests of sets of maps share: two rooms, and where they lie in their sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.service.rooms import build_upright, copy_map, quiet
from visloc.archive import MapStore
from visloc.geometry import Similarity
from visloc_extensions.sets.publishing import publish_set


def turned(degrees: float, scale: float, *translation: float) -> Similarity:
    """About the world's z axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return Similarity(scale, rotation, np.array(translation))


# Where the two rooms lie in the set.
SITE_FROM_ROOM = turned(30, 1.0, 100.0, -20.0, 3.0)
SITE_FROM_STUDY = turned(-75, 1.0, -50.0, 40.0, 6.0)
# The same room in a set of another unit.
MODEL_FROM_ROOM = turned(90, 0.1, 1.0, 2.0, 3.0)


def write_site(maps: Path) -> None:
    """Add ``copy``, which is ``room`` again, and sets of it, ``room`` and ``study``."""
    copy_map(maps, "room", "copy", "v1")
    (maps / "copy" / "current").write_text("v1")
    store = MapStore(maps)
    rooms = [("room", SITE_FROM_ROOM), ("study", SITE_FROM_STUDY)]
    publish_set(store, "site", rooms, quiet)
    publish_set(store, "twice", [("room", SITE_FROM_ROOM), ("copy", SITE_FROM_STUDY)], quiet)
    publish_set(store, "model", [("room", MODEL_FROM_ROOM)], quiet)


def write_upright_site(sample: Path, study: Path, maps: Path) -> None:
    """Write ``room``, ``study`` and a set with XFeat."""
    build_upright(sample, "room", maps)
    build_upright(study, "study", maps)
    rooms = [("room", SITE_FROM_ROOM), ("study", SITE_FROM_STUDY)]
    publish_set(MapStore(maps), "site", rooms, quiet)
