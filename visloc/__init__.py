"""visloc: visual localization in maps made of posed photos.

Importing this package loads none of torch, pycolmap and OpenCV.
"""

from __future__ import annotations

from visloc.errors import (
    Conflict,
    DatasetError,
    InvalidInput,
    MapCorrupt,
    NotFound,
    Overloaded,
    TooLarge,
    Unavailable,
    VislocError,
    WeightsError,
)
from visloc.geometry import CAMERA_MODELS, Camera, Pose

__all__ = [
    "CAMERA_MODELS",
    "Camera",
    "Conflict",
    "DatasetError",
    "InvalidInput",
    "MapCorrupt",
    "NotFound",
    "Overloaded",
    "Pose",
    "TooLarge",
    "Unavailable",
    "VislocError",
    "WeightsError",
]
__version__ = "0.1.0"
