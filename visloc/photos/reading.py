"""Bytes to pixels, safely.

Everything here assumes that the bytes are hostile: size limits are checked on the header, before
any pixel is decoded.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from visloc.errors import VislocError, refuse
from visloc.photos.formats import (
    FORMATS,
    MALFORMED,
    MAX_PARTS,
    MAX_SCANS,
    MAX_SCANS_OF_LARGEST,
    REDUCTIONS,
    Passes,
    PhotoHeader,
    count_passes,
    mask_hides_unsaid,
    open_header,
)

Pixel = TypeVar("Pixel", bound=np.generic)
# A smaller zoom changes the focal length by less than EXIF's rounding.
_ZOOM_TOLERANCE = 0.02
# CIPA DCG-001: the 35 mm equivalent compares diagonals; that of a 36 mm x 24 mm frame.
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF FocalPlaneResolutionUnit
# In units of the longer side: from a 127 degree lens to a long telescope. What lies outside was
# written by mistake.
_PLAUSIBLE_FOCAL = (0.25, 50.0)
# libjpeg makes a JPEG smaller while it decodes, and then needs no memory for all of its pixels:
# four times max_pixels are read so. The photos of phones have up to 200 megapixels.
_MOST_REDUCED_AREA = 4
# All pictures of which a photo is made have together at most so many times ``max_pixels``. The
# largest photo of a phone is made of tiles as large as itself, and has a gain map.
_MOST_DECODED_AREA = 5
# A reduced photo has at most so many pixels. Features are found in fewer.
_REDUCED_PIXELS = 16_000_000


@dataclass(frozen=True, slots=True)
class ImageLimits:
    """What is accepted.

    Attributes:
        max_bytes: size of the encoded photo.
        max_pixels: width times height, read from the header. Ordinary JPEGs may have four times as
            many: they are reduced while they are decoded.
    """

    max_bytes: int = 20 * 2**20
    max_pixels: int = 50_000_000


# Photos of 200 megapixels have up to about 100 MB.
FILE_LIMITS = ImageLimits(max_bytes=128 * 2**20)


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A decoded photo.

    Attributes:
        rgb: (H, W, 3) uint8, pixels as stored: the EXIF orientation is not applied.
        exif_orientation: 1 to 8; 1 when absent or invalid. For HEIC and AVIF, what their container
            asks for.
        focal_length_px: from EXIF, in pixels of ``rgb``; None when absent or implausible.
        reduced: 1; for a photo that was reduced while it was decoded, how many pixels of the file
            (2, 4 or 8) each side of a pixel of ``rgb`` spans. (u, v) in the file is
            (u / reduced, v / reduced) in ``rgb``; columns and rows that fill no pixel are left out.
        file_size: width and height of the file's pixels; None when they are those of ``rgb``.
        camera_name: make and model from EXIF, and its digital zoom if used; "" when absent.
        mask: (h, w) bool, pixels as stored, False where the picture does not count; of any size of
            the same aspect. None when all of it counts.
    """

    rgb: NDArray[np.uint8]
    exif_orientation: int = 1
    focal_length_px: float | None = None
    reduced: int = 1
    file_size: tuple[int, int] | None = None
    mask: NDArray[np.bool_] | None = None
    camera_name: str = ""

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

    def counts(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Tell which points (N, 2), in pixels of ``rgb``, lie where the mask lets them count."""
        if self.mask is None:
            return np.ones(len(points), dtype=np.bool_)
        height, width = self.mask.shape
        size = self.file_size or (self.width, self.height)
        scale = self.reduced * np.array([width / size[0], height / size[1]])
        # Points may lie on the far edge.
        places = np.floor(points * scale).astype(np.int64)
        x, y = np.clip(places, 0, [width - 1, height - 1]).T
        return np.asarray(self.mask[y, x])


_DEFAULT_LIMITS = ImageLimits()


def read_photo(data: bytes, limits: ImageLimits = _DEFAULT_LIMITS) -> Photo:
    """Decode a photo."""
    return _read(data, limits, field="image")


def read_photo_file(path: Path, limits: ImageLimits = FILE_LIMITS) -> Photo:
    """Decode a photo file. At most ``limits.max_bytes`` + 1 bytes of it are read."""
    try:
        with path.open("rb") as file:
            data = file.read(limits.max_bytes + 1)
    except FileNotFoundError:
        raise refuse("image.missing", field=str(path)) from None
    except OSError as error:
        raise refuse("image.unreadable", field=str(path), got=error.strerror) from error
    return _read(data, limits, field=str(path))


def with_mask(
    photo: Photo, data: bytes, limits: ImageLimits = _DEFAULT_LIMITS, field: str = "mask"
) -> Photo:
    """Decode the mask of a photo: black pixels do not count, all others do (COLMAP's convention).

    A mask has the photo's size or aspect, exactly: of its pixels as stored, or, where these lie on
    their side, of the upright picture. An orientation in the mask's own EXIF is ignored.
    """
    read = _read(data, limits, field)
    if (unsaid := mask_hides_unsaid(data)) is not None:
        raise refuse("mask.kind", field=field, got=unsaid)
    shown: NDArray[np.bool_] = np.asarray(read.rgb.any(axis=2))
    width, height = read.file_size or (read.width, read.height)
    stored = photo.file_size or (photo.width, photo.height)
    if width * stored[1] == height * stored[0]:
        return replace(photo, mask=shown)
    if photo.is_on_its_side and width * stored[0] == height * stored[1]:
        return replace(photo, mask=_unturned(shown, photo.exif_orientation))
    raise refuse(
        "mask.size",
        field=field,
        expected=f"{stored[0]} x {stored[1]} pixels, or exactly the same aspect",
        got=f"{width} x {height}",
    )


def read_exif(data: bytes) -> Image.Exif:
    """Return the EXIF of a photo that ``read_photo`` reads; empty without any that is whole."""
    return open_header(data, "image").exif


def size_as_read(path: Path, limits: ImageLimits = FILE_LIMITS) -> tuple[int, int]:
    """Return the width and height that ``read_photo_file`` gives a photo, from its header."""
    header = open_header(path.read_bytes(), str(path))
    reduced = _reduction(header, limits, str(path))
    return header.size[0] // reduced, header.size[1] // reduced


def turn_of(exif_orientation: int) -> int:
    """Return the orientation (1, 3, 6 or 8) that turns as this one (1 to 8) without mirroring.

    Front cameras store what the sensor saw, and some ask viewers to mirror it (2, 4, 5 and 7). A
    mirrored picture has no camera and matches nothing.
    """
    return {2: 1, 4: 3, 5: 6, 7: 8}.get(exif_orientation, exif_orientation)


def upright(rgb: NDArray[Pixel], exif_orientation: int) -> NDArray[Pixel]:
    """Turn stored pixels (H, W) or (H, W, 3) the way their EXIF orientation (1 to 8) asks for."""
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


def _unturned(rgb: NDArray[Pixel], exif_orientation: int) -> NDArray[Pixel]:
    """Undo ``upright``. The quarter turns 6 and 8 are each other's inverse."""
    return upright(rgb, {6: 8, 8: 6}.get(exif_orientation, exif_orientation))


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
    passes = count_passes(data)
    if passes.parts > MAX_PARTS:
        raise _too_complex(field, f"at most {MAX_PARTS} segments or chunks", "more")
    try:
        header = open_header(data, field, limits.max_pixels)
    except Image.DecompressionBombError as error:
        raise _too_many_pixels(field, limits.max_pixels, str(error)) from None
    width, height = header.size
    reduced = _reduction(header, limits, field)
    _check_passes(passes, header, reduced, limits, field)
    focal_length_px = _focal_length_px(header.exif, width, height)
    rgb = header.decode(reduced)
    expected = (-(-height // reduced), -(-width // reduced), 3)
    if rgb is not None and rgb.ndim == len(expected):
        rgb = _unturned(rgb, header.turned)
    if rgb is None or rgb.shape != expected:
        raise refuse(
            "image.undecodable",
            field=field,
            expected=f"{width} x {height} pixels of {header.format}",
            got="pixels that cannot be decoded",
        )
    photo = Photo(
        rgb, header.exif_orientation, focal_length_px, camera_name=_camera_name(header.exif)
    )
    if reduced == 1:
        return photo
    whole = np.ascontiguousarray(rgb[: height // reduced, : width // reduced])
    focal_length_px = focal_length_px and focal_length_px / reduced
    return replace(
        photo,
        rgb=whole,
        focal_length_px=focal_length_px,
        reduced=reduced,
        file_size=(width, height),
    )


def _reduction(header: PhotoHeader, limits: ImageLimits, field: str) -> int:
    """Return by how much to reduce a photo while it is decoded: 1, 2, 4 or 8."""
    pixels = header.most_pixels
    if pixels <= limits.max_pixels:
        return 1
    most = limits.max_pixels
    if header.format == "JPEG":
        most *= _MOST_REDUCED_AREA
        target = min(_REDUCED_PIXELS, limits.max_pixels)
        fitting = (by for by in REDUCTIONS if pixels <= target * by**2 and min(header.size) >= by)
        if pixels <= most and (reduced := next(fitting, None)):
            return reduced
    width, height = header.size
    raise _too_many_pixels(field, most, f"{width} x {height}")


def _check_passes(
    passes: Passes, header: PhotoHeader, reduced: int, limits: ImageLimits, field: str
) -> None:
    """Refuse a photo that takes too long, or memory for all pixels although it is reduced."""
    width, height = header.size
    if header.decoded_pixels > _MOST_DECODED_AREA * limits.max_pixels:
        most = _MOST_DECODED_AREA * limits.max_pixels
        got = f"{header.decoded_pixels} pixels"
        raise _too_complex(field, f"at most {most} pixels in all of its pictures", got)
    if reduced > 1 and (passes.scans > 1 or passes.progressive):
        kind = "a progressive JPEG" if passes.progressive else f"{passes.scans} scans"
        raise _too_complex(field, f"one scan of {width} x {height} pixels, not progressive", kind)
    most = min(MAX_SCANS, MAX_SCANS_OF_LARGEST * limits.max_pixels // (width * height))
    if reduced == 1 and passes.scans > most:
        raise _too_complex(
            field, f"at most {most} scans of {width} x {height} pixels", f"{passes.scans} scans"
        )


def _too_many_pixels(field: str, most: int, got: str) -> VislocError:
    return refuse(
        "image.too_many_pixels",
        field=field,
        expected=f"at most {most} pixels",
        got=got,
    )


def _too_complex(field: str, expected: str, got: str) -> VislocError:
    return refuse("image.too_complex", field=field, expected=expected, got=got)


def _camera_name(exif: Image.Exif) -> str:
    """Return make and model, and the digital zoom if it was used."""
    try:
        make, model = (
            exif_text(exif.get(tag)) for tag in (ExifTags.Base.Make, ExifTags.Base.Model)
        )
        zoom = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.DigitalZoomRatio)
    except MALFORMED:
        return ""
    zoomed = f"at digital zoom {_positive(zoom):g}" if _is_zoomed(zoom) else ""
    return " ".join(part for part in (make, model, zoomed) if part)


def exif_text(value: object) -> str:
    """Return a text of EXIF as kapture can hold it; nothing for what is not a text."""
    if not isinstance(value, str):
        return ""
    text = " ".join(value.replace("\0", " ").replace(",", " ").split())
    return text if text.isprintable() else ""


def _focal_length_px(exif: Image.Exif, width: int, height: int) -> float | None:
    try:
        tag = exif.get_ifd(ExifTags.IFD.Exif).get
        return _from_tags(tag, width, height)
    except MALFORMED:
        return None


def _from_tags(tag: Callable[[int], object], width: int, height: int) -> float | None:
    if _is_zoomed(tag(ExifTags.Base.DigitalZoomRatio)):
        return None  # makers differ in whether the focal length includes it
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


def _is_zoomed(ratio: object) -> bool:
    """Tell whether EXIF's ratio of digital zoom says that a photo is part of a larger picture."""
    number = _positive(ratio)  # 0 or absent: not used
    return number is not None and abs(number - 1.0) > _ZOOM_TOLERANCE


def _positive(value: object) -> float | None:
    """Return an EXIF number as float; None for what is not a positive finite number."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None
