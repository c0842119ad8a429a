"""Photos of all formats that are read, with EXIF."""

from __future__ import annotations

import io
import math
import zlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image, PngImagePlugin

from tests.fuzz.target import refusal
from tests.heic import heic
from visloc.errors import InvalidInput
from visloc.photos.reading import ImageLimits, read_photo, stored_from_upright, upright

LIMITS = ImageLimits(max_bytes=2**16, max_pixels=2**18)


class Images:
    """Reads photos of at most 2**18 pixels."""

    def __init__(self, _folder: Path) -> None:
        cv2.setNumThreads(1)

    def run(self, data: bytes) -> str:
        """Read a photo; what is accepted must be one."""
        try:
            photo = read_photo(data, LIMITS)
        except InvalidInput as error:
            return refusal(error, "image.")
        assert photo.rgb.dtype == np.uint8
        assert photo.rgb.shape == (photo.height, photo.width, 3)
        assert 0 < photo.width * photo.height <= LIMITS.max_pixels
        assert photo.exif_orientation in range(1, 9)
        focal = photo.focal_length_px
        assert focal is None or (math.isfinite(focal) and focal > 0)
        turned = upright(photo.rgb, photo.exif_orientation)
        corner = np.array([turned.shape[1::-1]], np.float64)
        x, y = stored_from_upright(corner, photo.exif_orientation, photo.width, photo.height)[0]
        assert x in (0, photo.width)
        assert y in (0, photo.height)
        return "accepted"

    def repair(self, data: bytes) -> bytes:
        """Make the checksums of a PNG's chunks right."""
        if not data.startswith(b"\x89PNG\r\n\x1a\n"):
            return data
        repaired = bytearray(data)
        position = 8
        while position + 12 <= len(data):
            length = int.from_bytes(data[position : position + 4], "big")
            end = position + 8 + length
            if end + 4 > len(data):
                break
            checksum = zlib.crc32(data[position + 4 : end])
            repaired[end : end + 4] = checksum.to_bytes(4, "big")
            position = end + 4
        return bytes(repaired)

    def seeds(self) -> Iterator[bytes]:
        """Yield small photos of every format and kind."""
        rng = np.random.default_rng(0)
        noise = cv2.GaussianBlur(rng.integers(0, 256, (24, 32, 3), np.uint8), (0, 0), 2.0)
        rgb = Image.fromarray(noise)
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 6
        details = exif.get_ifd(ExifTags.IFD.Exif)
        details[ExifTags.Base.FocalLength] = 4.2
        details[ExifTags.Base.FocalPlaneXResolution] = 200.0
        details[ExifTags.Base.FocalPlaneResolutionUnit] = 3
        details[ExifTags.Base.ExifImageWidth] = 32
        short = Image.Exif()
        short.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 28
        text = PngImagePlugin.PngInfo()
        text.add_text("a", "b" * 20, zip=True)
        text.add_itxt("a", "b" * 20, zip=True)
        second = rgb.transpose(Image.Transpose.ROTATE_180)
        alpha = rgb.convert("RGBA")
        grey, palette = rgb.convert("L"), rgb.quantize(16)
        for image, kind, options in (
            (rgb, "JPEG", {"exif": exif}),
            (rgb, "JPEG", {"exif": short, "progressive": True}),
            (rgb, "JPEG", {"subsampling": 0, "optimize": True, "comment": b"x"}),
            (rgb, "JPEG", {"restart_marker_blocks": 2}),
            (rgb.convert("CMYK"), "JPEG", {}),
            (grey, "JPEG", {"icc_profile": b"\0" * 40}),
            (rgb, "PNG", {"exif": exif, "pnginfo": text}),
            (alpha, "PNG", {"icc_profile": b"\0" * 40}),
            (grey, "PNG", {"bits": 8}),
            (palette, "PNG", {"transparency": 3}),
            (rgb.convert("1"), "PNG", {}),
            (rgb.convert("I;16"), "PNG", {}),
            (rgb, "PNG", {"save_all": True, "append_images": [second]}),
            (rgb, "WEBP", {"exif": exif, "quality": 40}),
            (alpha, "WEBP", {"lossless": True}),
            (rgb, "WEBP", {"save_all": True, "append_images": [second]}),
            (rgb, "TIFF", {"exif": exif}),
            (rgb, "TIFF", {"compression": "tiff_lzw"}),
            (rgb, "TIFF", {"compression": "tiff_adobe_deflate"}),
            (rgb, "TIFF", {"compression": "jpeg"}),
            (rgb, "TIFF", {"compression": "packbits"}),
            (rgb.convert("1"), "TIFF", {"compression": "group4"}),
            (rgb, "TIFF", {"save_all": True, "append_images": [second]}),
            (rgb.convert("I;16"), "TIFF", {"big_tiff": False}),
            (palette, "TIFF", {}),
            (rgb.convert("CMYK"), "TIFF", {}),
            (alpha, "TIFF", {}),
            (rgb, "AVIF", {"exif": exif, "quality": 40}),
            (alpha, "AVIF", {"quality": 40}),
            (rgb, "AVIF", {"save_all": True, "append_images": [second]}),
            (rgb, "BMP", {}),
            (palette, "BMP", {}),
            (rgb.convert("1"), "BMP", {}),
            (alpha, "BMP", {}),
        ):
            file = io.BytesIO()
            image.save(file, kind, **options)
            yield file.getvalue()
            if kind == "JPEG" and options.get("progressive"):
                jpeg = file.getvalue()  # its last scan again, nearly as often as it may be
                last, end = jpeg.rindex(b"\xff\xda"), jpeg.rindex(b"\xff\xd9")
                yield jpeg[:end] + jpeg[last:end] * 85 + jpeg[end:]
        for orientation in range(1, 9):
            yield heic(noise, orientation, exif=exif.tobytes(), ten_bits=orientation == 8)
        large = cv2.resize(noise, (801, 601))  # is reduced while it is decoded
        yield cv2.imencode(".jpg", large, [cv2.IMWRITE_JPEG_QUALITY, 50])[1].tobytes()
        yield b"GIF89a" + bytes(20)  # is not read
        yield cv2.imencode(".png", noise.astype(np.uint16) << 8)[1].tobytes()
