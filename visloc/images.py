"""Bytes to pixels, safely.

Everything here assumes that the bytes are hostile: size limits are checked on the header, before
any pixel is decoded. Pillow reads the header and EXIF, OpenCV decodes.
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
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import BITSPERSAMPLE, SAMPLEFORMAT, TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from visloc.errors import VislocError, refuse
from visloc.file_kinds import HEAD_BYTES, file_kind

FORMATS = "JPEG, PNG, WebP, TIFF or BMP"
_READERS: Mapping[str, Callable[[io.BytesIO], ImageFile]] = {
    "JPEG": JpegImageFile,
    "PNG": PngImageFile,
    "WebP": WebPImageFile,
    "TIFF": TiffImageFile,
    "BMP": BmpImageFile,
}
_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
# What Pillow's parsers raise on malformed files. It is not documented; this is what fuzzing and
# reading them showed.
_MALFORMED = (
    *(OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, AttributeError),
    *(EOFError, OverflowError, ZeroDivisionError, RuntimeError, struct.error, zlib.error),
)
# CIPA DCG-001: the 35 mm equivalent compares diagonals; that of a 36 mm x 24 mm frame.
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF FocalPlaneResolutionUnit
# In units of the longer side: from a 127 degree lens to a long telescope. What lies outside was
# written by mistake.
_PLAUSIBLE_FOCAL = (0.25, 50.0)
# A decoder goes over all pixels once per scan of a JPEG. libjpeg's own script has 10 scans for
# colour and 18 for CMYK; libtiff refuses more than 100 in the JPEGs that it holds.
_MAX_SCANS = 100
# The largest photo may have so many. Photos with fewer pixels may have more, up to _MAX_SCANS.
_MAX_SCANS_OF_LARGEST = 20
# libtiff counts the scans of a JPEG within a TIFF itself, and reads its limit when it decodes.
os.environ.setdefault("LIBTIFF_JPEG_MAX_ALLOWED_SCAN_NUMBER", f"{_MAX_SCANS_OF_LARGEST}")
# Segments of a JPEG or chunks of a PNG. 20 MiB of image data in the usual pieces are 2 600 chunks.
_MAX_PARTS = 100_000
# JPEG markers that begin a segment with a length, and the end of the image (ITU T.81, table B.1).
# Decoders pass over the others byte by byte, or refuse the file.
_JPEG_MARKER = re.compile(rb"\xff[\xc0-\xc7\xc9-\xcf\xd9-\xef\xfe]")
_END_OF_IMAGE, _START_OF_SCAN = 0xD9, 0xDA


@dataclass(frozen=True, slots=True)
class ImageLimits:
    """What is accepted.

    Attributes:
        max_bytes: size of the encoded photo.
        max_pixels: width times height, read from the header.
    """

    max_bytes: int = 20 * 2**20
    max_pixels: int = 50_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A decoded photo.

    Attributes:
        rgb: (H, W, 3) uint8, pixels as stored: the EXIF orientation is not applied.
        exif_orientation: 1 to 8; 1 when absent or invalid.
        focal_length_px: from EXIF, in pixels of ``rgb``; None when absent or implausible.
    """

    rgb: NDArray[np.uint8]
    exif_orientation: int = 1
    focal_length_px: float | None = None

    @property
    def width(self) -> int:
        """Width of the stored pixels."""
        return int(self.rgb.shape[1])

    @property
    def height(self) -> int:
        """Height of the stored pixels."""
        return int(self.rgb.shape[0])

    @property
    def is_on_its_side(self) -> bool:
        """Whether width and height are those of the upright picture swapped."""
        return self.exif_orientation >= 5


_DEFAULT_LIMITS = ImageLimits()


def read_photo(data: bytes, limits: ImageLimits = _DEFAULT_LIMITS) -> Photo:
    """Decode a photo.

    Raises:
        InvalidInput: ``image.empty``, ``image.format`` (not an image that is read here) or
            ``image.undecodable`` (malformed or cut off).
        TooLarge: ``image.too_large``, ``image.too_many_pixels`` or ``image.too_complex``.
    """
    return _read(data, limits, field="image")


def read_photo_file(path: Path, limits: ImageLimits = _DEFAULT_LIMITS) -> Photo:
    """Decode a photo file. At most ``limits.max_bytes`` + 1 bytes of it are read.

    Raises:
        NotFound: ``image.missing``.
        InvalidInput: ``image.unreadable``, and as ``read_photo``, with the path as field.
        TooLarge: as ``read_photo``, with the path as field.
    """
    try:
        with path.open("rb") as file:
            data = file.read(limits.max_bytes + 1)
    except FileNotFoundError:
        raise refuse("image.missing", field=str(path)) from None
    except OSError as error:
        raise refuse("image.unreadable", field=str(path), got=error.strerror) from error
    return _read(data, limits, field=str(path))


def turn_of(exif_orientation: int) -> int:
    """Return the orientation (1, 3, 6 or 8) that turns as this one (1 to 8) without mirroring.

    Front cameras store what the sensor saw, and some ask viewers to mirror it (2, 4, 5 and 7). A
    mirrored picture has no camera and matches nothing.
    """
    return {2: 1, 4: 3, 5: 6, 7: 8}.get(exif_orientation, exif_orientation)


