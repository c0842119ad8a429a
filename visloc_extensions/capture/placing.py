"""Size and up of a map whose photos have no positions on Earth.

A known length or markers of known size tell how long a unit of the reconstruction is. Which way is
up is guessed from how the cameras were held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from mapping.frames.known_length import Scale, scale_of_length
from mapping.frames.plan import up_of_cameras
from mapping.methods.sfm import UNPLACED
from mapping.stages.landmarks import MadeLandmarks, View
from mapping.stages.photos import MappingPhoto
from visloc.geometry import Similarity
from visloc_extensions.capture.markers import Sighting, marker_sides

_UP = np.array([0.0, 0.0, 1.0])
_DISAGREES = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Yardstick:
    """The sources that tell the unit of a map.

    Attributes:
        length: names of two photos and the metres between where they were taken; None without.
        marker_m: their side; None without markers.
    """

    length: tuple[str, str, float] | None = None
    sightings: Sequence[Sighting] = ()
    marker_m: float | None = None


def place(
    yardstick: Yardstick, photos: Sequence[MappingPhoto], made: MadeLandmarks
) -> MadeLandmarks:
    """Give landmarks their size and turn the world so that z points up.

    Where the unit of the world is a metre already, by GPS or a scan, the size that the yardstick
    tells is only compared. A world that something else fixed is not turned.
    """
    views = {photos[row].name: v for row, v in zip(made.photos.tolist(), made.views, strict=True)}
    scale = _scale(yardstick, views)
    if made.metric:
        return replace(made, notes=(*made.notes, *_disagreement(scale, made)))
    metres = 1.0 if scale is None or scale.metres is None else scale.metres
    up = None
    if made.anchor.kind == "none":
        up = up_of_cameras(np.array([view.cam_from_world.rotation for view in made.views]))
    turn = np.eye(3) if up is None else _turned_up(up)
    # Once the size is known, the unit is not arbitrary; that z was guessed has a note of its own.
    has_size = scale is not None and scale.metres is not None
    notes = [note for note in made.notes if not (has_size and note == UNPLACED)]
    if scale is not None:
        notes.append(scale.note)
    if up is not None:
        notes.append("z points up as the cameras were held; it was not measured")
    rms = made.anchor.rms
    return replace(
        _moved(made, Similarity(metres, turn, np.zeros(3))),
        metric=has_size,
        anchor=made.anchor.model_copy(update={"rms": None if rms is None else rms * metres}),
        settings={**made.settings, **({} if scale is None else {"scale": dict(scale.record)})},
        notes=tuple(notes),
    )


def _moved(made: MadeLandmarks, similarity: Similarity) -> MadeLandmarks:
    landmarks = made.landmarks
    origin = similarity.apply(landmarks.origin)
    points = similarity.apply(landmarks.points.astype(np.float64) + landmarks.origin) - origin
    return replace(
        made,
        views=tuple(View(v.camera, similarity.move(v.cam_from_world)) for v in made.views),
        landmarks=replace(landmarks, origin=origin, points=points.astype(np.float32)),
        rig_scale=None if made.rig_scale is None else made.rig_scale * similarity.scale,
    )


def _scale(yardstick: Yardstick, views: Mapping[str, View]) -> Scale | None:
    if yardstick.length is not None:
        centers = {name: view.cam_from_world.center for name, view in views.items()}
        return scale_of_length(*yardstick.length, centers)
    if yardstick.marker_m is not None:
        return _scale_of_markers(yardstick.sightings, yardstick.marker_m, views)
    return None


def _scale_of_markers(
    sightings: Sequence[Sighting], marker_m: float, views: Mapping[str, View]
) -> Scale:
    sides = marker_sides(sightings, views)
    if not sides:
        return Scale(None, "no scale: no marker is seen well enough from two places", {})
    scales = marker_m / np.array(list(sides.values()))
    metres = float(np.median(scales))
    spread = float(np.median(np.abs(scales - metres))) / metres
    record: dict[str, JsonValue] = {"by": "markers", "markers": len(sides), "metres": marker_m}
    note = f"scale: {len(sides)} markers of {marker_m:g} m, which differ by {spread:.1%} (median)"
    return Scale(metres, note, record)


def _disagreement(scale: Scale | None, made: MadeLandmarks) -> list[str]:
    if scale is None:
        return []
    if scale.metres is None:
        return [scale.note]
    if abs(scale.metres - 1.0) <= _DISAGREES:
        return []
    return [
        f"the scale by {made.anchor.kind} was kept, though what was said of lengths makes a metre "
        f"of the map {scale.metres:.2f} m ({scale.note})"
    ]


def _turned_up(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The smallest rotation (3, 3) that takes a unit vector to z."""
    axis, cosine = np.cross(up, _UP), float(up @ _UP)
    if cosine < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + cosine))
