"""Headers and decoders of the photos that are read, one way for each format.

Pillow reads headers and EXIF, OpenCV decodes. libheif decodes HEIC, and Pillow what OpenCV does
not: AVIF, and TIFF with transparency.
"""

from __future__ import annotations

import io
import math
import os
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import pi_heif
from numpy.typing import NDArray
from PIL import AvifImagePlugin, ExifTags, Image
from PIL.AvifImagePlugin import AvifImageFile
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import (
    BITSPERSAMPLE,
    ROWSPERSTRIP,
    SAMPLEFORMAT,
    TILELENGTH,
    TILEWIDTH,
    TiffImageFile,
)
from PIL.WebPImagePlugin import WebPImageFile

from visloc.errors import refuse
from visloc.photos.file_kinds import HEAD_BYTES, file_kind
from visloc.photos.heic import decode_heic, heic_outline

FORMATS = "JPEG, HEIC, PNG, WebP, AVIF, TIFF or BMP"
# How the names of photos end, in lower case.
SUFFIXES = frozenset(
    {
        *(".avif", ".bmp", ".heic", ".heif", ".hif", ".jpeg", ".jpg", ".png", ".tif", ".tiff"),
        ".webp",
    }
)
_READERS: Mapping[str, Callable[[io.BytesIO], ImageFile]] = {
    "JPEG": JpegImageFile,
    "PNG": PngImageFile,
    "WebP": WebPImageFile,
    "TIFF": TiffImageFile,
    "BMP": BmpImageFile,
    "AVIF": AvifImageFile,
}
_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
PNG_GREY = 0  # a colour type of PNG
# What Pillow's parsers raise on malformed files. It is not documented; this is what fuzzing and
# reading them showed.
MALFORMED = (
    *(OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, AttributeError),
    *(EOFError, OverflowError, ZeroDivisionError, RuntimeError, struct.error, zlib.error),
)
# A decoder goes over all pixels once per scan of a JPEG. libjpeg's own script has 10 scans for
# colour and 18 for CMYK; libtiff refuses more than 100 in the JPEGs that it holds.
MAX_SCANS = 100
# The largest photo may have so many. Photos with fewer pixels may have more, up to MAX_SCANS.
MAX_SCANS_OF_LARGEST = 20
# libtiff counts the scans of a JPEG within a TIFF itself, and reads its limit when it decodes.
os.environ.setdefault("LIBTIFF_JPEG_MAX_ALLOWED_SCAN_NUMBER", f"{MAX_SCANS_OF_LARGEST}")
# By how much libjpeg makes a photo smaller while it decodes.
REDUCTIONS = (2, 4, 8)
_REDUCED_FLAGS = {
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}
# A process of the service or of a build has one core; Pillow would start a thread for each.
AvifImagePlugin.DEFAULT_MAX_THREADS = 1
_ONE_STRIP = 2**32 - 1  # of TIFF: all rows are in one
_LEAST_PIECE = 2**20  # pixels of a strip or tile of TIFF that may always be
# Segments of a JPEG or chunks of a PNG. 20 MiB of image data in the usual pieces are 2 600 chunks.
MAX_PARTS = 100_000
# JPEG markers that begin a segment with a length, and the end of the image (ITU T.81, table B.1).
# Decoders pass over the others byte by byte, or refuse the file.
_JPEG_MARKER = re.compile(rb"\xff[\xc0-\xc7\xc9-\xcf\xd9-\xef\xfe]")
_END_OF_IMAGE, _START_OF_SCAN = 0xD9, 0xDA
_PROGRESSIVE = (0xC2, 0xC6, 0xCA, 0xCE)  # starts of frames


