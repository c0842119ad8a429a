"""``sensor_msgs/Image`` and ``CompressedImage`` as pictures."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse

_DEPTHS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
# Channels by encoding, and the order in which they are red, green, blue.
_COLORS: dict[str, tuple[int, tuple[int, ...]]] = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "mono8": (1, (0,)),
    "8UC1": (1, (0,)),
}
_MAX_PIXELS = 50_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A photo of a bag: an encoded file, or pixels.

    Attributes:
        time_ns: of the header, when it was taken.
        frame: the camera's optical frame, without a leading slash.
        encoded: the file as published (JPEG or PNG); None for raw pictures.
        pixels: (H, W, 3) RGB or (H, W) grey, uint8; None for encoded ones.
    """

    topic: str
    time_ns: int
    frame: str
    encoded: bytes | None
    pixels: NDArray[np.uint8] | None

    def file(self) -> bytes:
        """Return the photo as a file: as published, or as PNG."""
        if self.encoded is not None:
            return self.encoded
        assert self.pixels is not None
        return _png(self.pixels)


def is_depth(message: Any, topic: str) -> bool:
    """Tell whether an ``Image`` holds depth (REP 118); grey of 16 bits only by its topic's name."""
    encoding = getattr(message, "encoding", "")
    return encoding in _DEPTHS and (encoding != "mono16" or "depth" in topic.lower())


def has_known_colors(message: Any) -> bool:
    """Tell whether ``pixels_of`` knows the encoding of an ``Image``."""
    return getattr(message, "encoding", "") in _COLORS


def pixels_of(message: Any, topic: str) -> NDArray[np.uint8]:
    """Return the pixels of an ``Image``, (H, W, 3) RGB or (H, W) grey."""
    if message.encoding not in _COLORS:
        raise refuse("bag.picture", field=topic, expected=_COLORS, got=message.encoding)
    channels, order = _COLORS[message.encoding]
    rows = _rows(message, topic, channels, np.dtype(np.uint8))
    return rows[..., 0] if channels == 1 else np.ascontiguousarray(rows[..., order])


def depth_in_metres(message: Any, topic: str) -> NDArray[np.float32]:
    """Return the depth of an ``Image``, (H, W); 0 where there is none (REP 118)."""
    if message.encoding not in _DEPTHS:
        raise refuse("bag.picture", field=topic, expected=_DEPTHS, got=message.encoding)
    kind = np.dtype(_DEPTHS[message.encoding])
    depth = _rows(message, topic, 1, kind)[..., 0]
    if kind == np.uint16:
        return np.asarray(depth.astype(np.float32) / 1000, np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def _rows(message: Any, topic: str, channels: int, kind: np.dtype[Any]) -> NDArray[Any]:
    height, width, step = int(message.height), int(message.width), int(message.step)
    needed = width * channels * kind.itemsize
    data = np.asarray(message.data, np.uint8).reshape(-1)
    if (
        not 0 < height * width <= _MAX_PIXELS
        or step < needed
        or len(data) < step * (height - 1) + needed
    ):
        raise refuse(
            "bag.picture",
            "the bytes of a picture are not as many as its size needs",
            field=topic,
            expected=f"{height} rows of at least {needed} bytes",
            got=f"{len(data)} bytes, {step} per row",
        )
    whole = np.zeros(step * height, np.uint8)
    whole[: min(len(data), len(whole))] = data[: len(whole)]
    rows = whole.reshape(height, step)[:, :needed].copy()
    ordered = kind.newbyteorder(">" if message.is_bigendian else "<")
    return rows.view(ordered).reshape(height, width, channels)


def _png(pixels: NDArray[np.uint8]) -> bytes:
    """Encode (H, W, 3) or (H, W) pixels without a library, as clients have none for pictures."""
    height, width = pixels.shape[:2]
    rows = np.zeros((height, 1 + pixels[0].size), np.uint8)  # each begins with its filter, none
    rows[:, 1:] = pixels.reshape(height, -1)
    kind = 2 if pixels.ndim == 3 else 0
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows.tobytes(), 1)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
