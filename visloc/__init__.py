"""visloc: visual localization in maps made of posed photos.

Importing this package loads none of torch, pycolmap and OpenCV; ``open_map`` and ``plot`` do when
they are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from visloc import plot
    from visloc.in_process import open_map

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
    "open_map",
    "plot",
]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    # By name, not by an import statement: whoever imports visloc does not depend on these.
    if name == "open_map":
        return import_module("visloc.in_process").open_map
    if name == "plot":
        return import_module("visloc.plot")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