@dataclass(frozen=True, slots=True, eq=False)
class PhotoHeader:
    """What a photo says of itself before it is decoded.

    Attributes:
        most_pixels: width times height of the largest picture that a decoder may allocate.
        exif_orientation: 1 to 8; for HEIC and AVIF, what their container asks for.
        exif: empty when the photo has none or it is broken.
        decode: returns (H, W, 3) uint8 RGB, or None when that fails. The argument is 1; for a JPEG
            also 2, 4 or 8, by which its sides are then divided, rounded up.
        turned: the orientation that ``decode`` has applied.
        decoded_pixels: width times height of all that a decoder works through, where that may be
            much more than the photo; 0 otherwise.
    """

    format: str
    size: tuple[int, int]
    most_pixels: int
    exif_orientation: int
    exif: Image.Exif
    decode: Callable[[int], NDArray[np.uint8] | None]
    turned: int = 1
    decoded_pixels: int = 0


def open_header(data: bytes, field: str, max_webp_pixels: float = math.inf) -> PhotoHeader:
    """Read the header of a photo.

    Args:
        max_webp_pixels: Pillow's reader of WebP sets 8 bytes per pixel aside with the header.
    """
    kind = file_kind(data[:HEAD_BYTES])
    if kind is None or not kind.is_read:
        raise refuse(
            "image.format",
            "the server does not read this image format" if kind is None else kind.refusal,
            field=field,
            expected=FORMATS,
            got=f"bytes that begin with {data[:12].hex(' ')}" if kind is None else kind.name,
        )
    try:
        if kind.name == "HEIC":
            return _heic_header(data)
        if kind.name == "WebP" and (pixels := _webp_pixels(data)) > max_webp_pixels:
            raise Image.DecompressionBombError(f"{pixels} pixels")
        # The classes instead of Image.open: that one has a pixel limit of its own, a process-wide
        # variable, and warns or raises before ours can be compared.
        opened = _READERS[kind.name](io.BytesIO(data))
        if isinstance(opened, TiffImageFile):
            _check_tiff(opened, field)
    except MALFORMED as error:
        raise refuse(
            "image.undecodable",
            "the header of the photo is damaged or cut off",
            field=field,
            expected=FORMATS,
            got=str(error) or type(error).__name__,
        ) from error
    return _pillow_header(kind.name, opened, data)


def png_samples(data: bytes) -> tuple[int, int] | None:
    """Return the bits per sample and the colour type of a PNG; None for other files."""
    is_one = data.startswith(_PNG) and data[12:16] == b"IHDR" and len(data) > 25
    return (data[24], data[25]) if is_one else None


def mask_hides_unsaid(data: bytes) -> str | None:
    """Say what of a picture would be lost if its black pixels were taken for a mask.

    In 16 bits, small values such as the numbers of objects would become black; and what is
    transparent may have any colour.

    Args:
        data: a picture that ``PhotoHeader.decode`` decodes, of a size within the limits.
    """
    if data.startswith(_JPEG):
        return None
    # Without a format that has either, OpenCV returns nothing.
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        return None
    if pixels.dtype != np.uint8:
        return "16 bits per sample"
    if pixels.ndim == 3 and pixels.shape[2] == 4 and (pixels[..., 3] < 255).any():
        return "transparent pixels"
    return None


def _pillow_header(name: str, opened: ImageFile, data: bytes) -> PhotoHeader:
    size, turned = opened.size, 1
    decode = partial(_decode_with_opencv, data)
    if isinstance(opened, PngImageFile):
        decode = partial(_decode_with_opencv, _only_pixels(data))
    elif isinstance(opened, AvifImageFile):
        decode = partial(_decode_avif, opened)
    elif isinstance(opened, TiffImageFile):
        # OpenCV's TIFF reader applies the tag whatever its flags say, and so does Pillow, which
        # gives the turned size.
        turned = _valid_orientation(opened.tag_v2.get(ExifTags.Base.Orientation))
        size = size[::-1] if turned >= 5 else size
        if opened.mode in ("RGBA", "LA", "PA"):  # OpenCV blends the colours with black
            decode = partial(_decode_with_pillow, opened)
    try:
        # The base class's method: PngImageFile's would decode all pixels to look behind them.
        exif = Image.Image.getexif(opened)
        orientation = _valid_orientation(exif.get(ExifTags.Base.Orientation))
    except MALFORMED:
        exif, orientation = Image.Exif(), 1
    return PhotoHeader(name, size, size[0] * size[1], orientation, exif, decode, turned)


