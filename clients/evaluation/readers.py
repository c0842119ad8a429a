"""Readers of what is sent for a query: the photo, or its ready-made features."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clients.evaluation.queries import Query
from clients.evaluation.sent_matches import PhotoMatches
from clients.wire.features import Features
from clients.wire.requests import read_image
from visloc.errors import refuse
from visloc.geometry import PixelOrigin
from visloc.kapture import (
    READY_MADE_PREFIX,
    FeatureSet,
    open_features,
    open_local_features,
    read_local,
)
from visloc_api.words.maps import MapInfo

Reader = Callable[[Query], bytes | Features]


@dataclass(frozen=True, slots=True, eq=False)
class FeatureReader:
    """Reads the ready-made features of a dataset's photos.

    Attributes:
        kind: the map's name for the local features.
        global_features: by the map's names for them.
        origin: where the keypoints' pixel coordinates start counting.
        matches: with mapping photos, whose features are in the same place; None to let the server
            match.
    """

    kind: str
    keypoints: FeatureSet
    descriptors: FeatureSet
    global_features: dict[str, FeatureSet]
    origin: PixelOrigin
    matches: PhotoMatches | None = None

    def __call__(self, query: Query) -> Features:
        """Read the features of one photo."""
        if query.camera is None:
            raise refuse(
                "camera.required",
                field=query.name,
                expected="its model, size and parameters in sensors.txt",
            )
        size = query.camera.width, query.camera.height
        keypoints, descriptors = read_local(
            self.keypoints, self.descriptors, query.name, size, self.origin
        )
        if descriptors.dtype != np.uint8:  # of what kapture has, only these can be sent as they are
            descriptors = descriptors.astype(np.float32, copy=False)
        return Features(
            self.kind,
            keypoints,
            descriptors,
            {
                name: features.read(query.name)[0].astype(np.float32)
                for name, features in self.global_features.items()
            },
            {} if self.matches is None else self.matches.of(query.name, self._keypoints),
        )

    def _keypoints(self, name: str) -> NDArray[np.float32]:
        return read_local(self.keypoints, self.descriptors, name, None, self.origin)[0]


def takes_features(info: MapInfo) -> bool:
    """Return whether a map has ready-made features, and so takes no photos."""
    names = (info.local_features, *info.global_features)
    return any(name.startswith(READY_MADE_PREFIX) for name in names)


def choose_reader(
    source: Path,
    info: MapInfo,
    features_dir: Path | None,
    origin: PixelOrigin,
    matches: PhotoMatches | None = None,
) -> Reader:
    """Return the reader of what a map takes.

    A map with ready-made features, local or global, takes features of the same types, from the
    dataset or from ``features_dir``; any other takes photos. A request has either a photo or
    features. If only the global features are ready-made, the local ones are read from the folder
    of their name, as ``mapping export-features`` writes them.
    """
    ready_made = [name for name in info.global_features if name.startswith(READY_MADE_PREFIX)]
    if matches is not None and not info.local_features.startswith(READY_MADE_PREFIX):
        raise refuse("queries.matches_dir", field="--matches-dir", got=info.local_features)
    if not takes_features(info):
        if features_dir is not None:
            raise refuse(
                "queries.features_dir",
                field="features_dir",
                expected=f"a map with features {READY_MADE_PREFIX}TYPE",
                got=", ".join((info.local_features, *info.global_features)),
                ref=info.ref,
            )
        return lambda query: read_image(query.path)
    if not source.is_dir():
        raise refuse(
            "queries.no_features",
            field=str(source),
            expected=f"a kapture folder with {', '.join((info.local_features, *ready_made))}",
            ref=info.ref,
        )
    kind = info.local_features
    keypoints, descriptors = open_local_features(
        source, kind.removeprefix(READY_MADE_PREFIX), features_dir
    )
    global_features = {
        name: open_features(
            source, "global_features", name.removeprefix(READY_MADE_PREFIX), features_dir
        )
        for name in ready_made
    }
    return FeatureReader(kind, keypoints, descriptors, global_features, origin, matches)
