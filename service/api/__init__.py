"""Between the words of the API and the values of the engine: requests in, answers out."""

from __future__ import annotations

from service.api.geopose import (
    Near,
)
from service.api.localize import (
    LocalizeRequest,
)
from service.api.rigs import (
    MAX_SENSORS,
    BatchLimits,
    LocalizeRigRequest,
    Parts,
    RigCalibration,
    RigImage,
    RigSensor,
)
from service.api.sequences import (
    Instant,
    LocalizeSequenceRequest,
    Odometry,
    SequenceStart,
)
from visloc_api.words.answers import (
    InstantAnswer,
    LocalizeResponse,
    LocalizeSequenceResponse,
)
from visloc_api.words.features import (
    MAX_GLOBAL_DESCRIPTORS,
    Array,
    Features,
)
from visloc_api.words.geometry import (
    Camera,
)
from visloc_api.words.maps import (
    ListMapsResponse,
    MapInfo,
    UseVersionRequest,
)
from visloc_api.words.options import (
    LocalizeOptions,
)
from visloc_api.words.scenes import (
    MapImages,
)
from visloc_api.words.status import (
    Health,
    MapNotLoaded,
    Problem,
    Readiness,
)

__all__ = [
    "MAX_GLOBAL_DESCRIPTORS",
    "MAX_SENSORS",
    "Array",
    "BatchLimits",
    "Camera",
    "Features",
    "Health",
    "Instant",
    "InstantAnswer",
    "ListMapsResponse",
    "LocalizeOptions",
    "LocalizeRequest",
    "LocalizeResponse",
    "LocalizeRigRequest",
    "LocalizeSequenceRequest",
    "LocalizeSequenceResponse",
    "MapImages",
    "MapInfo",
    "MapNotLoaded",
    "Near",
    "Odometry",
    "Parts",
    "Problem",
    "Readiness",
    "RigCalibration",
    "RigImage",
    "RigSensor",
    "SequenceStart",
    "UseVersionRequest",
]
