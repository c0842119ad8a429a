"""Photos that a map took for its own, each beside the mapping photo taken most alike.

Green: a keypoint looks like the landmark that the map expects there. Red: it looks like something
else. Red marks that lie together are what could have told the places apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.trust.asking import OPTIONS, Maps
from benchmarks.trust.maps import Places
from benchmarks.trust.outcomes import Outcome, Query
from visloc.geometry import Pose
from visloc.localization.acceptance.evidence import SeenView, compared_landmarks
from visloc.localization.acceptance.gates import registration_for
from visloc.localization.solving import SeenImage
from visloc.photos.reading import read_photo_file

_HEIGHT = 540
_ALIKE, _DIFFERENT = (0, 200, 0), (255, 0, 0)


def ask_and_draw(
    maps: Maps, queries: Iterable[Query], places: Places, folder: Path
) -> Iterator[Outcome]:
    """Ask like ``maps.ask``, and draw each single photo that was wrongly believed.

    Args:
        maps: are asked.
        queries: of maps.
        places: where the mapping photos lie.
        folder: gets a PNG for each wrong answer, ``MAP-PHOTO.png``.
    """
    for query in queries:
        for outcome in maps.ask([query]):
            if outcome.accepted and outcome.right is False and len(query.photos) == 1:
                folder.mkdir(parents=True, exist_ok=True)
                name = f"{query.map_id}-{Path(query.name).stem}.png"
                picture = _beside(maps, query, places)
                cv2.imwrite(str(folder / name), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
            yield outcome


def _beside(maps: Maps, query: Query, places: Places) -> NDArray[np.uint8]:
    localizer, (only,) = maps.localizer(query.map_id), query.photos
    geometry = localizer.geometry
    look = localizer.look(only.photo, only.camera, OPTIONS)
    solved = localizer.solve([SeenImage(only.sensor, Pose.identity(), look)], OPTIONS)
    assert solved.pose is not None  # equal questions have equal answers
    assert look.shown is not None
    (view,), pose = solved.views, solved.pose.rig_from_world
    seen = SeenView(view, look.shown, solved.inliers[0])
    threshold = registration_for(OPTIONS, [view.camera]).max_error_px
    pixels, alike = compared_landmarks(geometry, seen, pose, threshold)
    asked = only.photo.rgb.copy()
    radius = max(2, only.photo.height // 200)
    for (x, y), is_alike in zip(pixels, alike, strict=True):
        color = _ALIKE if is_alike else _DIFFERENT
        cv2.circle(asked, (int(x), int(y)), radius, color, -1)
    photo = geometry.photo_name(int(np.argmin(geometry.viewpoints.apart_from(pose))))
    folder = places.dataset(query.map_id, "mapping") / "sensors" / "records_data"
    return np.hstack([_scaled(asked), _scaled(read_photo_file(folder / photo).rgb)])


def _scaled(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = rgb.shape[:2]
    size = max(1, round(width * _HEIGHT / height)), _HEIGHT
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
