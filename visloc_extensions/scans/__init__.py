"""Importers of scans of phones with poses of ARKit, as apps write them.

Here: whose scan a folder is, which keeps it from being taken for photos or a dataset. It needs the
extension ``films``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

_CAMERAS = ("corrected_cameras/*.json", "cameras/*.json")
# Importer -> where its cameras and poses are, and words that these files have.
_APPS: Mapping[str, tuple[tuple[str, ...], tuple[bytes, ...]]] = {
    "3dscannerapp": (("frame_*.json",), (b'"cameraPoseARFrame"',)),
    "nerfcapture": (("transforms.json",), (b'"depth_path"',)),
    "polycam": ((*_CAMERAS, *(f"keyframes/{each}" for each in _CAMERAS)), (b'"t_00"', b'"fx"')),
    "record3d": (("metadata", "metadata.json", "EXR_RGBD/metadata.json"), (b'"poses"', b'"K"')),
    "strayscanner": (("odometry.csv",), (b"frame", b"qx")),
}
_LONGEST = 2**26  # bytes that are looked through


def app_of(path: Path) -> str | None:
    """Return the importer that reads a scan, None for what is none that is known."""
    if path.suffix.lower() == ".r3d" and path.is_file():
        return "record3d"
    for app, (patterns, words) in _APPS.items() if path.is_dir() else ():
        files = (file for each in patterns for file in path.glob(each) if file.is_file())
        if (first := next(files, None)) is not None and _has_words(first, words):
            return app
    return None


def _has_words(path: Path, words: tuple[bytes, ...]) -> bool:
    try:
        with path.open("rb") as file:
            text = file.read(_LONGEST)
    except OSError:
        return False
    return all(word in text for word in words)
