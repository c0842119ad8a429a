from __future__ import annotations

import io
import struct

import pytest
from PIL import Image

from visloc.photos.file_kinds import file_kind


def kind_of(head: bytes) -> str | None:
    kind = file_kind(head)
    return None if kind is None else kind.name


@pytest.mark.parametrize("name", ["JPEG", "PNG", "WebP", "TIFF", "BMP", "GIF", "AVIF"])
def test_files_of_a_library_are_known(name: str) -> None:
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, name)
    kind = file_kind(file.getvalue())
    assert kind is not None
    assert kind.name == name
    assert kind.is_read == (name != "GIF")


def box(brand: bytes, *compatible: bytes) -> bytes:
    content = b"ftyp" + brand + bytes(4) + b"".join(compatible)
    return struct.pack(">I", len(content) + 4) + content + b"qt  avif"  # of the next box


@pytest.mark.parametrize(
    ("head", "name"),
    [
        (box(b"heic", b"mif1", b"heic"), "HEIC"),
        (box(b"mif1", b"mif1", b"heic"), "HEIC"),
        (box(b"mif1", b"avif", b"miaf"), "AVIF"),
        (box(b"avif"), "AVIF"),
        (box(b"isom", b"isom", b"iso2", b"avc1", b"mp41"), "MP4"),
        (box(b"XAVC", b"XAVC", b"mp42"), "MP4"),
        (box(b"M4V ", b"M4V ", b"M4A "), "MP4"),
        (box(b"3gp5"), "3GP"),
        (box(b"3gp5", b"3gp5", b"isom"), "MP4"),
        (box(b"3g2a", b"3g2a"), "3GP"),
        (box(b"qt  ", b"qt  "), "MOV"),
        (bytes(4) + b"moov" + bytes(8), "MOV"),
        (box(b"crx ", b"isom"), "raw"),
        (box(b"M4A "), None),
        (b"RIFF" + bytes(4) + b"AVI ", "AVI"),
        (b"RIFF" + bytes(4) + b"WAVE", None),
        (b"\x1aE\xdf\xa3" + bytes(20), "Matroska or WebM"),
        (b"II*\0\x10\0\0\0CR\2\0", "raw"),
        (b"II+\0\x08\0\0\0", "BigTIFF"),
        (b"MM\0+\0\x08\0\0", "BigTIFF"),
        (b"II\xbc\x01", "JPEG XR"),
        (b"v/1\x01\2\0\0\0", "OpenEXR"),
        (b"<?xml version='1.0'?>\n<svg xmlns='x'/>", "SVG"),
        (b"<?xml version='1.0'?>\n<html/>", None),
        (b"%PDF-1.7", "PDF"),
        (b'<x:xmpmeta xmlns:x="adobe:ns:meta/">\n<a xmlns:xcr="b"/>', "poses of RealityCapture"),
        (b'<x:xmpmeta xmlns:x="adobe:ns:meta/">\n<a xmlns:crs="b"/>', None),
        (b"#cameras 24\n#name,x,y,alt,heading,pitch,roll\n", "poses of RealityCapture"),
        (b'<?xml version="1.0"?>\n<document version="2.0.0">\n  <chunk>', "poses of Metashape"),
        (b'<?xml version="1.0"?>\n<BlocksExchange version="3.2">', "poses of ContextCapture"),
        (b"hello", None),
        (b"", None),
    ],
)
def test_kinds_are_told_by_the_first_bytes(head: bytes, name: str | None) -> None:
    assert kind_of(head) == name


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_tiff_whose_first_picture_is_a_preview_is_a_raw_photo(order: str) -> None:
    mark = b"II*\0" if order == "<" else b"MM\0*"
    entry = struct.pack(f"{order}HHII", 254, 4, 1, 1)
    whole = mark + struct.pack(f"{order}IH", 8, 1) + entry
    assert kind_of(whole) == "raw"
    for length in range(len(mark), len(whole)):
        assert kind_of(whole[:length]) == "TIFF"