def _heic_header(data: bytes) -> PhotoHeader:
    outline = heic_outline(data)
    opened = pi_heif.open_heif(data)
    main = opened[opened.primary_index]
    if 0 in main.size:
        raise ValueError(f"it declares {main.size[0]} x {main.size[1]} pixels")
    width, height = main.size[::-1] if outline.orientation >= 5 else main.size

    def decode(_reduced: int) -> NDArray[np.uint8] | None:
        try:
            return decode_heic(opened)
        except MALFORMED:
            return None

    exif = Image.Exif()
    try:
        exif.load(main.info["exif"] or b"")
    except MALFORMED:
        exif = Image.Exif()
    return PhotoHeader(
        "HEIC",
        (width, height),
        max(outline.most_pixels, width * height),
        outline.orientation,
        exif,
        decode,
        turned=outline.orientation,
        decoded_pixels=outline.decoded_pixels,
    )


def _webp_pixels(data: bytes) -> int:
    """Return width times height of a WebP file's canvas (RFC 9649, sections 2.5 to 2.7)."""
    if data[12:16] == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    elif data[12:16] == b"VP8L":
        both = int.from_bytes(data[21:25], "little")
        width, height = (both & 0x3FFF) + 1, (both >> 14 & 0x3FFF) + 1
    else:
        width, height = (side & 0x3FFF for side in struct.unpack_from("<2H", data, 26))
    return width * height


def _check_tiff(header: TiffImageFile, field: str) -> None:
    """Refuse those of TIFF's many kinds that would come out wrong without a word."""
    bits = header.tag_v2.get(BITSPERSAMPLE, (1,))
    kinds = header.tag_v2.get(SAMPLEFORMAT, (1,))
    if not set(bits) <= {1, 2, 4, 8, 16} or not set(kinds) <= {1}:
        problem = f"{bits} bits per sample, sample format {kinds}"
    elif _piece_of_tiff(header) > max(_LEAST_PIECE, 4 * header.size[0] * header.size[1]):
        problem = "strips or tiles much larger than the photo"  # OpenCV allocates what they say
    else:
        return
    raise refuse(
        "image.format",
        "the server does not read this kind of TIFF; save it as PNG",
        field=field,
        expected="grey, palette or colour with up to 16 bits per sample",
        got=problem,
    )


def _piece_of_tiff(header: TiffImageFile) -> int:
    """Return how many pixels a strip or tile has."""
    rows = _tiff_number(header, ROWSPERSTRIP, _ONE_STRIP)
    strip = 0 if rows == _ONE_STRIP else rows * max(header.size)
    return max(strip, _tiff_number(header, TILEWIDTH, 0) * _tiff_number(header, TILELENGTH, 0))


def _tiff_number(header: TiffImageFile, tag: int, default: int) -> int:
    # Bytes or text in its place would be repeated, not multiplied.
    value = header.tag_v2.get(tag, default)
    if not isinstance(value, int):
        raise TypeError(f"tag {tag} is {type(value).__name__}, not a whole number")
    return value


def _only_pixels(png: bytes) -> bytes:
    """Return the PNG with nothing but its pixels, or no bytes when it is malformed.

    OpenCV 5 allocates what a chunk says its length is, before it looks whether the file is that
    long: 2 kB take 4 GB. Animation, profiles and texts stay away from it as well.
    """
    chunks = [png[:8]]
    position = 8
    while position + 12 <= len(png):
        length, kind = struct.unpack_from(">I4s", png, position)
        end = position + 12 + length
        if end > len(png) or (kind == b"IHDR") != (position == 8):
            break
        if kind in (b"IHDR", b"PLTE", b"IDAT", b"IEND"):
            chunks.append(png[position:end])
        if kind == b"IEND":
            return b"".join(chunks)
        position = end
    return b""


