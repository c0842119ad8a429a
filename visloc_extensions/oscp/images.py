"""Photos of the OSCP GeoPose protocol: base64 in many spellings, of files or of bare pixels."""

from __future__ import annotations

import struct
import zlib

import numpy as np

from visloc.errors import refuse
from visloc_api.words.json_text import bytes_of_base64

# JPEG, PNG, TIFF; RIFF is followed by the name WEBP. Two letters of BMP say too little.
_FILE_BEGINNINGS = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*", b"RIFF")
_GREY, _RGB = 0, 2  # colour types of PNG


def image_bytes(
    text: str, image_format: str | None, size: tuple[int, int] | None, max_bytes: int
) -> bytes:
    """Return the encoded photo of a camera reading.

    What the reading says of its format is not believed, as clients send JPEG under the name of
    RGBA32: a file is known by its first bytes, bare pixels by their number.

    Args:
        text: base64.
        size: width and height, for bare pixels.
        max_bytes: largest photo.
    """
    # Before it is decoded: four letters make three bytes, and one in 76 may be a line break.
    if len(text) * 3 // 4 > max_bytes * 78 // 76 + 4:
        raise refuse(
            "image.too_large",
            field="imageBytes",
            expected=f"at most {max_bytes}",
            got=f"about {len(text) * 3 // 4}",
        )
    try:
        data = bytes_of_base64(text)
    except ValueError as error:
        raise refuse(
            "image.base64", field="imageBytes", expected="the photo in base64", got=str(error)
        ) from None
    if not data:
        raise refuse("image.empty", field="imageBytes")
    if data.startswith(_FILE_BEGINNINGS):
        return data
    pixels = 0 if size is None else size[0] * size[1]
    if size is not None and len(data) in (pixels, 4 * pixels):
        return _png(data, *size)
    if data.startswith(b"BM"):
        return data
    raise refuse(
        "image.format",
        "the bytes are neither a photo file nor pixels of the size in the reading",
        field="imageBytes",
        expected="JPEG or PNG; or width x height x 4 bytes (RGBA32), or width x height (GRAY8)",
        got=f"{len(data)} bytes, imageFormat {image_format!r}, size {size}",
    )


def _png(data: bytes, width: int, height: int) -> bytes:
    """Write bare pixels, one or four bytes each, as a PNG file (W3C PNG, sections 5 and 11)."""
    rows = np.frombuffer(data, np.uint8).reshape(height, width, -1)
    colour = _GREY if rows.shape[2] == 1 else _RGB
    lines = rows[:, :, : 1 if colour == _GREY else 3].reshape(height, -1)  # without alpha
    filtered = np.zeros((height, lines.shape[1] + 1), np.uint8)  # each after its filter: none
    filtered[:, 1:] = lines
    header = struct.pack(">IIBBBBB", width, height, 8, colour, 0, 0, 0)
    # Hardly compressed: it is read again at once.
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 1)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part))
        for name, part in parts
    )
