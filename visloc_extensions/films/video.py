"""Videos, safely: frames one after the other, upright, with what the container tells of the camera.

Files are hostile: ``mapping.importers.films`` opens them, and frames are counted. At most a few
decoded frames are in memory at a time.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mapping.importers.films import opened_film, square_size, unreadable_film
from visloc.errors import refuse
from visloc_extensions.films.tone import is_high_range, to_standard_range

SUFFIXES = (".mp4", ".m4v", ".mov", ".webm", ".mkv", ".3gp", ".3g2")
SHARPNESS_SIDE = 960  # of the longer side: motion blur of a pixel or two is visible at this size
_JPEG_QUALITY = 95
# More than an hour at 60 frames a second: of one place, nobody films as long.
_MAX_FRAMES, _MAX_SECONDS = 250_000, 4 * 3600.0
# Damaged packets are passed over up to this number in a row.
_MAX_DAMAGED = 300
_ISO6709 = re.compile(r"([+-]\d{2}(?:\.\d+)?)([+-]\d{3}(?:\.\d+)?)([+-]\d+(?:\.\d+)?)?")
# CIPA DCG-001, as visloc.photos.reading: the 35 mm equivalent compares diagonals.
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
# Of the longer side, as for EXIF: what lies outside was written by mistake.
_PLAUSIBLE_FOCAL = (0.25, 50.0)
_APPLE = "com.apple.quicktime."
_MAKE, _MODEL = (
    (f"{_APPLE}make", "make", "com.android.manufacturer"),
    (
        f"{_APPLE}model",
        "model",
        "com.android.model",
    ),
)
_PLACE = (f"{_APPLE}location.ISO6709", "location", "location-eng")
_FOCAL_35MM = (f"{_APPLE}camera.focal_length.35mm_equivalent",)


@dataclass(frozen=True, slots=True)
class VideoFacts:
    """What a container tells of its video before a frame is decoded.

    Attributes:
        width: in square pixels, before they are turned upright.
        height: in square pixels.
        seconds: as the container says; 0 when it does not.
        device: make and model; may be empty.
        focal_length_px: None when the container does not tell it, as most do not.
        position: latitude, longitude (degrees) and altitude (m, None when unknown); None without.
    """

    width: int
    height: int
    seconds: float
    device: str
    focal_length_px: float | None
    position: tuple[float, float, float | None] | None


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame.

    Attributes:
        seconds: its presentation time, counted from the video's first frame.
        decoded: the pixels as stored.
        size: width and height of the same picture in square pixels.
    """

    seconds: float
    decoded: av.VideoFrame
    size: tuple[int, int]

    @property
    def quarter_turns(self) -> int:
        """How many quarter turns to the left make it upright, by the container's matrix.

        Mirroring is left out: a mirrored picture has no camera.
        """
        return round(self.decoded.rotation / 90.0) % 4

    def grey(self, longer_side: int) -> NDArray[np.uint8]:
        """(h, w), not turned, scaled so that its longer side is at most ``longer_side``."""
        width, height = self.size
        scale = min(1.0, longer_side / max(width, height))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        small = self.decoded.reformat(*size, format="gray8", interpolation="AREA")
        return np.asarray(small.to_ndarray(), dtype=np.uint8)

    def rgb(self) -> NDArray[np.uint8]:
        """(H, W, 3) in square pixels, not turned; HDR as a standard picture."""
        if is_high_range(self.decoded):
            rgb = to_standard_range(self.decoded)
        else:
            rgb = np.asarray(self.decoded.to_ndarray(format="rgb24"), dtype=np.uint8)
        if rgb.shape[1::-1] != self.size:
            rgb = np.asarray(cv2.resize(rgb, self.size, interpolation=cv2.INTER_CUBIC), np.uint8)
        return rgb

    def upright_rgb(self) -> NDArray[np.uint8]:
        """(H, W, 3) as ``rgb``, upright."""
        return np.ascontiguousarray(np.rot90(self.rgb(), self.quarter_turns))


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of grey levels (h, w), comparable among near frames."""
    return float(cv2.Laplacian(cv2.GaussianBlur(grey, (3, 3), 0), cv2.CV_32F).var())


def write_jpeg(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write a picture, whole or not at all."""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    unfinished = path.with_suffix(f".{os.getpid()}.tmp")
    unfinished.write_bytes(encoded.tobytes())
    unfinished.replace(path)


def video_facts(path: Path) -> VideoFacts:
    """Read what the container tells."""
    with opened_film(path) as (container, stream):
        tags = {**container.metadata, **stream.metadata}
        width, height = square_size(path, stream)
        return VideoFacts(
            width=width,
            height=height,
            seconds=max(0.0, (container.duration or 0) / av.time_base),
            device=" ".join(filter(None, (_text(tags, _MAKE), _text(tags, _MODEL)))),
            focal_length_px=_focal_length_px(_text(tags, _FOCAL_35MM), width, height),
            position=_position(_text(tags, _PLACE)),
        )


def frames_of(path: Path) -> Iterator[Frame]:
    """Decode a video's frames in the order in which they are shown.

    Frames without a time or not later than the one before, and damaged ones, are passed over.
    """
    first, last, count, damaged = None, -math.inf, 0, 0
    with opened_film(path) as (container, stream):
        size = stream.codec_context.width, stream.codec_context.height
        square = square_size(path, stream)
        for packet in container.demux(stream):
            try:
                decoded = packet.decode()
            except FFmpegError as error:
                damaged += 1
                if damaged > _MAX_DAMAGED:
                    raise unreadable_film(path, error) from error
                continue
            damaged = 0
            for frame in decoded:
                count += 1
                time = frame.time
                if time is None or time <= last or (frame.width, frame.height) != size:
                    continue
                first = time if first is None else first
                last = time
                if count > _MAX_FRAMES or time - first > _MAX_SECONDS:
                    raise refuse("capture.video_length", field=str(path), got="more")
                yield Frame(time - first, frame, square)


def _text(tags: dict[str, str], names: tuple[str, ...]) -> str:
    found = next((tags[name] for name in names if tags.get(name)), "")
    return " ".join(found.replace(",", " ").split()) if found.isprintable() else ""


def _focal_length_px(text: str, width: int, height: int) -> float | None:
    try:
        focal = float(text) * math.hypot(width, height) / _DIAGONAL_35MM
    except ValueError:
        return None
    low, high = (share * max(width, height) for share in _PLAUSIBLE_FOCAL)
    return focal if low <= focal <= high else None  # False for NaN


def _position(text: str) -> tuple[float, float, float | None] | None:
    found = _ISO6709.match(text)
    if found is None:
        return None
    latitude, longitude = float(found[1]), float(found[2])
    if abs(latitude) > 90 or abs(longitude) > 180 or (latitude, longitude) == (0.0, 0.0):
        return None
    return latitude, longitude, None if found[3] is None else float(found[3])