def upright(rgb: NDArray[np.uint8], exif_orientation: int) -> NDArray[np.uint8]:
    """Turn stored pixels (H, W, 3) the way their EXIF orientation (1 to 8) asks for."""
    flip_x, flip_y, transpose = _turn(exif_orientation)
    turned = rgb[:: -1 if flip_y else 1, :: -1 if flip_x else 1]
    return np.ascontiguousarray(turned.swapaxes(0, 1) if transpose else turned)


def stored_from_upright(
    points: NDArray[np.floating], exif_orientation: int, stored_width: int, stored_height: int
) -> NDArray[np.floating]:
    """Move points (N, 2) in ``upright(rgb, exif_orientation)`` to the pixels of ``rgb``.

    Pixel coordinates start at the corner of the image, so that mirroring x gives width - x.
    """
    flip_x, flip_y, transpose = _turn(exif_orientation)
    x, y = (points[:, 1], points[:, 0]) if transpose else (points[:, 0], points[:, 1])
    return np.column_stack(
        [stored_width - x if flip_x else x, stored_height - y if flip_y else y]
    ).astype(points.dtype, copy=False)


def upright_from_stored(
    points: NDArray[np.floating], exif_orientation: int, stored_width: int, stored_height: int
) -> NDArray[np.floating]:
    """Move points (N, 2) in stored pixels to ``upright(rgb, exif_orientation)``.

    The inverse of ``stored_from_upright``.
    """
    flip_x, flip_y, transpose = _turn(exif_orientation)
    x, y = points[:, 0], points[:, 1]
    turned = [stored_width - x if flip_x else x, stored_height - y if flip_y else y]
    return np.column_stack(turned[::-1] if transpose else turned).astype(points.dtype, copy=False)


def _turn(exif_orientation: int) -> tuple[bool, bool, bool]:
    """Return what leads from stored to upright: mirror x, mirror y, and then transpose."""
    return exif_orientation in (2, 3, 7, 8), exif_orientation in (3, 4, 6, 7), exif_orientation >= 5


