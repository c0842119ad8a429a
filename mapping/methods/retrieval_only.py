"""No landmarks: a map of posed photos, whose queries triangulate around themselves.

See ``visloc.localization.map_view.local_model``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapping.stages.context import BuildContext
from mapping.stages.landmarks import MadeLandmarks, View, only_observations
from mapping.stages.photos import MappingPhoto
from visloc.archive import Anchor, Map
from visloc.errors import refuse

RETRIEVAL_ONLY = "retrieval-only"


def no_landmarks(
    context: BuildContext, photos: Sequence[MappingPhoto], *, metric: bool
) -> MadeLandmarks:
    """Keep all local features of the photos, for queries to match and triangulate.

    Args:
        metric: whether a unit of the dataset's poses is a metre.
    """
    keypoints = [context.features.read(photo).keypoints for photo in photos]
    if not any(map(len, keypoints)):
        raise refuse("retrieval_only.no_keypoints", field="dataset")
    views = tuple(View(photo.camera, photo.pose) for photo in photos)
    return MadeLandmarks(
        photos=np.arange(len(photos)),
        views=views,
        landmarks=only_observations(views, keypoints),
        rows=tuple(np.arange(len(each)) for each in keypoints),
        settings={},
        metric=metric,
        anchor=Anchor(kind="dataset", images=len(photos)),
    )


def refuse_without_landmarks(opened: Map) -> None:
    """Refuse what needs the landmarks of a map, which one of this method does not have."""
    if not opened.has_landmarks:
        raise refuse("map.no_landmarks", field="MAP", ref=opened.ref)