def _decode_with_opencv(data: bytes, reduced: int) -> NDArray[np.uint8] | None:
    if not data:
        return None
    flags = cv2.IMREAD_COLOR_RGB if reduced == 1 else _REDUCED_FLAGS[reduced]
    try:
        # Typed as never None; it is None for what cannot be decoded.
        pixels: NDArray[np.uint8] | None = cv2.imdecode(  # type: ignore[assignment]
            np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error:
        return None
    if pixels is None or reduced == 1:
        return pixels
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)  # reduced ones are BGR


def _decode_with_pillow(opened: ImageFile, _reduced: int) -> NDArray[np.uint8] | None:
    try:
        return np.array(opened if opened.mode == "RGB" else opened.convert("RGB"), np.uint8)
    except MALFORMED:
        return None


def _decode_avif(opened: AvifImageFile, _reduced: int) -> NDArray[np.uint8] | None:
    """Take the pixels as Pillow's decoder gives them.

    ``Image`` copies them three times, and takes 11 bytes for each pixel. A file of 2 kB may have 50
    million.
    """
    try:
        pixels = np.frombuffer(opened._decoder.get_frame(0)[0], np.uint8)
        pixels = pixels.reshape(opened.height, opened.width, len(opened.mode))  # L, RGB or RGBA
        return np.repeat(pixels, 3, axis=2) if opened.mode == "L" else pixels[..., :3].copy()
    except MALFORMED:
        return None


def _valid_orientation(value: object) -> int:
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


@dataclass(frozen=True, slots=True)
class Passes:
    """How often a decoder goes over a photo.

    Attributes:
        scans: of a JPEG; 0 for other formats.
        parts: segments of a JPEG or chunks of a PNG, up to ``MAX_PARTS`` + 1. Pillow takes
            microseconds for each.
        progressive: whether it is a progressive JPEG.
    """

    scans: int = 0
    parts: int = 0
    progressive: bool = False


def count_passes(data: bytes) -> Passes:
    """Count the scans and parts of a photo without decoding it."""
    if data.startswith(_JPEG):
        return _jpeg_passes(data)
    return Passes(parts=_png_chunks(data)) if data.startswith(_PNG) else Passes()


def _jpeg_passes(jpeg: bytes) -> Passes:
    """Count the scans of the first image, and its segments with the bytes lost between them.

    Segments are found as libjpeg finds them, so that it decodes no scan that is not counted here.
    Thumbnails are within segments; what a camera appends comes after the end of the image. Stops
    once ``MAX_PARTS`` is exceeded.
    """
    scans = parts = 0
    progressive = False
    position = 2
    while parts <= MAX_PARTS and (marker := _JPEG_MARKER.search(jpeg, position)):
        kind = jpeg[marker.start() + 1]
        if kind == _END_OF_IMAGE and scans:
            break
        parts += 1
        if scans == 0:  # later, image data lies between segments
            parts += marker.start() - position
        scans += kind == _START_OF_SCAN
        progressive |= kind in _PROGRESSIVE
        position = marker.end()
        if kind != _END_OF_IMAGE:  # Pillow passes over one that comes before any scan
            # The length counts its own two bytes.
            position += max(2, int.from_bytes(jpeg[position : position + 2], "big"))
    return Passes(scans, parts, progressive)


def _png_chunks(png: bytes) -> int:
    """Count the chunks; stops once ``MAX_PARTS`` is exceeded."""
    position, chunks = len(_PNG), 0
    while chunks <= MAX_PARTS and position + 12 <= len(png):
        position += 12 + int.from_bytes(png[position : position + 4], "big")
        chunks += 1
    return chunks
