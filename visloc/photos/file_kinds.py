"""Kinds of files, told by their first bytes: photos that are read here, and what else people have.

A kind that is not read comes with the advice that errors and notes of imports print.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# ``file_kind`` needs this many bytes of a file.
HEAD_BYTES = 4096


@dataclass(frozen=True, slots=True)
class FileKind:
    """A kind of file.

    Attributes:
        advice: what to do with them instead; empty for photos that are read here.
    """

    name: str
    plural: str
    advice: str = ""

    @property
    def is_read(self) -> bool:
        """Whether photos of this kind are read here."""
        return not self.advice

    @property
    def refusal(self) -> str:
        """The sentence for errors and notes about a kind that is not read."""
        return f"{self.plural} are not read here; {self.advice}"


def _photos(name: str, advice: str = "") -> FileKind:
    return FileKind(name, f"{name} photos", advice)


def _video(name: str) -> FileKind:
    return FileKind(
        name, f"{name} videos", "make a map of them with: mapping capture VIDEO --map ID"
    )


def _other_video(name: str) -> FileKind:
    return FileKind(
        name,
        f"{name} videos",
        "take frames out of them, into a folder that exists, such as with: "
        "ffmpeg -i VIDEO -vf fps=2 -q:v 2 FOLDER/%05d.jpg",
    )


_HEIC, _AVIF = _photos("HEIC"), _photos("AVIF")
_RAW = _photos("raw", "develop them to JPEG, such as with: darktable-cli PHOTO PHOTO.jpg")
_JPEG_XL = _photos("JPEG XL", "convert them to JPEG, such as with: djxl PHOTO PHOTO.jpg")
_TIFF = _photos("TIFF")
_SVG = FileKind("SVG", "SVG drawings", "save them as PNG")
_BIG_TIFF = _photos("BigTIFF", "save them as ordinary TIFF or PNG")
_MP4, _MOV, _3GP = _video("MP4"), _video("MOV"), _video("3GP")

_SIGNATURES: tuple[tuple[bytes, FileKind], ...] = (
    (b"\xff\xd8\xff", _photos("JPEG")),
    (b"\x89PNG\r\n\x1a\n", _photos("PNG")),
    (b"II*\0", _TIFF),
    (b"MM\0*", _TIFF),
    (b"II+\0", _BIG_TIFF),
    (b"MM\0+", _BIG_TIFF),
    (b"II\xbc\x01", _photos("JPEG XR", "save them as PNG")),
    (b"v/1\x01", FileKind("OpenEXR", "OpenEXR pictures", "save them as PNG")),
    (b"BM", _photos("BMP")),
    (b"GIF8", FileKind("GIF", "GIF pictures", "save them as PNG")),
    (b"\xff\x0a", _JPEG_XL),
    (b"\0\0\0\x0cJXL ", _JPEG_XL),
    (b"\0\0\0\x0cjP  ", _photos("JPEG 2000", "save them as PNG")),
    (b"FUJIFILMCCD-RAW", _RAW),
    (b"IIU\0", _RAW),  # Panasonic
    (b"IIR", _RAW),  # Olympus
    (b"MMOR", _RAW),  # Olympus
    (b"FOVb", _RAW),  # Sigma
    (b"\x1aE\xdf\xa3", _video("Matroska or WebM")),
    (b"\0\0\x01\xba", _other_video("MPEG")),
    (b"%PDF-", FileKind("PDF", "PDF documents", "save the photos in them as JPEG or PNG")),
    (b"8BPS", _photos("Photoshop", "save them as PNG")),
    (b"<svg", _SVG),
)
# Cameras and poses, by what stands near the beginning of the text.
_EXPORTS: tuple[tuple[bytes, str], ...] = (
    (b"xmlns:xcr=", "RealityCapture"),  # XMP beside each photo
    (b"#name,x,y,", "RealityCapture"),  # CSV
    (b"<document version=", "Metashape"),
    (b"<BlocksExchange", "ContextCapture"),
)
_RIFF = {b"WEBP": _photos("WebP"), b"AVI ": _other_video("AVI")}
# Brands of ISO base media files (ISO/IEC 14496-12, 23008-12), the telling ones first.
_BRANDS: tuple[tuple[tuple[bytes, ...], FileKind], ...] = (
    ((b"avif", b"avis"), _AVIF),
    ((b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"), _HEIC),
    ((b"crx ",), _RAW),  # Canon CR3
    ((b"qt  ",), _MOV),
    ((b"isom", b"iso2", b"iso4", b"iso5", b"iso6", b"mp41", b"mp42", b"avc1"), _MP4),
    ((b"M4V ", b"M4VH", b"M4VP", b"MSNV", b"f4v ", b"iso3", b"mmp4"), _MP4),
)
_3GP_BRANDS = (b"3gp", b"3g2", b"3ge", b"3gs")  # and a digit or letter
# A QuickTime file without a brand begins with one of these boxes.
_MOV_BOXES = (b"moov", b"mdat", b"wide", b"pnot")
_DNG_VERSION, _NEW_SUBFILE_TYPE = 50706, 254  # tags of TIFF


def file_kind(head: bytes) -> FileKind | None:
    """Tell the kind of a file by its first ``HEAD_BYTES``; None for one that is not known."""
    if head.startswith(b"RIFF"):
        return _RIFF.get(head[8:12])
    if head[4:8] == b"ftyp":
        return _of_brands(head)
    if head[4:8] in _MOV_BOXES:
        return _MOV
    found = next((kind for magic, kind in _SIGNATURES if head.startswith(magic)), None)
    if found is _TIFF and _is_raw(head):
        return _RAW
    if found is None and head.startswith(b"<?xml") and b"<svg" in head:
        return _SVG
    return found or next((_poses(by) for text, by in _EXPORTS if text in head), None)


def _poses(program: str) -> FileKind:
    return FileKind(
        f"poses of {program}",
        f"poses of {program}",
        "export its cameras as COLMAP or Bundler, then: mapping import colmap FOLDER --map ID",
    )


def kind_of(path: Path) -> FileKind | None:
    """Tell the kind of a file; None for one that is not known or cannot be read."""
    try:
        with path.open("rb") as file:
            return file_kind(file.read(HEAD_BYTES))
    except OSError:
        return None


def _of_brands(head: bytes) -> FileKind | None:
    end = int.from_bytes(head[:4])
    compatible = head[16:end]
    brands = {head[8:12], *(compatible[at : at + 4] for at in range(0, len(compatible), 4))}
    found = next((kind for names, kind in _BRANDS if brands & set(names)), None)
    if found is None and any(brand.startswith(_3GP_BRANDS) for brand in brands):
        return _3GP
    return found


def _is_raw(head: bytes) -> bool:
    """Tell whether a TIFF is a raw photo: what ordinary readers find in one is a thumbnail."""
    if head[8:10] == b"CR":  # Canon CR2
        return True
    tags = dict(_tiff_tags(head))
    return _DNG_VERSION in tags or bool(tags.get(_NEW_SUBFILE_TYPE, 0) & 1)


def _tiff_tags(head: bytes) -> Iterator[tuple[int, int]]:
    """Yield the tags of a TIFF's first directory, with the numbers that follow them."""
    order = "<" if head.startswith(b"II") else ">"
    try:
        (start,) = struct.unpack_from(f"{order}I", head, 4)
        (count,) = struct.unpack_from(f"{order}H", head, start)
        for position in range(start + 2, start + 2 + 12 * count, 12):
            tag, _, _, value = struct.unpack_from(f"{order}HHII", head, position)
            yield tag, value
    except struct.error:  # the directory lies further on
        return