def _read(data: bytes, limits: ImageLimits, field: str) -> Photo:
    if not data:
        raise refuse("image.empty", field=field, expected=FORMATS, got="0 bytes")
    if len(data) > limits.max_bytes:
        raise refuse(
            "image.too_large",
            field=field,
            expected=f"at most {limits.max_bytes} bytes",
            got=f"{len(data)} bytes" if field == "image" else "more",
        )
    scans = _count_passes(data, field)
    try:
        header = _open_header(data, field)
    except Image.DecompressionBombError as error:  # Pillow's own limit, checked for WebP only
        raise _too_many_pixels(field, limits, str(error)) from None
    width, height = header.size
    if width * height > limits.max_pixels:
        raise _too_many_pixels(field, limits, f"{width} x {height}")
    max_scans = min(_MAX_SCANS, _MAX_SCANS_OF_LARGEST * limits.max_pixels // (width * height))
    if scans > max_scans:
        raise _too_complex(
            field, f"at most {max_scans} scans of {width} x {height} pixels", f"{scans} scans"
        )
    rgb = _decode(_only_pixels(data) if isinstance(header, PngImageFile) else data)
    if rgb is None or rgb.shape != (height, width, 3):
        raise refuse(
            "image.undecodable",
            field=field,
            expected=f"{width} x {height} pixels of {header.format}",
            got="pixels that cannot be decoded",
        )
    orientation, focal_length_px = _exif(header)
    if isinstance(header, TiffImageFile):
        # OpenCV's TIFF reader applies the tag whatever its flags say, and Pillow gives the
        # turned size: undo it. The quarter turns 6 and 8 are each other's inverse.
        applied = _valid_orientation(header.tag_v2.get(ExifTags.Base.Orientation))
        rgb = upright(rgb, {6: 8, 8: 6}.get(applied, applied))
    return Photo(rgb, orientation, focal_length_px)


def _too_many_pixels(field: str, limits: ImageLimits, got: str) -> VislocError:
    return refuse(
        "image.too_many_pixels",
        field=field,
        expected=f"at most {limits.max_pixels} pixels",
        got=got,
    )


def _too_complex(field: str, expected: str, got: str) -> VislocError:
    return refuse("image.too_complex", field=field, expected=expected, got=got)


def _count_passes(data: bytes, field: str) -> int:
    """Return the scans of a JPEG; 0 for other formats.

    Raises:
        TooLarge: ``image.too_complex`` for too many segments or chunks: Pillow takes microseconds
            for each.
    """
    scans = parts = 0
    if data.startswith(_JPEG):
        scans, parts = _jpeg_scans(data)
    elif data.startswith(_PNG):
        parts = _png_chunks(data)
    if parts > _MAX_PARTS:
        raise _too_complex(field, f"at most {_MAX_PARTS} segments or chunks", "more")
    return scans


def _jpeg_scans(jpeg: bytes) -> tuple[int, int]:
    """Count the scans of the first image, and its segments with the bytes lost between them.

    Segments are found as libjpeg finds them, so that it decodes no scan that is not counted here.
    Thumbnails are within segments; what a camera appends comes after the end of the image. Stops
    once ``_MAX_PARTS`` is exceeded.
    """
    scans = parts = 0
    position = 2
    while parts <= _MAX_PARTS and (marker := _JPEG_MARKER.search(jpeg, position)):
        kind = jpeg[marker.start() + 1]
        if kind == _END_OF_IMAGE and scans:
            break
        parts += 1
        if scans == 0:  # later, image data lies between segments
            parts += marker.start() - position
        scans += kind == _START_OF_SCAN
        position = marker.end()
        if kind != _END_OF_IMAGE:  # Pillow passes over one that comes before any scan
            # The length counts its own two bytes.
            position += max(2, int.from_bytes(jpeg[position : position + 2], "big"))
    return scans, parts


def _png_chunks(png: bytes) -> int:
    """Count the chunks; stops once ``_MAX_PARTS`` is exceeded."""
    position, chunks = len(_PNG), 0
    while chunks <= _MAX_PARTS and position + 12 <= len(png):
        position += 12 + int.from_bytes(png[position : position + 4], "big")
        chunks += 1
    return chunks


def _open_header(data: bytes, field: str) -> ImageFile:
    # The classes instead of Image.open: that one has a pixel limit of its own, a process-wide
    # variable, and warns or raises before ours can be compared.
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
        header = _READERS[kind.name](io.BytesIO(data))
    except _MALFORMED as error:
        raise refuse(
            "image.undecodable",
            "the header of the photo is damaged or cut off",
            field=field,
            expected=FORMATS,
            got=str(error) or type(error).__name__,
        ) from error
    if isinstance(header, TiffImageFile):
        _check_tiff(header, field)
    return header


def _check_tiff(header: TiffImageFile, field: str) -> None:
    """Refuse those of TIFF's many kinds that would come out wrong without a word."""
    bits = header.tag_v2.get(BITSPERSAMPLE, (1,))
    kinds = header.tag_v2.get(SAMPLEFORMAT, (1,))
    if header.mode in ("RGBA", "LA", "PA"):  # OpenCV blends the colours with black
        problem = "transparency"
    elif not set(bits) <= {1, 2, 4, 8, 16} or not set(kinds) <= {1}:
        problem = f"{bits} bits per sample, sample format {kinds}"
    else:
        return
    raise refuse(
        "image.format",
        "the server does not read this kind of TIFF; save it as PNG",
        field=field,
        expected="grey, palette or colour with up to 16 bits per sample, without transparency",
        got=problem,
    )


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


def _decode(data: bytes) -> NDArray[np.uint8] | None:
    if not data:
        return None
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        # Typed as never None; it is None for what cannot be decoded.
        rgb: NDArray[np.uint8] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)  # type: ignore[assignment]
    except cv2.error:
        return None
    return rgb


def _exif(header: ImageFile) -> tuple[int, float | None]:
    """Return the orientation and the focal length in pixels; broken EXIF counts as none."""
    try:
        # The base class's method: PngImageFile's would decode all pixels to look behind them.
        exif = Image.Image.getexif(header)
        orientation = _valid_orientation(exif.get(ExifTags.Base.Orientation))
        details = exif.get_ifd(ExifTags.IFD.Exif)
        focal_length_px = _focal_length_px(details.get, *header.size)
    except _MALFORMED:
        return 1, None
    return orientation, focal_length_px


def _valid_orientation(value: object) -> int:
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _focal_length_px(tag: Callable[[int], object], width: int, height: int) -> float | None:
    longer_side = max(width, height)
    equivalent_mm = _positive(tag(ExifTags.Base.FocalLengthIn35mmFilm))
    focal_length_mm = _positive(tag(ExifTags.Base.FocalLength))
    pixels_per_unit = _positive(tag(ExifTags.Base.FocalPlaneXResolution))
    unit_mm = _MM_PER_UNIT.get(int(_positive(tag(ExifTags.Base.FocalPlaneResolutionUnit)) or 2))
    if equivalent_mm:
        focal_length_px = equivalent_mm / _DIAGONAL_35MM * math.hypot(width, height)
    elif focal_length_mm and pixels_per_unit and unit_mm:
        # The resolution is that of the photo as taken; it may have been made smaller since.
        taken = max(
            _positive(tag(ExifTags.Base.ExifImageWidth)) or 0.0,
            _positive(tag(ExifTags.Base.ExifImageHeight)) or 0.0,
        )
        scale = longer_side / taken if taken else 1.0
        focal_length_px = focal_length_mm * pixels_per_unit / unit_mm * scale
    else:
        return None
    low, high = _PLAUSIBLE_FOCAL
    return focal_length_px if low <= focal_length_px / longer_side <= high else None


def _positive(value: object) -> float | None:
    """Return an EXIF number as float; None for what is not a positive finite number."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None
